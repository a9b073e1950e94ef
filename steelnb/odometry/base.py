"""The interface of every odometry."""

import time
from typing import Protocol, TypeVar

import numpy as np

from steelnb.errors import InputError
from steelnb.points.inputs import checked_cloud, checked_pose
from steelnb.settings import OdometrySettings
from steelnb.types import Array, OdometryStep, Scan, Segments

SPACING_M = 0.05
S = TypeVar("S", bound=OdometrySettings)


class Odometry(Protocol):
    """Corrects a drifting pose, scan by scan, and may build a map. A class needs `update` alone, and no base class."""

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Correct the pose at one scan, and add the scan to the map.

        ``scan``: a `Scan`, or points ``(N, 3)`` or ``(H, W, 3)`` in the sensor frame, metres, NaN for no return.
        ``T_world_drone_prior (4, 4)``: the absolute drifting pose. Raises `InputError` for arrays of other shapes,
        and for a prior that is not rigid.
        """

    def map_points(self) -> Array:
        """The map as points ``(N, 3)``, world frame: by default, points along its bars, at most `SPACING_M` apart."""
        bars, pieces = self.map_segments(), [np.zeros((0, 3))]
        for start, end, length in zip(bars.start, bars.end, bars.length, strict=True):
            share = np.linspace(0, 1, max(2, int(length / SPACING_M) + 1))
            pieces.append(start + share[:, None] * (end - start))
        return np.concatenate(pieces)

    def map_segments(self) -> Segments:
        """The bars of the map; none by default."""
        return Segments.empty()


def settings_of(given: OdometrySettings | None, kind: type[S], method: str) -> S:
    """The settings of an odometry, by default the preset of a ``method``. Raises `InputError` for those of another
    family."""
    found = given or OdometrySettings.preset(method)
    if not isinstance(found, kind):
        raise InputError(f"method {found.method!r} is of the family {found.family!r}; expected one such as {method!r}")
    return found


def mount_of(T_drone_sensor: Array | None) -> Array:
    """The mount of a sensor ``(4, 4)``, by default the identity. Raises `InputError` if it is not rigid."""
    return checked_pose(np.eye(4) if T_drone_sensor is None else T_drone_sensor, "T_drone_sensor")


class Stopwatch:
    """``seconds`` of each stage of an update, zero for a stage that was skipped."""

    def __init__(self, *stages: str) -> None:
        self.seconds = dict.fromkeys(stages, 0.0)
        self._last_s = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        now_s = time.perf_counter()
        self.seconds[stage] += now_s - self._last_s
        self._last_s = now_s


def scan_of(scan: Scan | Array) -> Scan:
    """A scan from an odometry's input: points in float64, their shape checked. Raises `InputError`."""
    if isinstance(scan, Scan):
        return Scan(scan.stamp_s, checked_cloud(scan.points, "scan"), scan.fault)
    return Scan(0.0, checked_cloud(scan, "scan"))


def nothing_left(scan: Scan, crop_m: float) -> str:
    """Why preprocessing left no point of a scan; empty if the scan had none."""
    distance = np.linalg.norm(scan.points.reshape(-1, 3), axis=1)
    distance = distance[np.isfinite(distance) & (distance > 0)]
    if not len(distance) or distance.min() <= crop_m:
        return ""
    return f"no point within {crop_m:g} m (nearest {distance.min():.4g} m)"
