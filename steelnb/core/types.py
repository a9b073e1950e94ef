"""Frozen types that the modules exchange.

Transforms are ``(4, 4)`` float64 arrays named ``T_target_source``, clouds ``(N, 3)`` float64 in metres with NaN rows
for invalid returns, times float64 seconds. World z is up; the drone frame is x forward, y left, z up (REP 103).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from steelnb.core import checks
from steelnb.core.checks import Array, IntArray
from steelnb.core.errors import InputError

__all__ = [
    "GRAVITY", "Array", "CameraImages", "Flight", "Floats", "GreyImage", "Imu", "IntArray", "Lines", "RangeScans",
    "Scan", "Segments", "Trajectory", "project", "shift_of", "translated", "unproject",
]  # fmt: skip

Floats = NDArray[np.float32]
SHIFT_FROM_M, SHIFT_STEP_M = 1e4, 100.0
"""What is farther than `SHIFT_FROM_M` from zero is shifted by multiples of `SHIFT_STEP_M`. UTM coordinates are that
large, coordinates of a site are not."""
GreyImage = NDArray[np.uint8]
"""``(H, W)``, 0 black to 255 white."""


def shift_of(position: Array) -> Array:
    """Origin ``(3,)`` for coordinates around a ``position (3,)``, metres: zero unless they are large.

    Voxel numbers and pictures need coordinates near zero. Subtract it from inputs, and add it to results.
    """
    if not np.abs(position).max() > SHIFT_FROM_M:
        return np.zeros(3)
    return SHIFT_STEP_M * np.round(position / SHIFT_STEP_M)


def translated(position: Array, by: Array) -> Array:
    """Positions ``(..., 3)`` moved by ``by (3,)``, metres, and rounded to 0.1 µm: a cloud that is moved from large map
    coordinates to the origin equals the same cloud there."""
    return np.round(position + by, 7)


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
        shape = np.shape(stamp_s)
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
        points = checks.checked_cloud(self.points, "Scan.points")
        if (points[..., 0] == 0).any():  # a tenth of the time of a look at all coordinates
            zero = (points == 0).all(axis=-1)
            points = np.where(zero[..., None], np.nan, points) if zero.any() else points
        checks.set_checked(self, stamp_s=checks.checked_stamp(self.stamp_s, "Scan.stamp_s"), points=points)

    def __repr__(self) -> str:
        count, fault = np.count_nonzero(np.isfinite(self.points).all(axis=-1)), self.fault and f", {self.fault}"
        return f"Scan({self.stamp_s:.3f} s, points {self.points.shape}, {count} finite{fault})"


class RangeScans(Sequence[Scan]):
    """Scans stored as range images, in a sixth of the memory; their points are computed on access.

    ``stamp_s (K,)``; ``range_m (K, H, W)`` float32 along the ray, NaN for no return; ``ray (H, W, 3)`` unit vectors in
    the sensor frame, whose x axis is the optical axis.
    """

    def __init__(self, stamp_s: Array, range_m: NDArray[np.float32], ray: Array) -> None:
        self.stamp_s, self.range_m, self.ray = stamp_s, range_m, ray

    def __getstate__(self) -> tuple[NDArray[Any], ...]:
        # Only the returns are stored, as most rays miss the structure.
        returned = ~np.isnan(self.range_m)
        return self.stamp_s, self.ray, np.packbits(returned), np.array(returned.shape), self.range_m[returned]

    def __setstate__(self, state: tuple[NDArray[Any], ...]) -> None:
        self.stamp_s, self.ray, bits, shape, returns_m = state
        self.range_m = np.full(shape, np.nan, np.float32)
        self.range_m[np.unpackbits(bits, count=self.range_m.size).reshape(shape).astype(bool)] = returns_m

    def __len__(self) -> int:
        return len(self.stamp_s)

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        if isinstance(index, slice):
            return RangeScans(self.stamp_s[index], self.range_m[index], self.ray)
        return Scan(float(self.stamp_s[index]), self.range_m[index][..., None] * self.ray)


@dataclass(frozen=True, eq=False)
class CameraImages:
    """N grey-value images, each rendered or read on access.

    ``stamp_s (N,)``: middles of the exposures, strictly increasing; ``images``: N arrays ``(H, W)``, None for an
    unreadable one; ``K (3, 3)``: intrinsics in OpenCV's pixel coordinates (origin at the centre of the first pixel, u
    right, v down); ``T_drone_camera (4, 4)``: the mount. The camera frame has x along the optical axis, y left and z
    up, so a point (x, y, z) projects to ``K @ (−y, −z, x)``, up to scale.
    """

    stamp_s: NDArray[np.float64]
    images: Sequence[GreyImage | None]
    K: NDArray[np.float64]
    T_drone_camera: NDArray[np.float64]

    def __post_init__(self) -> None:
        checks.set_checked(
            self,
            stamp_s=checks.checked_stamps(self.stamp_s, "CameraImages.stamp_s"),
            K=checks.checked_array(self.K, "CameraImages.K", (3, 3)),
            T_drone_camera=checks.checked_pose(self.T_drone_camera, "CameraImages.T_drone_camera"),
        )

    def __len__(self) -> int:
        return len(self.stamp_s)

    def at(self, stamp_s: float) -> int | None:
        """Index of the last image at or before ``stamp_s``; None if it is older than half the image period."""
        if not len(self):
            return None
        half_s = 0.5 * float(np.median(np.diff(self.stamp_s))) if len(self) > 1 else 0.05
        index = int(np.searchsorted(self.stamp_s, stamp_s + 1e-6)) - 1
        return index if index >= 0 and stamp_s - self.stamp_s[index] <= half_s else None


def project(points: NDArray[np.float64], K: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels ``(N, 2)``, u and v, of points ``(N, 3)`` in the camera frame; NaN where x is not positive."""
    x = np.where(points[:, 0] > 0, points[:, 0], np.nan)
    return np.column_stack([K[0, 2] - K[0, 0] * points[:, 1] / x, K[1, 2] - K[1, 1] * points[:, 2] / x])


def unproject(pixels: NDArray[np.float64], K: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points ``(N, 3)`` in the camera frame at depth x = 1 that project to pixels ``(N, 2)``."""
    right, down = (pixels[:, axis] - K[axis, 2] for axis in (0, 1))
    return np.column_stack([np.ones(len(pixels)), -right / K[0, 0], -down / K[1, 1]])


@dataclass(frozen=True, eq=False)
class Flight:
    """The input of every estimator, from a simulation, a bag or a folder of scans. It contains no ground truth.

    ``scans``: K scans in the sensor frame, in memory or on disk; ``prior``: the drifting poses of the drone at the
    scans; ``T_drone_sensor (4, 4)``: the sensor's mount; ``imu`` and ``images`` may be None; ``name``: for titles and
    files; ``facts``: the source of each part of a recording; ``skipped``: number of messages or files left out, by
    reason; ``range_sigmas``: standard deviations of scale and offset (m) of calibrated ranges, zero if unknown;
    ``path``: the drifting poses at their own rate, if they are more than those at the scans.
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
    path: Trajectory | None = None

    def __post_init__(self) -> None:
        sigmas = checks.checked_array(self.range_sigmas, "Flight.range_sigmas", (2,)).tolist()
        checks.set_checked(
            self,
            T_drone_sensor=checks.checked_pose(self.T_drone_sensor, "Flight.T_drone_sensor"),
            range_sigmas=tuple(checks.checked_number(each, "Flight.range_sigmas", 0) for each in sigmas),
            name=str(self.name),
        )
        stamp_s = getattr(self.scans, "stamp_s", None)  # known without reading the scans
        if stamp_s is None and isinstance(self.scans, list | tuple):
            stamp_s = [scan.stamp_s for scan in self.scans]
        known_s = self.prior.stamp_s if stamp_s is None else np.asarray(stamp_s)
        checks.check_length(self.scans, "Flight.scans", len(self.prior), "one a pose")
        checks.check_same_stamps(known_s, "Flight.scans", self.prior.stamp_s, "the poses in Flight.prior")

    def __len__(self) -> int:
        return len(self.prior)

    def __repr__(self) -> str:
        parts = [name for name in ("imu", "images") if getattr(self, name) is not None]
        return f"Flight({self.name!r}: {', '.join([f'{len(self)} scans{_span(self.prior.stamp_s)}', *parts])})"

    @property
    def origin(self) -> Array:
        """`shift_of` the first pose ``(3,)``: what estimators subtract from poses, and add to their results. Heights
        stay, as the floor of settings is one."""
        return shift_of(self.prior.position[0] * [1, 1, 0]) if len(self) else np.zeros(3)

    def moved(self, by: Array) -> "Flight":
        """The same flight with its poses translated by ``by (3,)``, metres; the same object if that is zero."""
        prior = self.prior.moved(by)
        return self if prior is self.prior else replace(self, prior=prior, path=self.path and self.path.moved(by))

    def first(self, count: int) -> "Flight":
        """The first ``count`` scans of the flight."""
        part = slice(checks.checked_integer(count, "count", 0))
        prior = Trajectory(self.prior.stamp_s[part], self.prior.T_world_drone[part])
        return replace(self, scans=self.scans[part], prior=prior)


def interpolated_poses(stamp_s: Array, T: Array, at_s: Array) -> Array:
    """Poses ``(..., 4, 4)`` at ``at_s (...)`` between those of ``T (N, 4, 4)`` at ``stamp_s (N,)``, N at least 2.

    Positions are interpolated linearly, rotations by slerp; before and after, the first and last pose hold.
    """
    inside = np.clip(at_s, stamp_s[0], stamp_s[-1]).ravel()
    result = np.tile(np.eye(4), (len(inside), 1, 1))
    result[:, :3, :3] = Slerp(stamp_s, Rotation.from_matrix(T[:, :3, :3]))(inside).as_matrix()
    for axis in range(3):
        result[:, axis, 3] = np.interp(inside, stamp_s, T[:, axis, 3])
    return result.reshape(*np.shape(at_s), 4, 4)


@dataclass(frozen=True, eq=False)
class Lines:
    """Infinite lines: ``anchor (M, 3)``, unit ``direction (M, 3)``, number of points ``count (M,)``, and ``label
    (N,)``, the line of each input point or −1."""

    anchor: Array
    direction: Array
    count: IntArray
    label: IntArray

    def __post_init__(self) -> None:
        rows = len(self.count)
        checks.set_checked(
            self,
            anchor=checks.checked_array(self.anchor, "Lines.anchor", (rows, 3)),
            direction=checks.checked_array(self.direction, "Lines.direction", (rows, 3)),
            count=checks.checked_integers(self.count, "Lines.count", (rows,), 0),
            label=checks.checked_integers(self.label, "Lines.label", ("N",), -1, rows - 1),
        )

    def __len__(self) -> int:
        return len(self.count)

    def __repr__(self) -> str:
        return f"Lines({len(self)} of {len(self.label)} points)"


@dataclass(frozen=True, eq=False)
class Segments:
    """Line segments, metres: ``start (M, 3)``, ``end (M, 3)``, number of points ``count (M,)``, and ``radius (M,)``,
    the root mean square distance of these points from the axis, NaN if unknown."""

    start: Array
    end: Array
    count: IntArray
    radius: Array

    def __post_init__(self) -> None:
        rows = len(self.count)
        checks.set_checked(
            self,
            start=checks.checked_array(self.start, "Segments.start", (rows, 3)),
            end=checks.checked_array(self.end, "Segments.end", (rows, 3)),
            count=checks.checked_integers(self.count, "Segments.count", (rows,), 0),
            radius=checks.checked_sizes(self.radius, "Segments.radius", rows),
        )

    def __len__(self) -> int:
        return len(self.count)

    def __repr__(self) -> str:
        return f"Segments({len(self)}, {self.length.sum():.2f} m in all)"

    @staticmethod
    def empty() -> "Segments":
        return Segments(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0))

    @staticmethod
    def joined(parts: "Iterable[Segments]") -> "Segments":
        """The segments of all parts, in order. Without parts there are none."""
        parts = [Segments.empty(), *parts]
        columns = zip(*((p.start, p.end, p.count, p.radius) for p in parts), strict=True)
        return Segments(*(np.concatenate(column) for column in columns))

    @property
    def length(self) -> Array:
        """Lengths ``(M,)`` in metres."""
        return np.linalg.norm(self.end - self.start, axis=1)

    @property
    def middle(self) -> Array:
        """Midpoints ``(M, 3)``."""
        return 0.5 * (self.start + self.end)

    @property
    def direction(self) -> Array:
        """Unit vectors from start to end ``(M, 3)``."""
        return (self.end - self.start) / np.maximum(self.length, 1e-12)[:, None]

    def transformed(self, T_target_source: Array) -> "Segments":
        """The same segments in another frame."""
        R, t = (T := checks.checked_pose(T_target_source, "T_target_source"))[:3, :3], T[:3, 3]
        return Segments(self.start @ R.T + t, self.end @ R.T + t, self.count, self.radius)

    def moved(self, by: Array) -> "Segments":
        """The segments translated by ``by (3,)``, metres."""
        return replace(self, start=self.start + checks.checked_array(by, "by", (3,)), end=self.end + by)

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> "Segments":
        """The segments selected by an index or a mask."""
        return Segments(self.start[index], self.end[index], self.count[index], self.radius[index])
