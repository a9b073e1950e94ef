"""Frozen types that the modules exchange.

Transforms are ``(4, 4)`` float64 arrays named ``T_target_source``, clouds ``(N, 3)`` float64 in metres with NaN rows
for invalid returns, times float64 seconds. World z is up; the drone frame is x forward, y left, z up (REP 103).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steelnb.core import checks
from steelnb.core.arrays import without_zeros
from steelnb.core.errors import InputError
from steelnb.core.images import CameraImages
from steelnb.core.segments import Array, IntArray, Lines, Segments

__all__ = ["GRAVITY", "Array", "Flight", "Floats", "Imu", "IntArray", "Lines", "Scan", "Segments", "Trajectory"]

Floats = NDArray[np.float32]


def _span(stamp_s: Array) -> str:
    return f", {stamp_s[0]:.3f} to {stamp_s[-1]:.3f} s" if len(stamp_s) else ""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of the drone: ``stamp_s (N,)``, strictly increasing, and ``T_world_drone (N, 4, 4)``. Arrays are shared."""

    stamp_s: Array
    T_world_drone: Array

    def __post_init__(self) -> None:
        stamp_s = checks.checked_stamps(self.stamp_s, "Trajectory.stamp_s")
        T = checks.checked_poses(self.T_world_drone, "Trajectory.T_world_drone", len(stamp_s))
        checks.set_checked(self, stamp_s=stamp_s, T_world_drone=T)

    def __len__(self) -> int:
        return len(self.stamp_s)

    def __repr__(self) -> str:
        metres = np.linalg.norm(np.diff(self.position, axis=0), axis=1).sum()
        return f"Trajectory({len(self)} poses{_span(self.stamp_s)}, {metres:.1f} m)"

    @property
    def position(self) -> Array:
        """Positions in the world frame, ``(N, 3)`` metres."""
        return self.T_world_drone[:, :3, 3]

    def moved(self, by: Array) -> "Trajectory":
        """The poses translated by ``by (3,)``, metres; the same object if that is zero."""
        from steelnb.core.geometry import translated  # imports this module

        if not checks.checked_array(by, "by", (3,)).any():
            return self
        T_world_drone = self.T_world_drone.copy()
        T_world_drone[:, :3, 3] = translated(T_world_drone[:, :3, 3], by)
        return Trajectory(self.stamp_s, T_world_drone)

    def at(self, stamp_s: Array) -> "Trajectory":
        """The poses at ``stamp_s (K,)``, to within a microsecond at any epoch. Raises `InputError` if one is
        missing."""
        stamp_s = checks.checked_array(stamp_s, "stamp_s", ("K",))
        index = np.searchsorted(self.stamp_s, stamp_s - checks.SAME_S)
        found_s = np.append(self.stamp_s, np.inf)[index]
        missing = stamp_s[found_s - stamp_s > checks.SAME_S]
        if len(missing):
            raise InputError(f"no pose at {len(missing)} of {len(stamp_s)} stamps, such as {missing[0]!s} s; {self}")
        return Trajectory(self.stamp_s[index], self.T_world_drone[index])

    def between(self, stamp_s: Array) -> Array:
        """Poses ``(..., 4, 4)`` at any ``stamp_s (...)``: positions interpolated linearly, rotations by slerp, clamped
        to the first and last pose. Raises `InputError` with fewer than two poses."""
        from steelnb.core.geometry import interpolated_poses  # imports this module

        try:
            shape = np.shape(stamp_s)
        except ValueError:
            raise InputError("stamp_s: lists of several lengths; expected an array of real numbers") from None
        stamp_s = checks.checked_array(np.ravel(stamp_s), "stamp_s", ("K",)).reshape(shape)
        if len(self) < 2:
            raise InputError(f"a trajectory of {len(self)} poses: expected at least two to interpolate")
        return interpolated_poses(self.stamp_s, self.T_world_drone, stamp_s)


GRAVITY = 9.81
"""m/s², towards −z of the world."""


@dataclass(frozen=True, eq=False)
class Imu:
    """Specific force ``(N, 3)`` in m/s² and angular rate ``(N, 3)`` in rad/s, drone frame, at ``stamp_s (N,)``."""

    stamp_s: Array
    specific_force: Array
    angular_rate: Array

    def __post_init__(self) -> None:
        checks.set_checked(self, stamp_s=checks.checked_stamps(self.stamp_s, "Imu.stamp_s"))
        for name in ("specific_force", "angular_rate"):
            values = checks.checked_array(getattr(self, name), f"Imu.{name}", (len(self.stamp_s), 3))
            checks.set_checked(self, **{name: values})

    def __repr__(self) -> str:
        return f"Imu({len(self.stamp_s)} readings{_span(self.stamp_s)})"


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan: points ``(H, W, 3)`` or ``(N, 3)`` in the sensor frame, metres; invalid returns are NaN. Points at
    exactly zero become NaN: many drivers write them for no return. Without such points, a contiguous array is shared.

    ``fault``: why a scan of a recording has no points, such as "unreadable file"; else empty.
    """

    stamp_s: float
    points: Array
    fault: str = ""

    def __post_init__(self) -> None:
        stamp_s = checks.checked_stamp(self.stamp_s, "Scan.stamp_s")
        checks.checked_kind(self.fault, "Scan.fault", str)
        points = without_zeros(checks.checked_cloud(self.points, "Scan.points"))
        checks.set_checked(self, stamp_s=stamp_s, points=points)

    def __repr__(self) -> str:
        count, fault = np.count_nonzero(np.isfinite(self.points).all(axis=-1)), self.fault and f", {self.fault}"
        return f"Scan({self.stamp_s:.3f} s, points {self.points.shape}, {count} finite{fault})"


@dataclass(frozen=True, eq=False)
class Flight:
    """The input of every estimator, from a simulation, a bag or a folder of scans. It contains no ground truth.

    ``scans``: K scans in the sensor frame, in memory or on disk; ``prior``: the drifting poses of the drone at the
    scans; ``T_drone_sensor (4, 4)``: the sensor's mount; ``imu`` and ``images`` may be None; ``name``: for titles and
    files; ``facts``: the source of each part of a recording; ``skipped``: number of messages or files left out, by
    reason; ``range_sigmas``: standard deviations of scale and offset (m) of calibrated ranges, zero if unknown.
    """

    scans: Sequence[Scan]
    prior: Trajectory
    T_drone_sensor: Array
    imu: Imu | None = None
    name: str = "flight"
    facts: Mapping[str, str] = field(default_factory=dict)
    skipped: Mapping[str, int] = field(default_factory=dict)
    images: CameraImages | None = None
    range_sigmas: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        checks.set_checked(self, T_drone_sensor=checks.checked_pose(self.T_drone_sensor, "Flight.T_drone_sensor"))
        for name, kind in (
            ("prior", Trajectory), ("imu", Imu | None), ("images", CameraImages | None), ("name", str | Path),
            ("facts", Mapping), ("skipped", Mapping),
        ):  # fmt: skip
            checks.checked_kind(getattr(self, name), f"Flight.{name}", kind)
        both = checks.checked_array(self.range_sigmas, "Flight.range_sigmas", (2,)).tolist()
        sigmas = tuple(checks.checked_number(each, "Flight.range_sigmas", 0) for each in both)
        checks.set_checked(self, range_sigmas=sigmas, name=str(self.name))
        checks.check_sequence(self.scans, "Flight.scans", "Scan")
        stamp_s = getattr(self.scans, "stamp_s", None)  # known without reading the scans
        if stamp_s is None and isinstance(self.scans, list | tuple):
            stamp_s = [checks.checked_kind(s, f"Flight.scans[{k}]", Scan).stamp_s for k, s in enumerate(self.scans)]
        known_s = self.prior.stamp_s if stamp_s is None else np.asarray(stamp_s)
        checks.check_length(self.scans, "Flight.scans", len(self.prior), "one a pose")
        checks.check_same_stamps(known_s, "Flight.scans", self.prior.stamp_s, "the poses in Flight.prior")

    def __len__(self) -> int:
        return len(self.prior)

    def __repr__(self) -> str:
        parts = [name for name in ("imu", "images") if getattr(self, name) is not None]
        return f"Flight({self.name!r}: {', '.join([f'{len(self)} scans{_span(self.prior.stamp_s)}', *parts])})"

    def moved(self, by: Array) -> "Flight":
        """The same flight with its poses translated by ``by (3,)``, metres."""
        return replace(self, prior=self.prior.moved(by))

    def first(self, count: int) -> "Flight":
        """The first ``count`` scans of the flight."""
        part = slice(checks.checked_integer(count, "count", 0))
        prior = Trajectory(self.prior.stamp_s[part], self.prior.T_world_drone[part])
        return replace(self, scans=self.scans[part], prior=prior)
