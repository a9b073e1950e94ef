"""Bags → parts of a flight. Opening reads the chosen topics once and keeps stamps, poses and inertial samples."""

from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from steelnb.errors import FileContentError, RecordingError, TopicError
from steelnb.images import CameraImages, GreyImage
from steelnb.io.bag_files import TRANSFORMS, Bag, Message, decode_points
from steelnb.io.bag_topics import (
    CAMERA,
    IMU,
    ODOMETRY,
    POSE,
    POSES,
    SENSED,
    TRANSFORM,
    Topics,
    choose_topics,
    one_topic,
)
from steelnb.io.calibration import Intrinsics, depth_points, from_optical, read_settings
from steelnb.io.images import RecordedImages, decode_depth, decode_grey
from steelnb.io.scans import Parts, rate
from steelnb.io.trajectories import count, read_trajectory, rising, trajectory_of
from steelnb.io.transforms import Frames, T_body_drone, Transforms, is_optical, poses_of_transforms
from steelnb.types import Array, Imu, IntArray, Trajectory

RANGE_MIN = (15.0, 2.0)
"""A little less than the smallest measuring ranges, 2 g and 125°/s, in m/s² and rad/s."""
FULL_IN_A_ROW = 3
T = TypeVar("T")


def open_bag(
    path: Path,
    scans: str | None,
    poses: str | None,
    truth: str | None,
    settings: Path | None,
    images: str | None = None,
) -> Parts:
    """The parts of a bag; ``scans``, ``poses`` (or a trajectory file), ``truth``, no prior, and ``images`` name topics.

    Raises `TopicError` where several topics fit and none is named, `RecordingError` without scans or poses, or for
    images that are named and of no use, and what settings raise.
    """
    mount, camera = read_settings(settings)
    bag = Bag(path)
    topics, facts = choose_topics(bag, scans, poses, truth, images)
    skipped: Counter[str] = Counter()
    wanted = [*filter(None, topics[2:7]), topics.scans, *topics.transforms]
    read = Contents(bag, wanted, skipped, topics.poses is None)
    frame = read.frame_of.get(topics.scans, "")
    prior, body, facts["poses"] = _poses(bag, read, topics, poses, truth, skipped)
    frames = Frames(read.transforms, body, frame, topics.depth or is_optical(frame))
    T_drone_sensor, facts["extrinsics"] = frames.extrinsics(mount, settings)
    prior = Trajectory(prior.stamp_s, prior.T_world_drone @ T_body_drone(body))
    facts["frames"] = f"poses of {body or 'the body'}, scans in {frame or 'the sensor'}"
    if topics.depth and camera is None:
        camera, facts["intrinsics"] = read.intrinsics_of(topics.camera)
        if camera is None:
            raise RecordingError(
                f"{path}: no intrinsics for the depth images {topics.scans}; expected a CameraInfo with focal lengths "
                f"or [intrinsics] in a settings file: {bag.holds()}"
            )
    imu = read.imu(topics.imu, frames, skipped) if topics.imu else None
    facts |= {"imu": topics.imu} if topics.imu else {}
    taken = None
    if topics.images:
        try:
            taken, facts["images"] = _camera_images(bag, read, topics, body, skipped)
        except RecordingError as fault:
            if images is not None:
                raise
            facts["images"] = f"none: {fault}"
    decode = partial(_depths, camera) if topics.depth and camera else partial(_points, frames.optical)
    walk = partial(_walk, bag, topics.scans, decode)
    return Parts(read.stamp_s(topics.scans), walk, prior, T_drone_sensor, facts, imu, skipped, taken)


def read_bag_truth(path: Path, truth: str | None, settings: Path | None) -> Trajectory | None:
    """The drone's poses of a topic, or of a trajectory file that is named; None where none is named."""
    if truth is None:
        return None
    bag = Bag(path)
    if truth not in bag.types:
        if not Path(truth).exists():
            raise TopicError(f"{path}: no topic and no file {truth!r}: {bag.holds()}")
        return read_trajectory(truth)
    one_topic(bag, "truth", [], truth, bag.of_type(*POSES))
    skipped: Counter[str] = Counter()
    found, body = Contents(bag, [truth], skipped, False).trajectory(truth, skipped)
    return Trajectory(found.stamp_s, found.T_world_drone @ T_body_drone(body))


class Contents:
    """One pass over some topics of a bag: numbers of small messages, and of scans the stamps alone."""

    def __init__(self, bag: Bag, topics: Collection[str], skipped: Counter[str], series: bool) -> None:
        self.bag, self.transforms = bag, Transforms(series)
        self.frame_of: dict[str, str] = {}
        self._intrinsics: dict[str, tuple[Intrinsics, str]] = {}
        self._rows: dict[str, array[float]] = defaultdict(lambda: array("d"))
        for message in bag.walk(topics):
            kind = bag.types[message.topic]
            try:
                self._take(message, kind, skipped)
            except FileContentError:
                skipped[f"malformed {kind.rpartition('/')[2]}"] += 1
                if kind in SENSED:  # in step with the messages
                    self._rows[message.topic].extend((np.nan, message.received_ns / 1e9))

    def _take(self, message: Message, kind: str, skipped: Counter[str]) -> None:
        topic, bag = message.topic, self.bag
        if kind in SENSED:
            self._rows[topic].extend((bag.stamp_s(message), message.received_ns / 1e9))
            if topic not in self.frame_of:
                with suppress(FileContentError):  # a fault of that scan, when it is read; the next one may do
                    self.frame_of[topic] = str(bag.decode(message).header.frame_id)
            return
        decoded = bag.decode(message)
        if kind in TRANSFORMS:
            for each in decoded.transforms:
                pose = _pose(each.transform.translation, each.transform.rotation)
                stamp_s = each.header.stamp.sec + each.header.stamp.nanosec / 1e9
                if not self.transforms.add(each.header.frame_id, each.child_frame_id, stamp_s, pose):
                    skipped["tf that is no transform"] += 1
        elif kind == CAMERA:
            if topic not in self._intrinsics and (found := self._calibration(topic, decoded)):
                self._intrinsics[topic] = found
        elif kind == IMU:
            self.frame_of.setdefault(topic, decoded.header.frame_id)
            force, rate = decoded.linear_acceleration, decoded.angular_velocity
            self._rows[topic].extend((bag.stamp_s(message), force.x, force.y, force.z, rate.x, rate.y, rate.z))
        else:
            if kind in (TRANSFORM, ODOMETRY):
                self.frame_of[topic] = self.frame_of.get(topic) or decoded.child_frame_id
            if kind == TRANSFORM:
                numbers = _pose(decoded.transform.translation, decoded.transform.rotation)
            else:
                pose = decoded.pose if kind == POSE else decoded.pose.pose
                numbers = _pose(pose.position, pose.orientation)
            self._rows[topic].extend((bag.stamp_s(message), *numbers))

    def rows(self, topic: str, columns: int) -> Array:
        """The numbers of a topic, a row a message, the stamp first."""
        return np.array(self._rows[topic]).reshape(-1, columns)

    def trajectory(self, topic: str, skipped: Counter[str]) -> tuple[Trajectory, str | None]:
        """The poses of a topic, and the frame that they are of, None where the messages do not say."""
        rows = self.rows(topic, 8)
        found = trajectory_of(self.bag.path, rows[:, 0], rows[:, 1:4], rows[:, 4:], skipped)
        return found, self.frame_of.get(topic)

    def imu(self, topic: str, frames: Frames, skipped: Counter[str]) -> Imu:
        """Inertial samples, turned to the drone's axes where tf tells them."""
        rows = self.rows(topic, 7)
        finite = np.asarray(np.isfinite(rows).all(axis=1))
        count(skipped, "IMU sample not finite", ~finite)
        rows = rows[finite]
        rows = rows[rising(rows[:, 0], skipped, "IMU sample: ")]
        full = saturated(rows[:, 1:])
        count(skipped, "IMU sample saturated", full)
        rows = rows[~full]
        R_drone_imu = frames.R_drone(self.frame_of.get(topic, ""))
        return Imu(rows[:, 0], rows[:, 1:4] @ R_drone_imu.T, rows[:, 4:] @ R_drone_imu.T)

    def stamp_s(self, topic: str) -> Array:
        """Stamps ``(N,)`` of scans or images; where all are zero, when they were received."""
        stamps = self.rows(topic, 2)
        return stamps[:, 1] if len(stamps) > 1 and not stamps[:, 0].any() else stamps[:, 0]

    def intrinsics_of(self, topic: str | None) -> tuple[Intrinsics | None, str]:
        """The first intrinsics of a topic that have focal lengths, and their source in words."""
        return self._intrinsics.get(topic or "", (None, f"{topic}"))

    def _calibration(self, topic: str, info: Any) -> tuple[Intrinsics, str] | None:
        K, distortion = (info.K, info.D) if self.bag.ros == 1 else (info.k, info.d)
        if not (K[0] > 0 and K[4] > 0 and np.isfinite(K).all()):
            return None
        size = {"width": info.width or None, "height": info.height or None}
        said = f"{topic}{', its distortion ignored' if np.any(distortion) else ''}"
        return Intrinsics(fx=K[0], fy=K[4], cx=K[2], cy=K[5], **size), said


def saturated(readings: Array) -> NDArray[np.bool_]:
    """Which readings ``(N, 6)`` of specific force and angular rate are at the end of a range: several times in a row
    the same value, the largest of all on its axis and beyond the smallest range that IMUs have."""
    size = np.abs(readings)
    same = (size == size.max(axis=0, initial=0.0)) & (size > np.repeat(RANGE_MIN, 3))
    full, starts = np.zeros(len(size), dtype=bool), len(size) - FULL_IN_A_ROW + 1
    in_a_row = np.logical_and.reduce([same[k : starts + k] for k in range(FULL_IN_A_ROW)]).any(axis=1)
    for k in range(FULL_IN_A_ROW):
        full[k : len(in_a_row) + k] |= in_a_row
    return full


def _poses(
    bag: Bag, read: Contents, topics: Topics, named: str | None, truth: str | None, skipped: Counter[str]
) -> tuple[Trajectory, str | None, str]:
    """The poses from a topic, a file or tf; the frame that they are of, where it is known; and where from, in words."""
    if topics.poses is not None:
        said = f"true poses, {topics.poses}" if topics.poses == truth else topics.poses
        return *read.trajectory(topics.poses, skipped), said
    if named is not None and named not in topics.transforms:
        return read_trajectory(named, skipped), None, f"file {named}"
    found = poses_of_transforms(read.transforms, read.frame_of.get(topics.scans, ""))
    if found is None:
        raise RecordingError(
            f"{bag.path}: no poses; expected a topic of type Odometry, PoseStamped, PoseWithCovarianceStamped or "
            f"TransformStamped, tf from odom, world or map to the body, or a trajectory file: {bag.holds()}"
        )
    return found


def _camera_images(
    bag: Bag, read: Contents, topics: Topics, body: str | None, skipped: Counter[str]
) -> tuple[CameraImages, str]:
    """The images of a topic, and where they and their calibration are from, in words.

    Raises `RecordingError` without intrinsics, and for images that cannot be read or are of another size.
    """
    topic = str(topics.images)
    camera, source = read.intrinsics_of(topics.lens)
    if camera is None:
        why = f"no focal lengths in {topics.lens}" if topics.lens else "no topic of type CameraInfo beside it"
        raise RecordingError(f"{topic}: no intrinsics: {why}; expected a CameraInfo whose K is not zero")
    decode = partial(_grey, camera)
    try:
        size = decode(bag.decode(next(bag.walk([topic])))).shape
    except FileContentError as fault:
        raise RecordingError(f"{topic}: {fault}") from None
    stamp_s = read.stamp_s(topic)
    number = np.flatnonzero(rising(stamp_s, skipped, "image: "))
    stamp_s = stamp_s[number]
    frames = Frames(read.transforms, body, read.frame_of.get(topic, ""), optical=True)
    T_drone_camera, mount = frames.extrinsics(None, None)
    images = RecordedImages(len(number), partial(_walk, bag, topic, decode, number))
    words = f"{len(number)}{rate(stamp_s)}, {size[1]} x {size[0]} ({topic}, intrinsics {source}, mount {mount})"
    return CameraImages(stamp_s, images, camera.K, T_drone_camera), words


def _walk(bag: Bag, topic: str, decode: Callable[[Any], T], number: IntArray) -> Iterator[Callable[[], T]]:
    """Scans or images by the numbers of their messages. Raises `FileContentError` where the bag is damaged."""
    wanted, last = set(number.tolist()), int(number.max(initial=-1))
    for k, message in enumerate(bag.walk([topic]) if len(number) else ()):
        if k in wanted:
            yield partial(_decoded, bag, message, decode)
        if k == last:
            return
    if len(number):
        raise FileContentError(f"{bag.path}: {topic} has fewer messages than when it was opened; expected {last + 1}")


def _decoded(bag: Bag, message: Message, decode: Callable[[Any], T]) -> T:
    return decode(bag.decode(message))


def _points(optical: bool, message: Any) -> Array:
    points = decode_points(message)
    return from_optical(points) if optical else points


def _depths(camera: Intrinsics, message: Any) -> Array:
    return depth_points(camera.checked(decode_depth(message, camera.depth_scale)), camera)


def _grey(camera: Intrinsics, message: Any) -> GreyImage:
    return camera.checked(decode_grey(message))


def _pose(place: Any, turn: Any) -> tuple[float, ...]:
    return place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w
