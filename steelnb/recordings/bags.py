"""ROS 1 bags, ROS 2 folders, MCAP and sqlite files → `Recording`.

Opening walks once through what was chosen and keeps stamps, poses and inertial samples; scans and pictures are read
again, one by one, when they are walked through.
"""

from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steelnb.datatypes import Array, Imu, Scan, Trajectory
from steelnb.errors import FileContentError, RecordingError
from steelnb.recordings.bag_files import Bag, Message
from steelnb.recordings.bag_frames import Frames, is_optical, poses_of_transforms
from steelnb.recordings.bag_images import decode_depth, decode_picture
from steelnb.recordings.choice import Choice, Intrinsics, read_settings
from steelnb.recordings.pinhole import depth_points, from_optical
from steelnb.recordings.pointcloud2 import decode_points
from steelnb.recordings.recording import Picture, Recording
from steelnb.recordings.topics import CAMERA, IMU, ODOMETRY, POSE, TRANSFORM, Topics, choose_topics
from steelnb.recordings.topics import held as held_by
from steelnb.recordings.trajectories import read_trajectory, trajectory_of
from steelnb.recordings.transforms import Transforms

NANO = 10**9
REASONS_MAX = 30
"""A damaged bag may have a reason of its own for each message; more are counted as one."""


def open_bag(path: Path, choice: Choice) -> Recording:
    """The flight in a bag. Raises `FileContentError`, `FileMissingError`, `TopicError`, `RecordingError`,
    `ExtrinsicsError` and `SettingsError`; see `steelnb.recordings.formats.open_recording`."""
    extrinsics, intrinsics = read_settings(choice.settings)
    bag = Bag(path)
    topics = choose_topics(bag, choice)
    read = _Opened(bag, topics, series=topics.poses is None)
    skipped, facts = read.skipped, {"form": bag.form, "scans": topics.scans, **topics.unclear}
    if not len(stamps := read.stamps[topics.scans].seconds()):
        raise RecordingError(f"{path}: {topics.scans} has no scan that can be read; expected at least one")
    frame = read.frame_of[topics.scans]

    if choice.poses is not None and topics.poses is None and choice.poses not in topics.transforms:
        poses, body = read_trajectory(choice.poses, skipped), None
        facts["poses"] = f"file {choice.poses}"
    elif topics.poses is not None:
        poses, body = read.poses[topics.poses].trajectory(path, skipped), read.poses[topics.poses].body
        facts["poses"] = topics.poses
    else:
        found = poses_of_transforms(read.transforms, frame)
        if found is None:
            raise RecordingError(
                f"{path}: no poses; expected a topic of type Odometry, PoseStamped, PoseWithCovarianceStamped or "
                f"TransformStamped, tf from odom, world or map to the body, or a trajectory file: {held_by(bag)}"
            )
        poses, body, facts["poses"] = found
    frames = Frames(read.transforms, body, frame, optical=topics.depth or is_optical(frame))
    T_drone_sensor, facts["extrinsics"] = frames.extrinsics(extrinsics, choice.settings)
    poses, turned = frames.of_drone(poses)
    if turned:
        facts["poses"] += f", {turned}"

    truth = None
    if topics.truth is not None:
        truth, _ = frames.of_drone(read.poses[topics.truth].trajectory(path, Counter()))
        facts["truth"] = topics.truth
    decode = (
        _depth_decoder(bag, read, topics, intrinsics, facts) if topics.depth else _cloud_decoder(bag, frames.optical)
    )
    kept, stamp_s = _rising(stamps, skipped, "scan")
    imu = None
    if topics.imu is not None:
        imu = read.imu.samples(skipped, frames.R_drone(read.imu.frame))
        facts["imu"] = topics.imu
    pictures = None
    if topics.pictures is not None:
        pictures = BagPictures(
            bag, topics.pictures, *_rising(read.stamps[topics.pictures].seconds(), skipped, "picture")
        )
        facts["pictures"] = topics.pictures
    scans = BagScans(bag, topics.scans, kept, stamp_s, decode, skipped)
    return Recording(path, scans, poses, T_drone_sensor, imu, truth, pictures, skipped, facts)


class BagScans:
    """The scans of one topic (`ScanSource`): those messages whose stamps rise, read anew on every walk."""

    def __init__(
        self,
        bag: Bag,
        topic: str,
        kept: NDArray[np.bool_],
        stamp_s: Array,
        decode: Callable[[Message], Array],
        skipped: Counter[str],
    ) -> None:
        self.stamp_s = stamp_s
        self._bag, self._topic, self._kept, self._decode, self._skipped = bag, topic, kept, decode, skipped
        self._counted = np.zeros(len(stamp_s), dtype=bool)

    def walk(self, wanted: NDArray[np.bool_] | None = None) -> Iterator[Scan]:
        """All scans, or those of a mask ``(K,)``. Raises `FileContentError` where the bag is damaged."""
        wanted = np.ones(len(self.stamp_s), dtype=bool) if wanted is None else wanted
        for k, message in _kept_messages(self._bag, self._topic, self._kept, wanted):
            points, reason = self._points(message)
            if reason and not self._counted[k]:
                self._counted[k] = True
                few = reason in self._skipped or len(self._skipped) < REASONS_MAX
                self._skipped[reason if few else "malformed cloud"] += 1
            yield Scan(float(self.stamp_s[k]), points)

    def _points(self, message: Message) -> tuple[Array, str]:
        none = np.zeros((0, 3))
        try:
            points = self._decode(message)
        except FileContentError as fault:
            return none, f"malformed cloud: {str(fault).removeprefix(f'{self._bag.path}: ')}"
        if not points.size:
            return none, "empty cloud"
        if np.isnan(points[..., 0]).all():
            return none, "no finite point"
        return points, ""


class BagPictures:
    """The pictures of one topic (`PictureSource`); one that cannot be decoded is left out of a walk."""

    def __init__(self, bag: Bag, topic: str, kept: NDArray[np.bool_], stamp_s: Array) -> None:
        self.stamp_s = stamp_s
        self._bag, self._topic, self._kept = bag, topic, kept

    def walk(self) -> Iterator[Picture]:
        """All pictures in the order of their stamps."""
        for k, message in _kept_messages(self._bag, self._topic, self._kept, np.ones(len(self.stamp_s), dtype=bool)):
            try:
                yield Picture(float(self.stamp_s[k]), decode_picture(self._bag.decode(message)))
            except FileContentError:
                continue


def _kept_messages(
    bag: Bag, topic: str, kept: NDArray[np.bool_], wanted: NDArray[np.bool_]
) -> Iterator[tuple[int, Message]]:
    """The wanted ones of the kept messages of a topic, each with its number among the kept."""
    number = np.where(kept, np.cumsum(kept) - 1, -1)
    number[kept] = np.where(wanted, number[kept], -1)
    last = int(number.max(initial=-1))
    for k, message in zip(number.tolist(), bag.walk([topic]), strict=False):
        if k >= 0:
            yield k, message
        if k == last:
            return
    raise FileContentError(f"{bag.path}: {topic} has fewer messages than when it was opened; expected {len(kept)}")


class _Opened:
    """What one pass over a bag gathers."""

    def __init__(self, bag: Bag, topics: Topics, series: bool) -> None:
        self.skipped: Counter[str] = Counter()
        self.frame_of: dict[str, str] = {}
        self.stamps = {topic: _Stamps() for topic in (topics.scans, topics.pictures) if topic}
        self.poses = {topic: _Poses(bag.types[topic]) for topic in (topics.poses, topics.truth) if topic}
        self.imu = _Samples()
        self.transforms = Transforms(series)
        self.camera: Any = None
        wanted = {*self.stamps, *self.poses, *topics.transforms, *(t for t in (topics.imu, topics.camera) if t)}
        for message in bag.walk(wanted):
            try:
                self._take(bag, message)
            except FileContentError:
                self.skipped[f"malformed {bag.types[message.topic].rpartition('/')[2]}"] += 1

    def _take(self, bag: Bag, message: Message) -> None:
        topic, kind = message.topic, bag.types[message.topic]
        if topic in self.stamps:
            if topic not in self.frame_of:
                self.frame_of[topic] = _frame_or_none(bag, message)
            try:
                self.stamps[topic].add(bag.stamp_ns(message), message.received_ns)
            except FileContentError:
                self.stamps[topic].add(None, message.received_ns)  # in step with the messages
                raise
        elif topic in self.poses:
            self.poses[topic].add(bag.decode(message), bag.stamp_ns(message))
        elif kind == IMU:
            self.imu.add(bag.decode(message), bag.stamp_ns(message))
        elif kind == CAMERA:
            self.camera = self.camera or bag.decode(message)
        else:
            for each in bag.decode(message).transforms:
                pose = (*_xyz(each.transform.translation), *_xyz(each.transform.rotation), each.transform.rotation.w)
                if not self.transforms.add(
                    each.header.frame_id, each.child_frame_id, _seconds(each.header.stamp), pose
                ):
                    self.skipped["tf that is no transform"] += 1


class _Stamps:
    """Stamps of a topic's messages; where all in the headers are zero, when they were received."""

    def __init__(self) -> None:
        self._own, self._received = array("d"), array("d")

    def add(self, stamp_ns: int | None, received_ns: int) -> None:
        self._own.append(np.nan if stamp_ns is None else stamp_ns / NANO)
        self._received.append(received_ns / NANO)

    def seconds(self) -> Array:
        own = np.array(self._own)
        return np.array(self._received) if len(own) > 1 and not own.any() else own


class _Poses:
    """Poses of one topic, and the frame that they are of, if the messages say so."""

    def __init__(self, kind: str) -> None:
        self._kind, self._rows = kind, array("d")
        self.body: str | None = None

    def add(self, message: Any, stamp_ns: int) -> None:
        if self._kind == TRANSFORM:
            place, turn = message.transform.translation, message.transform.rotation
        else:
            pose = message.pose if self._kind == POSE else message.pose.pose
            place, turn = pose.position, pose.orientation
        if self._kind in (TRANSFORM, ODOMETRY):
            self.body = self.body or message.child_frame_id
        self._rows.extend((stamp_ns / NANO, *_xyz(place), *_xyz(turn), turn.w))

    def trajectory(self, path: Path, skipped: Counter[str]) -> Trajectory:
        rows = np.array(self._rows).reshape(-1, 8)
        return trajectory_of(path, rows[:, 0], rows[:, 1:4], rows[:, 4:], skipped)


class _Samples:
    """Inertial samples."""

    def __init__(self) -> None:
        self._rows = array("d")
        self.frame = ""

    def add(self, message: Any, stamp_ns: int) -> None:
        self.frame = self.frame or message.header.frame_id
        self._rows.extend((stamp_ns / NANO, *_xyz(message.linear_acceleration), *_xyz(message.angular_velocity)))

    def samples(self, skipped: Counter[str], R_drone_imu: Array) -> Imu:
        rows = np.array(self._rows).reshape(-1, 7)
        kept, stamp_s = _rising(rows[:, 0], skipped, "IMU sample")
        return Imu(stamp_s, rows[kept, 1:4] @ R_drone_imu.T, rows[kept, 4:] @ R_drone_imu.T)


def _rising(stamp_s: Array, skipped: Counter[str], what: str) -> tuple[NDArray[np.bool_], Array]:
    """Which stamps are later than all before them, and those stamps; the others are counted."""
    finite = np.isfinite(stamp_s)
    latest = np.maximum.accumulate(np.where(finite, stamp_s, -np.inf))
    before = np.concatenate([[-np.inf], latest[:-1]])
    reasons = {
        f"{what} without a stamp": ~finite,
        f"{what}: duplicate stamp": finite & (stamp_s == before),
        f"{what}: time ran backwards": finite & (stamp_s < before),
    }
    for reason, which in reasons.items():
        if which.any():
            skipped[reason] += int(which.sum())
    kept = finite & (stamp_s > before)
    return kept, stamp_s[kept]


def _cloud_decoder(bag: Bag, optical: bool) -> Callable[[Message], Array]:
    def decode(message: Message) -> Array:
        points = decode_points(bag.decode(message))
        return from_optical(points) if optical else points

    return decode


def _depth_decoder(
    bag: Bag, read: _Opened, topics: Topics, intrinsics: Intrinsics | None, facts: dict[str, str]
) -> Callable[[Message], Array]:
    if intrinsics is None and read.camera is not None:
        info = read.camera
        K = info.K if bag.ros == 1 else info.k
        if K[0] > 0 and K[4] > 0 and np.isfinite(K).all():
            intrinsics = Intrinsics(
                fx=K[0], fy=K[4], cx=K[2], cy=K[5], width=info.width or None, height=info.height or None
            )
        facts["intrinsics"] = (
            f"{topics.camera}{', its distortion ignored' if np.any(info.D if bag.ros == 1 else info.d) else ''}"
        )
    if intrinsics is None:
        raise RecordingError(
            f"{bag.path}: no intrinsics for the depth images {topics.scans}; expected a CameraInfo with focal lengths "
            f"or [intrinsics] in a settings file: {held_by(bag)}"
        )
    facts.setdefault("intrinsics", "settings")
    camera = intrinsics

    def decode(message: Message) -> Array:
        depth = decode_depth(bag.decode(message), camera.depth_scale)
        expected = (camera.height or depth.shape[0], camera.width or depth.shape[1])
        if depth.shape != expected:
            raise FileContentError(
                f"{depth.shape[1]} × {depth.shape[0]} pixels; expected {expected[1]} × {expected[0]}"
            )
        return depth_points(depth, camera)

    return decode


def _frame_or_none(bag: Bag, message: Message) -> str:
    try:
        return str(bag.decode(message).header.frame_id)
    except FileContentError:
        return ""


def _xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _seconds(stamp: Any) -> float:
    return (stamp.sec * NANO + stamp.nanosec) / NANO
