"""One walk through a bag, which keeps stamps, poses and inertial samples, and none of what is large."""

from array import array
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from steelnb.datatypes import Array, Imu, Trajectory
from steelnb.errors import FileContentError
from steelnb.recordings.bag_files import Bag, Message
from steelnb.recordings.choice import Intrinsics
from steelnb.recordings.stamps import NANO, rising
from steelnb.recordings.topics import CAMERA, IMU, ODOMETRY, POSE, TRANSFORM, Topics
from steelnb.recordings.trajectories import trajectory_of
from steelnb.recordings.transforms import Transforms


class Contents:
    """What one pass over a bag gathers.

    ``frame_of`` is the frame of the scans and of the pictures, ``size`` that of the first scan in words;
    ``intrinsics`` are those of the CameraInfo chosen, None where it has none, and ``distortion`` says that it has more.
    """

    def __init__(self, bag: Bag, topics: Topics, series: bool) -> None:
        self.skipped: Counter[str] = Counter()
        self.frame_of: dict[str, str] = {}
        self.stamps = {topic: Stamps() for topic in (topics.scans, topics.pictures) if topic}
        self.poses = {topic: Poses(bag.types[topic]) for topic in (topics.poses, topics.truth) if topic}
        self.imu = Samples()
        self.transforms = Transforms(series)
        self.size = ""
        self.intrinsics: Intrinsics | None = None
        self.distortion = ""
        wanted = {*self.stamps, *self.poses, *topics.transforms, *(t for t in (topics.imu, topics.camera) if t)}
        for message in bag.walk(wanted):
            try:
                self._take(bag, topics, message)
            except FileContentError:
                self.skipped[f"malformed {bag.types[message.topic].rpartition('/')[2]}"] += 1

    def _take(self, bag: Bag, topics: Topics, message: Message) -> None:
        topic, kind = message.topic, bag.types[message.topic]
        if topic in self.stamps:
            if topic not in self.frame_of:
                self._describe(bag, message, scan=topic == topics.scans)
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
            if self.intrinsics is None:
                self._calibrate(bag.decode(message), bag.ros)
        else:
            for each in bag.decode(message).transforms:
                pose = (*_xyz(each.transform.translation), *_xyz(each.transform.rotation), each.transform.rotation.w)
                if not self.transforms.add(
                    each.header.frame_id, each.child_frame_id, _seconds(each.header.stamp), pose
                ):
                    self.skipped["tf that is no transform"] += 1

    def _describe(self, bag: Bag, message: Message, scan: bool) -> None:
        try:
            first = bag.decode(message)
        except FileContentError:
            return  # counted when it is walked through; the next one may do
        self.frame_of[message.topic] = str(first.header.frame_id)
        if scan:
            self.size = f"{first.width} × {first.height}"

    def _calibrate(self, info: Any, ros: int) -> None:
        K, distortion = (info.K, info.D) if ros == 1 else (info.k, info.d)
        if K[0] > 0 and K[4] > 0 and np.isfinite(K).all():
            size = {"width": info.width or None, "height": info.height or None}
            self.intrinsics = Intrinsics(fx=K[0], fy=K[4], cx=K[2], cy=K[5], **size)
            self.distortion = ", its distortion ignored" if np.any(distortion) else ""


class Stamps:
    """Stamps of a topic's messages; where all in the headers are zero, when they were received."""

    def __init__(self) -> None:
        self._own, self._received = array("d"), array("d")

    def add(self, stamp_ns: int | None, received_ns: int) -> None:
        self._own.append(np.nan if stamp_ns is None else stamp_ns / NANO)
        self._received.append(received_ns / NANO)

    def seconds(self) -> Array:
        own = np.array(self._own)
        return np.array(self._received) if len(own) > 1 and not own.any() else own


class Poses:
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


class Samples:
    """Inertial samples."""

    def __init__(self) -> None:
        self._rows = array("d")
        self.frame = ""

    def add(self, message: Any, stamp_ns: int) -> None:
        self.frame = self.frame or message.header.frame_id
        self._rows.extend((stamp_ns / NANO, *_xyz(message.linear_acceleration), *_xyz(message.angular_velocity)))

    def samples(self, skipped: Counter[str], R_drone_imu: Array) -> Imu:
        rows = np.array(self._rows).reshape(-1, 7)
        finite = np.isfinite(rows).all(axis=1)
        if not finite.all():
            skipped["IMU sample not finite"] += int((~finite).sum())
        rows = rows[finite]
        rows = rows[rising(rows[:, 0], skipped, "IMU sample: ")]
        return Imu(rows[:, 0], rows[:, 1:4] @ R_drone_imu.T, rows[:, 4:] @ R_drone_imu.T)


def _xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _seconds(stamp: Any) -> float:
    return (stamp.sec * NANO + stamp.nanosec) / NANO
