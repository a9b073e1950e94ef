"""Bags → parts of a flight. Opening reads the chosen topics once and keeps stamps, poses and inertial samples."""

from array import array
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steelnb.errors import FileContentError, RecordingError, TopicError
from steelnb.io.bag_files import DEPTHS, TRANSFORMS, Bag, Message, decode_depth, decode_points
from steelnb.io.calibration import Intrinsics, depth_points, from_optical, read_settings
from steelnb.io.scans import Decode, Parts
from steelnb.io.trajectories import count, read_trajectory, rising, trajectory_of
from steelnb.io.transforms import Frames, T_body_drone, Transforms, is_optical, poses_of_transforms
from steelnb.types import Array, Imu, IntArray, Trajectory

CLOUD, IMAGE = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image"
CAMERA, IMU = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Imu"
ODOMETRY, TRANSFORM = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped"
POSE, POSE_COVARIANCE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
POSES = (ODOMETRY, POSE, POSE_COVARIANCE, TRANSFORM)

RANGE_MIN = (15.0, 2.0)
"""A little less than the smallest measuring ranges, 2 g and 125°/s, in m/s² and rad/s."""
FULL_IN_A_ROW = 3


class Topics(NamedTuple):
    """The topics chosen. ``poses`` None: from tf, or from a trajectory file."""

    scans: str
    depth: bool
    poses: str | None
    imu: str | None
    camera: str | None
    transforms: tuple[str, ...]


def open_bag(path: Path, scans: str | None, poses: str | None, truth: str | None, settings: Path | None) -> Parts:
    """The parts of a bag; ``scans``, ``poses`` (or a trajectory file) and ``truth``, no prior, name topics.

    Raises `TopicError` where several topics fit and none is named, `RecordingError` without scans or poses, and what
    settings raise.
    """
    mount, camera = read_settings(settings)
    bag = Bag(path)
    topics, facts = choose_topics(bag, scans, poses, truth)
    skipped: Counter[str] = Counter()
    read = Contents(bag, [*filter(None, topics[2:5]), topics.scans, *topics.transforms], skipped, topics.poses is None)
    frame = read.frame_of.get(topics.scans, "")
    prior, body, facts["poses"] = _poses(bag, read, topics, poses, truth, skipped)
    frames = Frames(read.transforms, body, frame, topics.depth or is_optical(frame))
    T_drone_sensor, facts["extrinsics"] = frames.extrinsics(mount, settings)
    prior = Trajectory(prior.stamp_s, prior.T_world_drone @ T_body_drone(body))
    facts["frames"] = f"poses of {body or 'the body'}, scans in {frame or 'the sensor'}"
    if topics.depth and camera is None:
        camera, facts["intrinsics"] = read.intrinsics, f"{topics.camera}{read.distortion}"
        if camera is None:
            raise RecordingError(
                f"{path}: no intrinsics for the depth images {topics.scans}; expected a CameraInfo with focal lengths "
                f"or [intrinsics] in a settings file: {bag.holds()}"
            )
    stamps = read.rows(topics.scans, 2)
    stamp_s = stamps[:, 1] if len(stamps) > 1 and not stamps[:, 0].any() else stamps[:, 0]  # all zero: when received
    imu = read.imu(topics.imu, frames, skipped) if topics.imu else None
    facts |= {"imu": topics.imu} if topics.imu else {}
    walk = partial(_walk, bag, topics.scans, frames.optical, camera if topics.depth else None)
    return Parts(stamp_s, walk, prior, T_drone_sensor, facts, imu, skipped)


def read_bag_truth(path: Path, truth: str | None, settings: Path | None) -> Trajectory | None:
    """The drone's poses of a topic, or of a trajectory file that is named; None where none is named."""
    if truth is None:
        return None
    bag = Bag(path)
    if truth not in bag.types:
        if not Path(truth).exists():
            raise TopicError(f"{path}: no topic and no file {truth!r}: {bag.holds()}")
        return read_trajectory(truth)
    _one(bag, "truth", [], truth, bag.of_type(*POSES))
    skipped: Counter[str] = Counter()
    found, body = Contents(bag, [truth], skipped, False).trajectory(truth, skipped)
    return Trajectory(found.stamp_s, found.T_world_drone @ T_body_drone(body))


def choose_topics(bag: Bag, scans: str | None, poses: str | None, truth: str | None) -> tuple[Topics, dict[str, str]]:
    """The topics that make a flight, and facts about them. Scans are PointCloud2 or, without any, depth images."""
    clouds, images = bag.of_type(CLOUD), _depth_images(bag)
    chosen = _one(bag, "scans", clouds or images, scans, [*clouds, *images])
    if chosen is None:
        raise RecordingError(f"{bag.path}: no scans; expected a topic of PointCloud2 or depth images: {bag.holds()}")
    transforms = tuple(bag.of_type(*TRANSFORMS))
    prior = None
    in_file = poses is not None and poses not in bag.types and Path(poses).exists()
    if not in_file and poses not in transforms:
        possible = bag.of_type(*POSES)
        prior = _one(bag, "poses", [topic for topic in possible if topic != truth], poses, possible)
        if prior is None and not transforms and truth in possible:
            prior = truth  # the only poses; noise can be added to them
    inertial, cameras = bag.of_type(IMU), bag.of_type(CAMERA)
    beside = f"{chosen.rpartition('/')[0]}/camera_info"
    camera = beside if beside in cameras else cameras[0] if len(cameras) == 1 else None
    facts = {"form": bag.form, "scans": chosen}
    if len(inertial) > 1:
        facts["imu"] = f"none: {len(inertial)} topics fit: {', '.join(sorted(inertial))}"
    depth = chosen in images
    imu = inertial[0] if len(inertial) == 1 else None
    return Topics(chosen, depth, prior, imu, camera if depth else None, transforms), facts


class Contents:
    """One pass over some topics of a bag: numbers of small messages, and of scans the stamps alone."""

    def __init__(self, bag: Bag, topics: Collection[str], skipped: Counter[str], series: bool) -> None:
        self.bag, self.transforms = bag, Transforms(series)
        self.frame_of: dict[str, str] = {}
        self.intrinsics: Intrinsics | None = None
        self.distortion = ""
        self._rows: dict[str, array[float]] = defaultdict(lambda: array("d"))
        for message in bag.walk(topics):
            kind = bag.types[message.topic]
            try:
                self._take(message, kind, skipped)
            except FileContentError:
                skipped[f"malformed {kind.rpartition('/')[2]}"] += 1
                if kind in (CLOUD, IMAGE):  # in step with the messages
                    self._rows[message.topic].extend((np.nan, message.received_ns / 1e9))

    def _take(self, message: Message, kind: str, skipped: Counter[str]) -> None:
        topic, bag = message.topic, self.bag
        if kind in (CLOUD, IMAGE):
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
            self.intrinsics = self.intrinsics or self._calibration(decoded)
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

    def _calibration(self, info: Any) -> Intrinsics | None:
        K, distortion = (info.K, info.D) if self.bag.ros == 1 else (info.k, info.d)
        if not (K[0] > 0 and K[4] > 0 and np.isfinite(K).all()):
            return None
        self.distortion = ", its distortion ignored" if np.any(distortion) else ""
        return Intrinsics(fx=K[0], fy=K[4], cx=K[2], cy=K[5], width=info.width or None, height=info.height or None)


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


def _walk(bag: Bag, topic: str, optical: bool, camera: Intrinsics | None, number: IntArray) -> Iterator[Decode]:
    """Scans by the numbers of their messages. Raises `FileContentError` where the bag is damaged."""
    wanted, last = set(number.tolist()), int(number.max(initial=-1))
    for k, message in enumerate(bag.walk([topic]) if len(number) else ()):
        if k in wanted:
            yield partial(_decoded, bag, message, optical, camera)
        if k == last:
            return
    if len(number):
        raise FileContentError(f"{bag.path}: {topic} has fewer messages than when it was opened; expected {last + 1}")


def _decoded(bag: Bag, message: Message, optical: bool, camera: Intrinsics | None) -> Array:
    if camera is None:
        points = decode_points(bag.decode(message))
        return from_optical(points) if optical else points
    depth = decode_depth(bag.decode(message), camera.depth_scale)
    if fault := camera.differs(*depth.shape):
        raise FileContentError(fault)
    return depth_points(depth, camera)


def _one(bag: Bag, role: str, fits: Collection[str], named: str | None, possible: Collection[str]) -> str | None:
    """The topic named, or the only one that fits; None without any. Raises `TopicError`."""
    if named is None:
        if len(fits) > 1:
            listed = ", ".join(f"{topic} ({bag.types[topic].rpartition('/')[2]})" for topic in sorted(fits))
            raise TopicError(f"{bag.path}: {len(fits)} topics fit for the {role}; expected one to be named: {listed}")
        return next(iter(fits), None)
    if named not in bag.types:
        raise TopicError(f"{bag.path}: no topic {named!r} for the {role}: {bag.holds()}")
    if named not in possible:
        expected = ", ".join(possible) or "none that it has"
        raise TopicError(
            f"{bag.path}: {named} is of type {bag.types[named]}, not for the {role}; expected one of {expected}"
        )
    return named


def _depth_images(bag: Bag) -> list[str]:
    """Topics of images whose first readable one is a depth image."""
    found = []
    for topic in bag.of_type(IMAGE):
        for message in bag.walk([topic]):
            with suppress(FileContentError):
                found += [topic] if bag.decode(message).encoding in DEPTHS else []
                break
    return found


def _pose(place: Any, turn: Any) -> tuple[float, ...]:
    return place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w
