"""Reader of recorded flights: bags, and folders of clouds with a trajectory. The truth is read separately."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.files import display_name
from steelnb.core.types import Array, Flight, Imu, IntArray, Scan, Trajectory
from steelnb.io.bag_reader import CAMERA, CLOUD, IMU, ODOMETRY, POSE_STAMPED, TF, Bag, is_bag
from steelnb.io.folders import TRUE, named_file, open_clouds
from steelnb.io.trajectories import interpolate, read_trajectory

Walk = Callable[[IntArray], Iterator[Callable[[], Array]]]
"""Iterator over the decoders of the scans with these increasing numbers."""


def read_flight(
    path: Path | str,
    *,
    scans: str | None = None,
    poses: str | None = None,
    T_drone_sensor: Array | None = None,
) -> Flight:
    """Open a recorded flight. Its scans are read one at a time during iteration.

    Parameters
    ----------
    path : a ROS 1 bag, an MCAP or sqlite file, a ROS 2 folder, or a folder of clouds (PLY, PCD, LAS, LAZ, NPY, XYZ) in
        the sensor frame with a trajectory of the drone (TUM).
    scans : topic or sub-folder of the scans; by default the only one of a suitable type.
    poses : topic or trajectory file of the drone's drifting poses; by default the only one, or tf.
    T_drone_sensor : pose ``(4, 4)`` of the sensor; by default that of tf_static, or the identity if unknown.

    Returns a `Flight`. Its ``prior`` is interpolated at the stamps of the scans, its ``facts`` name the topics and the
    mount, and ``skipped`` counts dropped scans and poses. Raises `InputError`.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: does not exist; expected a recording")
    if not path.is_dir() and not is_bag(path):
        raise InputError(f"{path}: ending {path.suffix!r}; expected .bag, .mcap, .db3 or a folder")
    opened = (_open_bag if is_bag(path) else open_clouds)(path, scans, poses)
    stamp_s, walk, prior, mount, facts, imu, skipped = opened
    if T_drone_sensor is not None:
        mount, facts["mount"] = T_drone_sensor, "as given"
    number = np.flatnonzero(np.diff(np.maximum.accumulate(stamp_s), prepend=-np.inf) > 0)
    skipped["scan whose stamp does not rise"] += len(stamp_s) - len(number)
    T_world_drone, covered = interpolate(prior, stamp_s[number])
    skipped["scan without a pose near"] += int((~covered).sum())
    if not covered.any():
        seconds = [f"{each[0]:.3f} to {each[-1]:.3f} s" for each in (stamp_s, prior.stamp_s)]
        raise InputError(f"{path}: no scan has a pose: scans at {seconds[0]}, poses at {seconds[1]}")
    number = number[covered]
    poses_at = Trajectory(stamp_s[number], T_world_drone[covered])
    skipped_counts = {reason: count for reason, count in skipped.items() if count}
    found = Scans(walk, number, poses_at.stamp_s)
    return Flight(found, poses_at, mount, imu, display_name(path.resolve()), facts, skipped_counts)


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
    return path.with_name(f"{path.stem if is_bag(path) and not path.is_dir() else path.name}.truth.tum")


class Scans(Sequence[Scan]):
    """Scans in files. Every iteration reads them again, one in memory at a time; indexing reads only those selected.

    ``stamp_s (K,)`` increases. A scan that cannot be read has no points, and `Scan.fault` says why. Points at (0, 0, 0)
    become NaN, since many drivers write zeros for no return.
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
    except InputError as fault:  # a damaged message or file only loses one scan
        return Scan(stamp_s, np.zeros((0, 3)), f"unreadable scan: {fault}")
    zero = (points == 0).all(axis=-1)
    if zero.any():
        points = np.where(zero[..., None], np.nan, points)
    if not np.isfinite(points).any():
        return Scan(stamp_s, np.zeros((0, 3)), "no finite point")
    return Scan(stamp_s, points)


_Parts = tuple[Array, Walk, Trajectory, Array, dict[str, str], Imu | None, Counter[str]]
"""Stamps of all scans, the scans, poses of the drone, mount, facts, IMU, and counts of what was skipped."""


def _open_bag(path: Path, scans: str | None, poses: str | None) -> _Parts:
    bag = Bag(path)
    clouds, tf_topics, imu_topics = bag.of_type(CLOUD), bag.of_type(*TF), bag.of_type(IMU)[:1]
    scan_topic = bag.choose("clouds (PointCloud2 or depth images)", scans, clouds or bag.depth_images())
    is_pose_file = poses is not None and poses not in bag.types and Path(poses).is_file()
    pose_topics = bag.of_type(ODOMETRY, POSE_STAMPED)
    uses_tf = not poses and not pose_topics and tf_topics
    chosen = [] if is_pose_file or uses_tf else [bag.choose("poses", poses, pose_topics)]
    bag.read(scan_topic, *chosen, *tf_topics, *imu_topics, *([] if clouds else bag.of_type(CAMERA)))
    source = str(poses) if is_pose_file else chosen[0] if chosen else bag.poses_of_tf()
    prior = read_trajectory(source, bag.skipped) if is_pose_file else bag.poses(source)
    body, (to_points, optical) = bag.frame_of.get(source, ""), bag.to_points(scan_topic)
    mount, mount_source = bag.mount(body, bag.frame_of.get(scan_topic, ""), optical)
    kind = bag.types[scan_topic].rpartition("/")[2]
    facts = {"scans": f"{scan_topic} ({kind})", "poses": source, "mount": mount_source}
    facts |= {"imu": imu_topics[0]} if imu_topics else {}
    imu = bag.imu(imu_topics[0], body) if imu_topics else None
    return bag.stamp_s(scan_topic), partial(bag.walk, scan_topic, to_points), prior, mount, facts, imu, bag.skipped
