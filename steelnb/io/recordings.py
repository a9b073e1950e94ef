"""Files → `Flight`: bags, and folders of clouds with a trajectory. The truth is read apart."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from steelnb.errors import InputError
from steelnb.io.bags import CAMERA, CLOUD, IMU, ODOMETRY, POSE, TF, Bag, is_bag
from steelnb.io.clouds import READERS, read_points
from steelnb.io.trajectories import interpolate, read_trajectory
from steelnb.types import Array, Flight, Imu, IntArray, Scan, Trajectory

TRUE = ("groundtruth.tum", "groundtruth.txt")
Walk = Callable[[IntArray], Iterator[Callable[[], Array]]]
"""The scans with these rising numbers, each to be decoded by a call."""


def read_flight(
    path: Path | str,
    *,
    scans: str | None = None,
    poses: str | None = None,
    T_drone_sensor: Array | None = None,
) -> Flight:
    """Open a recorded flight; its scans are read one at a time as they are iterated over.

    Parameters
    ----------
    path : a ROS 1 bag, an MCAP or sqlite file, a ROS 2 folder, or a folder of clouds (PLY, PCD, LAS, LAZ, NPY, XYZ) in
        the sensor frame with a trajectory of the drone (TUM).
    scans : topic or sub-folder of the scans; by default the only one of a fitting type.
    poses : topic or trajectory file of the drone's drifting poses; by default the only one, or tf.
    T_drone_sensor : mount of the sensor ``(4, 4)``; by default by tf_static, else the identity.

    Returns a `Flight` whose ``prior`` is interpolated at the scans, whose ``facts`` name topics and mount, and whose
    ``skipped`` counts what was left out. Raises `InputError`.
    """
    path = Path(path)
    stamp_s, walk, prior, mount, facts, imu, skipped = _opener(path)(path, scans, poses)
    if T_drone_sensor is not None:
        mount, facts["mount"] = T_drone_sensor, "as given"
    number = np.flatnonzero(np.diff(np.maximum.accumulate(stamp_s), prepend=-np.inf) > 0)
    skipped["scan whose stamp does not rise"] += len(stamp_s) - len(number)
    T_world_drone, covered = interpolate(prior, stamp_s[number])
    skipped["scan without a pose near"] += int((~covered).sum())
    if not covered.any():
        seconds = [f"{each[0]:.3f} to {each[-1]:.3f} s" for each in (stamp_s, prior.stamp_s)]
        raise InputError(f"{path}: no pose at any scan: scans at {seconds[0]}, poses at {seconds[1]}")
    number = number[covered]
    poses_at = Trajectory(stamp_s[number], T_world_drone[covered])
    left_out = {reason: count for reason, count in skipped.items() if count}
    return Flight(Scans(walk, number, poses_at.stamp_s), poses_at, mount, imu, path.resolve().name, facts, left_out)


def read_truth(path: Path | str, *, truth: str | None = None) -> Trajectory | None:
    """The true poses of the drone beside a recorded flight, for judging alone; None where there are none.

    ``truth`` names a trajectory file; by default ``STEM.truth.tum`` beside the recording, or ``groundtruth.tum`` in a
    folder of clouds. Raises `InputError`.
    """
    path = Path(path)
    if truth is None:
        known = [truth_path(path), *(path / name for name in TRUE)]
        return next((read_trajectory(file) for file in known if file.is_file()), None)
    return read_trajectory(_named_file(path, truth))


def truth_path(path: Path) -> Path:
    """Where the truth of a recording lies: X.truth.tum for X.bag and for the folder X."""
    path = path.resolve()
    return path.with_name(f"{path.stem if is_bag(path) and not path.is_dir() else path.name}.truth.tum")


class Scans(Sequence[Scan]):
    """Scans in files: iterating reads them anew, one in memory at a time; an int or a slice reads those alone.

    ``stamp_s (K,)`` rises. A scan that cannot be read has no points, and `Scan.fault` says why. Points at (0, 0, 0), by
    which many drivers mark no return, are NaN.
    """

    def __init__(self, walk: Walk, number: IntArray, stamp_s: Array) -> None:
        self._walk, self._number, self.stamp_s = walk, number, stamp_s

    def __len__(self) -> int:
        return len(self._number)

    def __iter__(self) -> Iterator[Scan]:
        return map(_scan, self.stamp_s.tolist(), self._walk(self._number))

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        found = Scans(self._walk, np.atleast_1d(self._number[index]), np.atleast_1d(self.stamp_s[index]))
        return next(iter(found)) if np.ndim(self._number[index]) == 0 else found


def _scan(stamp_s: float, decode: Callable[[], Array]) -> Scan:
    try:
        points = decode()
    except InputError as fault:  # a damaged message or file costs one scan
        return Scan(stamp_s, np.zeros((0, 3)), f"unreadable scan: {fault}")
    zero = (points == 0).all(axis=-1)
    if zero.any():
        points = np.where(zero[..., None], np.nan, points)
    if not np.isfinite(points).any():
        return Scan(stamp_s, np.zeros((0, 3)), "no finite point")
    return Scan(stamp_s, points)


_Parts = tuple[Array, Walk, Trajectory, Array, dict[str, str], Imu | None, Counter[str]]
"""Stamps of all scans, the scans, the drone's poses, the mount, facts, the IMU, and what was skipped."""


def _opener(path: Path) -> Callable[[Path, str | None, str | None], _Parts]:
    if not path.exists():
        raise InputError(f"{path}: does not exist; expected a recording")
    if not path.is_dir() and not is_bag(path):
        raise InputError(f"{path}: ending {path.suffix!r}; expected .bag, .mcap, .db3 or a folder")
    return _open_bag if is_bag(path) else _open_clouds


def _open_bag(path: Path, scans: str | None, poses: str | None) -> _Parts:
    bag = Bag(path)
    clouds, moving, inertial = bag.of_type(CLOUD), bag.of_type(*TF), bag.of_type(IMU)[:1]
    seen = bag.choose("clouds (PointCloud2 or depth images)", scans, clouds or bag.depth_images())
    in_file = poses is not None and poses not in bag.types and Path(poses).is_file()
    possible = bag.of_type(ODOMETRY, POSE)
    by_topic = [] if in_file or not (possible or poses or not moving) else [bag.choose("poses", poses, possible)]
    bag.read(seen, *by_topic, *moving, *inertial, *([] if clouds else bag.of_type(CAMERA)))
    source = str(poses) if in_file else by_topic[0] if by_topic else bag.poses_of_tf()
    prior = read_trajectory(source, bag.skipped) if in_file else bag.poses(source)
    body, (to_points, optical) = bag.frame_of.get(source, ""), bag.to_points(seen)
    mount, mounted = bag.mount(body, bag.frame_of.get(seen, ""), optical)
    facts = {"scans": f"{seen} ({bag.types[seen].rpartition('/')[2]})", "poses": source, "mount": mounted}
    facts |= {"imu": inertial[0]} if inertial else {}
    imu = bag.imu(inertial[0], body) if inertial else None
    return bag.stamp_s(seen), partial(bag.walk, seen, to_points), prior, mount, facts, imu, bag.skipped


def _open_clouds(path: Path, scans: str | None, poses: str | None) -> _Parts:
    """A folder of clouds: its files by the numbers in their names, 9 before 10.

    Stamps are in the names, as seconds with a decimal point or as whole nanoseconds; else they are those of the poses,
    of which there must be as many.
    """
    folder, skipped = path / scans if scans else path, Counter[str]()
    files = [file for file in folder.glob("[!.]*") if file.suffix.lower() in READERS and file.suffix.lower() != ".txt"]
    if not files:
        raise InputError(f"{folder}: no clouds in it; expected files that end with {', '.join(READERS)}")
    files.sort(key=lambda file: ([float(number) for number in re.findall(r"\d+(?:\.\d+)?", file.stem)], file.stem))
    texts = [file for file in sorted(path.iterdir()) if file.suffix.lower() in (".tum", ".txt")]
    found = [_named_file(path, poses)] if poses else [file for file in texts if file.name not in TRUE]
    if len(found) != 1:
        listed = ", ".join(file.name for file in found) or "no trajectory"
        raise InputError(f"{path}: {listed}; expected one TUM file (.tum, .txt), or the name of the poses'")
    prior = read_trajectory(found[0], skipped)
    words = [(re.findall(r"\d+(?:\.\d+)?", file.stem) or [""])[-1] for file in files]
    stamp_s = prior.stamp_s
    if all("." in word or len(word) >= 16 for word in words):
        stamp_s = np.array([float(word) if "." in word else int(word) / 10**9 for word in words])
    elif len(prior) != len(files):
        raise InputError(
            f"{path}: {len(files)} clouds, no stamps in their names, and {len(prior)} poses in {found[0].name}; "
            "expected as many poses, or stamps"
        )
    facts = {"scans": f"{len(files)} files", "poses": found[0].name, "mount": "taken as the drone's own frame"}
    walk: Walk = lambda number: (partial(read_points, files[k]) for k in number.tolist())  # noqa: E731
    return stamp_s, walk, prior, np.eye(4), facts, None, skipped


def _named_file(path: Path, name: str) -> Path:
    """A file that a user names, from here or from the folder. Raises `InputError`."""
    for file in (Path(name), path / name):
        if file.is_file():
            return file
    raise InputError(f"{name}: no such file, here or in {path}; expected a trajectory")
