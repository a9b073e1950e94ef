"""Scans that are read one at a time, and the parts of a flight as its files hold them."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steelnb.errors import EmptyCloudError, FileMissingError, RecordingError, SteelnbError
from steelnb.files import plain_name
from steelnb.images import CameraImages
from steelnb.io.calibration import SensorCorrection
from steelnb.io.trajectories import rising
from steelnb.io.transforms import interpolate
from steelnb.points.ranges import true_points
from steelnb.types import Array, Flight, Imu, IntArray, Scan, Trajectory

Decode = Callable[[], Array]
Walk = Callable[[IntArray], Iterator[Decode]]
"""The scans with these rising numbers, each to be decoded by a call; a damaged file raises on the way."""


class Scans(Sequence[Scan]):
    """Scans in files: iterating reads them anew, one in memory at a time; an int or a slice reads those alone.

    ``stamp_s (K,)`` rises. A scan that cannot be read comes out without points and with `Scan.fault`. Points at
    (0, 0, 0), by which many drivers mark no return, are NaN.
    """

    def __init__(self, walk: Walk, number: IntArray, stamp_s: Array) -> None:
        self._walk, self._number, self.stamp_s = walk, number, stamp_s

    def __len__(self) -> int:
        return len(self._number)

    def __iter__(self) -> Iterator[Scan]:
        decodes = self._walk(self._number)
        return (_scan(float(stamp_s), decode) for stamp_s, decode in zip(self.stamp_s, decodes, strict=True))

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        """One scan for an int; `Scans` for a slice or a mask ``(K,)``."""
        picked = np.atleast_1d(self._number[index]), np.atleast_1d(self.stamp_s[index])
        found = Scans(self._walk, *picked)
        return next(iter(found)) if np.ndim(self._number[index]) == 0 else found


def _scan(stamp_s: float, decode: Decode) -> Scan:
    none = np.zeros((0, 3))
    try:
        points = decode()
    except FileMissingError as fault:
        return Scan(stamp_s, none, f"missing file: {fault}")
    except EmptyCloudError:
        return Scan(stamp_s, none, "empty cloud")
    except SteelnbError as fault:
        return Scan(stamp_s, none, f"unreadable scan: {fault}")
    if not points.size:
        return Scan(stamp_s, none, "empty cloud")
    zero = points[..., 0] == 0
    if zero.any() and (zero := zero & (points == 0).all(axis=-1)).any():
        points = points.copy()
        points[zero] = np.nan
    if not np.isfinite(points[..., 0]).any():  # a row with one invalid coordinate is NaN
        return Scan(stamp_s, none, "no finite point")
    return Scan(stamp_s, points)


@dataclass(frozen=True)
class Parts:
    """The parts of a flight as its files hold them: ``stamp_s (N,)`` of all scans, in the order of their numbers.

    ``poses`` are the drone's, at their own stamps.
    """

    stamp_s: Array
    walk: Walk
    poses: Trajectory
    T_drone_sensor: Array
    facts: dict[str, str]
    imu: Imu | None = None
    skipped: Counter[str] = field(default_factory=Counter)
    images: CameraImages | None = None

    def flight(self, path: Path, gap_max_s: float | None, errors: SensorCorrection | None = None) -> Flight:
        """The flight of those scans that have a rising stamp and a pose, without known ``errors`` of ranges and stamps.
        Raises `RecordingError` without any."""
        skipped, errors = Counter(self.skipped), errors or SensorCorrection()
        number = np.flatnonzero(rising(self.stamp_s, skipped))
        if not len(number):
            raise RecordingError(f"{path}: {len(self.stamp_s)} scans, none with a stamp; expected seconds that rise")
        stamp_s = self.stamp_s[number] + errors.time_offset_s
        T_world_drone, covered = interpolate(self.poses, stamp_s, gap_max_s)
        if not covered.any():
            raise RecordingError(
                f"{path}: no pose at any scan: {span(stamp_s)} of scans, {span(self.poses.stamp_s)} of poses"
            )
        if not covered.all():
            skipped["no pose within the gap"] += int((~covered).sum())
        prior = Trajectory(stamp_s[covered], T_world_drone[covered])
        facts = {**self.facts, "poses": f"{self.facts['poses']}: {described(self.poses)}"}
        facts |= {"errors": errors.described()} if errors != SensorCorrection() else {}
        scans = Scans(_corrected(self.walk, errors), number[covered], prior.stamp_s)
        name, left_out = plain_name(path.resolve()), dict(skipped)
        return Flight(scans, prior, self.T_drone_sensor, self.imu, name, facts, left_out, self.images)


def _corrected(walk: Walk, errors: SensorCorrection) -> Walk:
    """The same scans without known errors of their ranges."""
    if not (errors.range_offset_m or errors.range_scale):
        return walk

    def one(decode: Decode) -> Decode:
        return lambda: true_points(decode(), errors.range_offset_m, errors.range_scale)

    return lambda number: map(one, walk(number))


def described(trajectory: Trajectory) -> str:
    """Number, rate, length and time of poses, in words."""
    length_m = np.linalg.norm(np.diff(trajectory.position, axis=0), axis=1).sum()
    return f"{len(trajectory)}{rate(trajectory.stamp_s)}, {length_m:.1f} m long, from {span(trajectory.stamp_s)}"


def rate(stamp_s: Array) -> str:
    """Median rate of stamps, in words; nothing for fewer than two."""
    return f" at {1 / np.median(np.diff(stamp_s)):.4g} Hz" if len(stamp_s) > 1 else ""


def span(stamp_s: Array) -> str:
    """First and last stamp, in words."""
    return f"{stamp_s[0]:.3f} to {stamp_s[-1]:.3f} s" if len(stamp_s) else "nothing"


def subset(scans: Sequence[Scan], mask: NDArray[np.bool_]) -> Sequence[Scan]:
    """The scans of a mask ``(K,)``; those in files stay there."""
    return scans[mask] if isinstance(scans, Scans) else [scans[k] for k in np.flatnonzero(mask)]  # type: ignore[call-overload]
