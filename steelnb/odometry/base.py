"""The interface of every odometry, and the base class of those of this package."""

import time
from abc import ABC, abstractmethod
from typing import ClassVar, Protocol

import numpy as np

from steelnb.core.checks import checked_cloud, checked_kind, checked_pose
from steelnb.core.errors import InputError
from steelnb.core.estimates import OdometryStep
from steelnb.core.geometry import points_along
from steelnb.core.types import Array, Scan, Segments
from steelnb.settings import OdometrySettings

SPACING_M = 0.05
Outcome = tuple[Array, str, int, int]
"""Pose ``T_world_drone (4, 4)``, the reason if the scan was not used (else empty), number of matches, and number of
directions in which the scan does not determine the pose."""


class Odometry(Protocol):
    """Corrects a drifting pose, scan by scan. A class needs only the method `update`; it need not inherit."""

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Correct the pose at one scan.

        ``scan``: a `Scan`, or points ``(N, 3)`` or ``(H, W, 3)`` in the sensor frame, metres, NaN for no return.
        ``T_world_drone_prior (4, 4)``: the absolute drifting pose. Raises `InputError` for arrays of other shapes,
        and for a prior that is not rigid.
        """


class Stopwatch:
    """``seconds`` of each stage of an update, zero for a stage that was skipped."""

    def __init__(self, stages: tuple[str, ...]) -> None:
        self.seconds = dict.fromkeys(stages, 0.0)
        self._last_s = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        now_s = time.perf_counter()
        self.seconds[stage] += now_s - self._last_s
        self._last_s = now_s


class BaseOdometry(ABC):
    """An odometry of this package, which may build a map.

    Parameters
    ----------
    settings : an instance of ``kind``, default ``OdometrySettings.preset(method)``.
    T_drone_sensor : (4, 4), the mount of the sensor, default identity.

    Raises `InputError` for settings of another family, and for a mount that is not rigid.
    """

    kind: ClassVar[type[OdometrySettings]]
    method: ClassVar[str]
    stages: ClassVar[tuple[str, ...]]
    """Names of the ``seconds`` of a step."""

    def __init__(self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None) -> None:
        self.settings = OdometrySettings.preset(self.method) if settings is None else settings
        checked_kind(self.settings, "settings", OdometrySettings, f"OdometrySettings.preset({self.method!r})")
        if not isinstance(self.settings, self.kind):
            raise InputError(
                f"method {self.settings.method!r} is of the family {self.settings.family!r}; expected one such as"
                f" {self.method!r}"
            )
        self.T_drone_sensor = checked_pose(np.eye(4) if T_drone_sensor is None else T_drone_sensor, "T_drone_sensor")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.settings.method!r})"

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Correct the pose at one scan, and add the scan to the map; see `Odometry.update`."""
        if not isinstance(scan, Scan):
            scan = Scan(0.0, checked_cloud(scan, "scan"))
        prior, watch = checked_pose(T_world_drone_prior, "T_world_drone_prior"), Stopwatch(self.stages)
        T_world_drone, reason, matches, unobserved = self._update(scan, prior, watch)
        if reason:
            reason = nothing_near(scan, self.settings.preprocess.crop_m) or reason
        return OdometryStep(
            scan.stamp_s, T_world_drone, reason == "", reason, matches, watch.seconds, unobserved,
            self._covariance(T_world_drone),
        )  # fmt: skip

    @abstractmethod
    def _update(self, scan: Scan, prior: Array, watch: Stopwatch) -> Outcome:
        """Correct the pose at one scan, and end each stage with a lap of the ``watch``."""

    def _covariance(self, T_world_drone: Array) -> Array | None:
        """The ``covariance`` of an `OdometryStep` with this pose; unknown by default."""
        return None

    def map_points(self) -> Array:
        """The map as points ``(N, 3)``, world frame: by default, points along its bars, about `SPACING_M` apart."""
        bars = self.map_segments()
        return points_along(bars.start, bars.end, SPACING_M)[0]

    def map_segments(self) -> Segments:
        """The bars of the map; none by default."""
        return Segments.empty()


def nothing_near(scan: Scan, crop_m: float) -> str:
    """The reason if all returns of a scan are farther than ``crop_m``; empty otherwise, or if there are none."""
    distance = np.linalg.norm(scan.points.reshape(-1, 3), axis=1)
    distance = distance[np.isfinite(distance) & (distance > 0)]
    if not len(distance) or distance.min() <= crop_m:
        return ""
    return f"no point within {crop_m:g} m (nearest {distance.min():.4g} m)"
