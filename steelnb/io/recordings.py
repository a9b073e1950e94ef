"""Reader of recorded flights: bags, and folders of clouds with a trajectory. The truth is read separately."""

import os
from collections.abc import Callable, Iterator, Sequence
from itertools import takewhile
from pathlib import Path

import numpy as np

from steelnb.core.arguments import checks_arguments
from steelnb.core.checks import checked_pose
from steelnb.core.errors import InputError
from steelnb.core.files import check_exists, display_name
from steelnb.core.types import Array, Flight, IntArray, Scan, Trajectory
from steelnb.io.bags import open_bag
from steelnb.io.clocks import OF_BAG, ONE_CLOCK, Clock, in_order
from steelnb.io.clouds import READERS
from steelnb.io.containers import is_bag
from steelnb.io.encodings import foreign_file
from steelnb.io.folders import TRUE, named_file, open_clouds
from steelnb.io.frames import note_on_rotations
from steelnb.io.opened import Walk
from steelnb.io.trajectories import interpolate, read_trajectory

CLOCKS = ("stamps", "bag")
OFFSET_MAX_S = 1e10
"""Three centuries, more than any two clocks differ."""
RISING_MIN = 0.5
"""If fewer of the stamps rise, the clock is of no use."""
WEIGHTS = np.array([1.0, np.e, np.pi])
"""The sum of the coordinates with these weights differs from place to place."""
UNREADABLE = "unreadable scan"
"""First words of the faults of scans that cannot be read."""
FAR_M = 1e6
"""No sensor sees farther. A few such points are no returns; if most are so, the scan is not in metres."""
SAMPLE, REPEATED_MIN, REPEATED_LEAST = 1000, 0.02, 9
"""Number of points of a scan that are compared, and minima, as a share and as a number, of those at one place, which is
no return."""


@checks_arguments
def read_flight(
    path: Path | str,
    *,
    scans: str | None = None,
    poses: str | None = None,
    imu: str | None = None,
    T_drone_sensor: Array | None = None,
    clock: str = "stamps",
    time_offset_s: float = 0.0,
) -> Flight:
    """Open a recorded flight. Its scans are read one at a time during iteration.

    Parameters
    ----------
    path : a ROS 1 bag, an MCAP or sqlite file, a ROS 2 folder, a folder of such files that are parts of one recording,
        or a folder of clouds (PLY, PCD, LAS, LAZ, NPY, XYZ) in the sensor frame with a trajectory of the drone (TUM).
    scans : topic or sub-folder of the scans; by default the only one of a suitable type.
    poses : topic or trajectory file of the drone's drifting poses, or frames of tf such as "odom>base_link"; by default
        the only topic, or tf.
    imu : topic of the IMU; by default the first that measures all.
    T_drone_sensor : pose ``(4, 4)`` of the sensor; by default that of tf, or the identity if unknown.
    clock : "stamps" of the messages, or those of the "bag", the times at which messages were recorded.
    time_offset_s : added to the stamps of the scans, seconds, if their clock is off that of the poses.

    Returns a `Flight`. Its ``prior`` is interpolated at the stamps of the scans, its ``facts`` name the topics, the
    frames and the mount, with ``notes`` on what contradicted itself, and ``skipped`` counts dropped scans and poses.
    Raises `InputError`, also if no scan can be read.
    """
    path = Path(path)
    if T_drone_sensor is not None:
        T_drone_sensor = checked_pose(T_drone_sensor, "T_drone_sensor")
    check_exists(path, "a recording")
    if not path.is_dir() and not is_bag(path):
        what = foreign_file(path)
        remedy = "; `steelnb segment` takes a single cloud" if path.suffix.lower() in READERS else ""
        ending = f"ending {path.suffix!r}; expected .bag, .mcap, .db3 or a folder{remedy}"
        raise InputError(f"{path}: is {what}" if what else f"{path}: {ending}")
    if clock not in CLOCKS or not abs(time_offset_s) < OFFSET_MAX_S:
        expected = f"{' or '.join(CLOCKS)}, and seconds below {OFFSET_MAX_S:g}"
        raise InputError(f"clock {clock!r} with {time_offset_s:g} s; expected {expected}")
    remedy = ONE_CLOCK.format("SECONDS", OF_BAG if is_bag(path) else "")
    if is_bag(path):
        opened = open_bag(path, scans, poses, imu, T_drone_sensor, Clock(clock == "bag", time_offset_s))
    else:
        if clock == "bag" or imu:
            what = f"IMU {imu}" if imu else "clock 'bag'"
            raise InputError(f"{path}: {what}; expected a bag, as clouds in files have only their own stamps")
        held = [each for each in sorted(path.glob("[!.]*")) if each.suffix.lower() in READERS or is_bag(each)]
        bags = [each.name for each in held if each.suffix.lower() not in READERS]
        if bags and len(bags) == len(held):
            raise InputError(f"{path}: bags in it: {', '.join(bags)}; expected one of them")
        opened = open_clouds(path, scans, poses)
        opened = opened._replace(stamp_s=opened.stamp_s + time_offset_s)
    stamp_s, walk, prior, mount, facts, readings, skipped = opened
    if T_drone_sensor is not None:
        mount, facts["mount"] = T_drone_sensor, "as given"
    if note := note_on_rotations(prior.T_world_drone):
        facts["notes"] = "; ".join(filter(None, (facts.get("notes"), note)))
    number, usable = in_order(stamp_s), int((~np.isnan(stamp_s)).sum())
    skipped["scan whose stamp does not rise"] += usable - len(number)
    if len(number) < RISING_MIN * usable:
        span = f"{np.nanmin(stamp_s):.3f} to {np.nanmax(stamp_s):.3f} s"
        raise InputError(f"{path}: stamps of {usable} scans, {span}, rise only {len(number)} times; {remedy}")
    T_world_drone, covered = interpolate(prior, stamp_s[number])
    skipped["scan without a pose near"] += int((~covered).sum())
    if not covered.any():
        seconds = [f"{each[0]:.3f} to {each[-1]:.3f} s" for each in (stamp_s[number], prior.stamp_s)]
        raise InputError(f"{path}: no scan has a pose: scans at {seconds[0]}, poses at {seconds[1]}; {remedy}")
    number = number[covered]
    poses_at = Trajectory(stamp_s[number], T_world_drone[covered])
    skipped_counts = {reason: count for reason, count in skipped.items() if count}
    found = Scans(walk, number, poses_at.stamp_s)
    faults = [*takewhile(bool, (scan.fault for scan in found))]
    if len(faults) == len(found):
        raise InputError(f"{path}: none of {len(found)} scans can be read; the first: {faults[0]}")
    return Flight(found, poses_at, mount, readings, display_name(path.resolve()), facts, skipped_counts)


@checks_arguments
def read_truth(path: Path | str, *, truth: str | None = None) -> Trajectory | None:
    """True poses of the drone for evaluation, or None if unknown.

    ``truth`` names a trajectory file; by default ``STEM.truth.tum`` beside the recording, or ``groundtruth.tum`` in a
    folder of clouds. Raises `InputError`.
    """
    path = Path(path)
    if truth is None:
        candidates = [truth_path(path), *(path / name for name in TRUE)]
        return next((read_trajectory(file) for file in candidates if file.is_file()), None)
    return read_trajectory(named_file(path, truth))


def truth_path(path: Path) -> Path:
    """Path of the truth of a recording: X.truth.tum for X.bag and for the folder X."""
    path = path.resolve()
    return path.with_name(f"{path.stem if is_bag(path) and not os.path.isdir(path) else path.name}.truth.tum")


class Scans(Sequence[Scan]):
    """Scans in files. Every iteration reads them again, one in memory at a time; indexing reads only those selected.

    ``stamp_s (K,)`` increases. A scan that cannot be read has no points, and `Scan.fault` says why. Points at
    (0, 0, 0), at any other place that many share, and beyond `FAR_M` become NaN: drivers write such for no return.
    """

    def __init__(self, walk: Walk, number: IntArray, stamp_s: Array) -> None:
        self._walk, self._number, self.stamp_s = walk, number, stamp_s

    def __len__(self) -> int:
        return len(self._number)

    def __iter__(self) -> Iterator[Scan]:
        return map(_scan, self.stamp_s.tolist(), self._in_order())

    def _in_order(self) -> Iterator[Callable[[], Array]]:
        """Decoders by stamp; a scan that was recorded too early waits for those before it."""
        recorded, waiting = np.sort(self._number), dict[int, Callable[[], Array]]()
        coming = zip(recorded.tolist(), self._walk(recorded), strict=True)
        for wanted in self._number.tolist():
            while wanted not in waiting:
                waiting |= [next(coming)]
            yield waiting.pop(wanted)

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        found = Scans(self._walk, np.atleast_1d(self._number[index]), np.atleast_1d(self.stamp_s[index]))
        return next(iter(found)) if np.ndim(self._number[index]) == 0 else found


def _scan(stamp_s: float, decode: Callable[[], Array]) -> Scan:
    try:
        points = decode()
    except InputError as fault:  # a damaged message or file only loses one scan
        return Scan(stamp_s, np.zeros((0, 3)), f"{UNREADABLE}: {fault}")
    if max(np.fmax.reduce(points, axis=None, initial=0), -np.fmin.reduce(points, axis=None, initial=0)) > FAR_M:
        points = np.where((np.abs(points) >= np.finfo(np.float32).max).any(axis=-1, keepdims=True), np.nan, points)
        far = np.asarray((np.abs(points) > FAR_M).any(axis=-1))
        if far.sum() > np.isfinite(points).all(axis=-1).sum() / 2:
            return Scan(stamp_s, np.zeros((0, 3)), f"{UNREADABLE}: {far.sum()} points beyond {FAR_M:g} m")
        points = np.where(far[..., None], np.nan, points)
    sample = points.reshape(-1, 3)[:: points.size // (3 * SAMPLE) + 1]
    with np.errstate(invalid="ignore", over="ignore"):
        _, first, counts = np.unique(sample @ WEIGHTS, return_index=True, return_counts=True, equal_nan=False)
    for place in sample[first[counts > max(REPEATED_MIN * len(sample), REPEATED_LEAST)]]:
        points = np.where((points == place).all(axis=-1, keepdims=True), np.nan, points)
    scan = Scan(stamp_s, points)
    return scan if np.isfinite(scan.points).any() else Scan(stamp_s, np.zeros((0, 3)), "no finite point")
