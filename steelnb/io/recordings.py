"""Reader of recorded flights: bags, and folders of clouds with a trajectory. The truth is read separately."""

import os
from collections.abc import Callable, Iterator, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np

from steelnb.core.checks import checked_pose
from steelnb.core.errors import InputError
from steelnb.core.files import check_exists, display_name
from steelnb.core.geometry import transform_points
from steelnb.core.types import Array, Flight, IntArray, Scan, Trajectory
from steelnb.io.bags import SUFFIXES, is_bag, open_bag
from steelnb.io.folders import Recorded, Walk, open_folder
from steelnb.io.trajectories import interpolate, named_file, read_trajectory
from steelnb.io.transforms import T_OPTICAL_SENSOR, T_UP_DOWN, turned_up
from steelnb.settings.recording import RecordingOptions, read_options

UNREADABLE = "unreadable scan"
"""First words of the faults of scans that cannot be read."""


def read_flight(
    path: Path | str, options: RecordingOptions | None = None, *, T_drone_sensor: Array | None = None, **stated: Any
) -> Flight:
    """Open a recorded flight. Its scans are read one at a time during iteration.

    Parameters
    ----------
    path : a ROS 1 bag, an MCAP or sqlite file, a ROS 2 folder, a folder of such files that are parts of one recording,
        or a folder of clouds (PLY, PCD, LAS, LAZ, NPY, text) in the sensor frame with a trajectory of the drone.
    options : what the recording does not say itself. Each may be given by its name, too, as ``poses="/odom"``. What
        neither says is taken from a ``recording.toml`` in the folder or beside the bag.
    T_drone_sensor : pose ``(4, 4)`` of the sensor, instead of ``mount``.

    Returns a `Flight`. Its ``prior`` is interpolated at the stamps of the scans; ``facts`` say what was taken from
    where, with the numbers from which a person sees that it is wrong; ``skipped`` counts what was left out. Raises
    `InputError`, also if no scan can be read.
    """
    path, T_stated = Path(path), None if T_drone_sensor is None else checked_pose(T_drone_sensor, "T_drone_sensor")
    return open_flight(path, _stated(path, options, stated), T_stated)


def open_flight(path: Path, options: RecordingOptions, T_drone_sensor: Array | None = None) -> Flight:
    """`read_flight` with all ``options``, those of ``recording.toml`` included. Raises `InputError`."""
    check_exists(path, "a recording")
    T_stated = options.T_drone_sensor if T_drone_sensor is None else T_drone_sensor
    if is_bag(path):
        opened = open_bag(path, options, T_stated)
    elif path.is_dir():
        opened = _of_folder(path, options)
    else:
        expected = f"{', '.join(SUFFIXES)} or a folder; `steelnb segment` takes a single cloud"
        raise InputError(f"{path}: ending {path.suffix!r}; expected {expected}")
    stamp_s, walk, prior, T_mount, facts, imu, skipped = opened
    if T_stated is not None:
        T_mount, facts["mount"] = T_stated, "as stated"
    known = np.flatnonzero(~np.isnan(stamp_s))
    _, first = np.unique(stamp_s[known], return_index=True)
    number = known[first]  # by stamp
    skipped["scan whose stamp another one has"] += len(known) - len(number)
    T_world_drone, covered = interpolate(prior, stamp_s[number])
    skipped["scan without a pose at its time"] += int((~covered).sum())
    spans = [f"{each[0]:.3f} to {each[-1]:.3f} s" for each in (stamp_s[number], prior.stamp_s) if len(each)]
    if not covered.any():
        remedy = "--time-offset SECONDS" + (", or --clock bag" if is_bag(path) else ", or --stamps UNIT")
        raise InputError(f"{path}: no scan has a pose: scans at {spans[0]}, poses at {spans[-1]}; expected {remedy}")
    number, poses_at = number[covered], Trajectory(stamp_s[number][covered], T_world_drone[covered])
    height_m, way_m = prior.position[:, 2], np.linalg.norm(np.diff(prior.position, axis=0), axis=1).sum()
    facts["scans"] += f", {spans[0]}"
    facts["poses"] += (
        f", {len(prior)}, {spans[1]}; a path of {way_m:.1f} m, z from {height_m.min():.1f} to {height_m.max():.1f} m"
    )
    T_sensor_file = None
    if not is_bag(path) and options.optical is not None:
        facts["frames"] += f"; points have {'z' if options.optical else 'x'} ahead, as stated"
        T_sensor_file = np.linalg.inv(T_OPTICAL_SENSOR)[None] if options.optical else None
    if options.scans_in == "world":
        facts["frames"] += "; points are in the world, as stated, and brought back by the poses"
        facts["mount"] = facts["mount"] if T_stated is not None else "identity, as the points are in the world"
        T_sensor_file = np.linalg.inv(poses_at.T_world_drone @ T_mount)
        T_sensor_file = T_sensor_file @ T_UP_DOWN if options.world == "ned" else T_sensor_file
    found = Scans(walk, number, poses_at.stamp_s, T_sensor_file)
    faults = [*takewhile(bool, (scan.fault for scan in found))]
    if len(faults) == len(found):
        raise InputError(f"{path}: none of {len(found)} scans can be read; the first: {faults[0]}")
    counts = {reason: count for reason, count in skipped.items() if count}
    return Flight(found, poses_at, T_mount, imu, display_name(path.resolve()), facts, counts, path=prior)


def _of_folder(path: Path, options: RecordingOptions) -> Recorded:
    """A folder of clouds, whose poses have z up. Raises `InputError` for options that only a bag has."""
    if options.clock == "bag" or options.imu:
        what = f"--imu {options.imu}" if options.imu else "--clock bag"
        raise InputError(f"{path}: {what}; expected a bag, as clouds in files have only their own stamps")
    opened = open_folder(path, options)
    facts = {"frames": "the scans are the sensor's, x ahead, z up", "clock": "stamps of the files", **opened.facts}
    prior = turned_up(opened.prior, "", True) if options.world == "ned" else opened.prior
    return opened._replace(stamp_s=opened.stamp_s + options.time_offset, prior=prior, facts=facts)


def read_truth(path: Path | str, options: RecordingOptions | None = None, **stated: Any) -> Trajectory | None:
    """True poses of the drone for evaluation, or None if unknown.

    ``truth`` among the options names a trajectory file; by default it is ``STEM.truth.tum`` beside the recording, or
    ``groundtruth.tum`` in a folder of clouds. Raises `InputError`.
    """
    return find_truth(Path(path), _stated(Path(path), options, stated))


def find_truth(path: Path, options: RecordingOptions) -> Trajectory | None:
    """`read_truth` with all ``options``, those of ``recording.toml`` included. Raises `InputError`."""
    if options.truth is not None:
        truth = read_trajectory(named_file(folder_of(path), options.truth), options)
        return turned_up(truth, "", True) if options.world == "ned" else truth
    candidates = [truth_path(path), path / "groundtruth.tum", path / "groundtruth.txt"]
    return next((read_trajectory(file) for file in candidates if file.is_file()), None)


def _stated(path: Path, options: RecordingOptions | None, stated: dict[str, Any]) -> RecordingOptions:
    """The keys of ``recording.toml``, then the fields that ``options`` were made with, then single ones."""
    given = options.model_dump(exclude_unset=True) if options else {}
    return read_options(folder_of(path), **given | stated)


def folder_of(path: Path) -> Path:
    """The folder in which ``recording.toml`` of a recording is: the recording itself, or that of its file."""
    return path if os.path.isdir(path) else path.parent  # is_dir raises for a name that is too long


def truth_path(path: Path) -> Path:
    """Path of the truth of a recording: X.truth.tum for X.bag and for the folder X."""
    path = path.resolve()
    return path.with_name(f"{path.stem if is_bag(path) and not os.path.isdir(path) else path.name}.truth.tum")


class Scans(Sequence[Scan]):
    """Scans in files. Every iteration reads them again, one in memory at a time; indexing reads only those selected.

    ``stamp_s (K,)`` increases. Points become ``T_sensor_file (K or 1, 4, 4)`` times those of the files. A scan that
    cannot be read has no points, and `Scan.fault` says why.
    """

    def __init__(self, walk: Walk, number: IntArray, stamp_s: Array, T_sensor_file: Array | None = None) -> None:
        self._walk, self._number, self.stamp_s, self._T = walk, number, stamp_s, T_sensor_file

    def __len__(self) -> int:
        return len(self._number)

    def __iter__(self) -> Iterator[Scan]:
        for k, (stamp_s, decode) in enumerate(zip(self.stamp_s.tolist(), self._in_order(), strict=True)):
            yield _scan(stamp_s, decode, None if self._T is None else self._T[k % len(self._T)])

    def _in_order(self) -> Iterator[Callable[[], Array]]:
        """Decoders by stamp; a scan that was recorded too early waits for those before it."""
        recorded, waiting = np.sort(self._number), dict[int, Callable[[], Array]]()
        coming = zip(recorded.tolist(), self._walk(recorded), strict=True)
        for wanted in self._number.tolist():
            while wanted not in waiting:
                waiting |= [next(coming)]
            yield waiting.pop(wanted)

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        chosen = np.atleast_1d(np.arange(len(self))[index])
        T = self._T if self._T is None or len(self._T) == 1 else self._T[chosen]
        found = Scans(self._walk, self._number[chosen], self.stamp_s[chosen], T)
        return next(iter(found)) if np.ndim(self._number[index]) == 0 else found


def _scan(stamp_s: float, decode: Callable[[], Array], T_sensor_file: Array | None) -> Scan:
    try:
        points = decode()
    except InputError as fault:  # a damaged message or file only loses one scan
        return Scan(stamp_s, np.zeros((0, 3)), f"{UNREADABLE}: {fault}")
    scan = Scan(stamp_s, points)  # points at zero are no returns
    if T_sensor_file is not None:
        scan = Scan(stamp_s, transform_points(T_sensor_file, scan.points))
    return scan if np.isfinite(scan.points).any() else Scan(stamp_s, np.zeros((0, 3)), "no finite point")
