"""ROS 1 bags, ROS 2 folders, MCAP and sqlite files → `Recording`.

Opening walks once through what was chosen and keeps stamps, poses and inertial samples; scans and pictures are read
again, one by one, when they are walked through.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steelnb.datatypes import Array, Scan, Trajectory
from steelnb.errors import FileContentError, RecordingError
from steelnb.recordings.bag_files import Bag, Message
from steelnb.recordings.bag_frames import Frames, is_optical, poses_of_transforms
from steelnb.recordings.bag_images import decode_depth, decode_picture
from steelnb.recordings.bag_pass import Contents
from steelnb.recordings.choice import Choice, Intrinsics, read_settings
from steelnb.recordings.pinhole import depth_points, from_optical
from steelnb.recordings.pointcloud2 import decode_points
from steelnb.recordings.recording import Picture, Recording
from steelnb.recordings.stamps import rising
from steelnb.recordings.topics import Topics, choose_topics, held
from steelnb.recordings.trajectories import read_trajectory

REASONS_MAX = 30
"""A damaged bag may have a reason of its own for each message; more are counted as one."""


def open_bag(path: Path, choice: Choice) -> Recording:
    """The flight in a bag. Raises `FileContentError`, `FileMissingError`, `TopicError`, `RecordingError`,
    `ExtrinsicsError` and `SettingsError`; see `steelnb.recordings.formats.open_recording`."""
    extrinsics, intrinsics = read_settings(choice.settings)
    bag = Bag(path)
    topics = choose_topics(bag, choice)
    read = Contents(bag, topics, series=topics.poses is None)
    skipped = read.skipped
    facts = {"form": bag.form, "scans": topics.scans, "size": read.size, **topics.unclear}
    stamp_s = read.stamps[topics.scans].seconds()
    kept = rising(stamp_s, skipped, "scan: ", "scan without a stamp")
    if not kept.any():
        raise RecordingError(f"{path}: {topics.scans} has no scan with a stamp; expected at least one")
    sensor = read.frame_of.get(topics.scans, "")
    optical = topics.depth or is_optical(sensor)
    poses, body = _poses(bag, read, topics, choice, facts)
    frames = Frames(read.transforms, body, sensor, optical)
    T_drone_sensor, facts["extrinsics"] = frames.extrinsics(extrinsics, choice.settings)
    poses, turned = frames.of_drone(poses)
    facts["frames"] = f"poses of {body or 'the body'}{turned}, scans in {sensor or 'the sensor'}"
    decode = _depth_decoder(bag, read, topics, intrinsics, facts) if topics.depth else _cloud_decoder(bag, optical)

    imu, pictures, truth = None, None, None
    if topics.imu is not None:
        imu = read.imu.samples(skipped, frames.R_drone(read.imu.frame))
        facts["imu"] = topics.imu
    if topics.pictures is not None:
        taken_s = read.stamps[topics.pictures].seconds()
        shown = rising(taken_s, skipped, "picture: ", "picture without a stamp")
        pictures = BagPictures(bag, topics.pictures, shown, taken_s[shown], skipped)
        facts["pictures"] = topics.pictures
    if topics.truth is not None:
        reasons: Counter[str] = Counter()
        truth, _ = frames.of_drone(read.poses[topics.truth].trajectory(path, reasons))
        skipped.update({f"truth: {reason}": count for reason, count in reasons.items()})
        facts["truth"] = topics.truth
    scans = BagScans(bag, topics.scans, kept, stamp_s[kept], decode, skipped)
    return Recording(path, scans, poses, T_drone_sensor, imu, truth, pictures, skipped, facts)


def _poses(
    bag: Bag, read: Contents, topics: Topics, choice: Choice, facts: dict[str, str]
) -> tuple[Trajectory, str | None]:
    """The poses, and the frame that they are of, where that is known: from a topic, a file that was named, or tf."""
    if topics.poses is not None:
        facts["poses"] = f"true poses, {topics.poses}" if topics.poses == topics.truth else topics.poses
        return read.poses[topics.poses].trajectory(bag.path, read.skipped), read.poses[topics.poses].body
    if choice.poses is not None and choice.poses not in topics.transforms:
        facts["poses"] = f"file {choice.poses}"
        return read_trajectory(choice.poses, read.skipped), None
    found = poses_of_transforms(read.transforms, read.frame_of.get(topics.scans, ""))
    if found is None:
        raise RecordingError(
            f"{bag.path}: no poses; expected a topic of type Odometry, PoseStamped, PoseWithCovarianceStamped or "
            f"TransformStamped, tf from odom, world or map to the body, or a trajectory file: {held(bag)}"
        )
    poses, body, facts["poses"] = found
    return poses, body


class _Messages:
    """The messages of one topic whose stamps rise; read anew on every walk, each fault counted once."""

    def __init__(self, bag: Bag, topic: str, kept: NDArray[np.bool_], stamp_s: Array, skipped: Counter[str]) -> None:
        self.stamp_s = stamp_s
        self._bag, self._topic, self._kept, self._skipped = bag, topic, kept, skipped
        self._counted = np.zeros(len(stamp_s), dtype=bool)

    def _walk(self, wanted: NDArray[np.bool_] | None = None) -> Iterator[tuple[int, Message]]:
        """The wanted ones, each with its number. Raises `FileContentError` where the bag is damaged."""
        number = np.full(len(self._kept), -1)
        number[self._kept] = np.where(True if wanted is None else wanted, np.arange(len(self.stamp_s)), -1)
        last = int(number.max(initial=-1))
        if last < 0:
            return
        for k, message in zip(number.tolist(), self._bag.walk([self._topic]), strict=False):
            if k >= 0:
                yield k, message
            if k == last:
                return
        raise FileContentError(
            f"{self._bag.path}: {self._topic} has fewer messages than when it was opened; expected {len(self._kept)}"
        )

    def _count(self, k: int, reason: str) -> None:
        if not self._counted[k]:
            self._counted[k] = True
            few = reason in self._skipped or len(self._skipped) < REASONS_MAX
            self._skipped[reason if few else reason.partition(":")[0]] += 1

    def _malformed(self, what: str, fault: FileContentError) -> str:
        return f"malformed {what}: {str(fault).removeprefix(f'{self._bag.path}: ')}"


class BagScans(_Messages):
    """The scans of one topic (`ScanSource`)."""

    def __init__(
        self,
        bag: Bag,
        topic: str,
        kept: NDArray[np.bool_],
        stamp_s: Array,
        decode: Callable[[Message], Array],
        skipped: Counter[str],
    ) -> None:
        super().__init__(bag, topic, kept, stamp_s, skipped)
        self._decode = decode

    def walk(self, wanted: NDArray[np.bool_] | None = None) -> Iterator[Scan]:
        """All scans, or those of a mask ``(K,)``. Raises `FileContentError` where the bag is damaged."""
        for k, message in self._walk(wanted):
            points, reason = self._points(message)
            if reason:
                self._count(k, reason)
            yield Scan(float(self.stamp_s[k]), points)

    def _points(self, message: Message) -> tuple[Array, str]:
        none = np.zeros((0, 3))
        try:
            points = self._decode(message)
        except FileContentError as fault:
            return none, self._malformed("cloud", fault)
        if not points.size:
            return none, "empty cloud"
        if np.isnan(points[..., 0]).all():
            return none, "no finite point"
        return points, ""


class BagPictures(_Messages):
    """The pictures of one topic (`PictureSource`); one that cannot be decoded is left out of a walk, and counted."""

    def walk(self) -> Iterator[Picture]:
        """All pictures in the order of their stamps."""
        for k, message in self._walk():
            try:
                pixels = decode_picture(self._bag.decode(message))
            except FileContentError as fault:
                self._count(k, self._malformed("picture", fault))
                continue
            yield Picture(float(self.stamp_s[k]), pixels)


def _cloud_decoder(bag: Bag, optical: bool) -> Callable[[Message], Array]:
    def decode(message: Message) -> Array:
        points = decode_points(bag.decode(message))
        return from_optical(points) if optical else points

    return decode


def _depth_decoder(
    bag: Bag, read: Contents, topics: Topics, named: Intrinsics | None, facts: dict[str, str]
) -> Callable[[Message], Array]:
    camera, facts["intrinsics"] = named, "settings"
    if camera is None and topics.camera is not None:
        camera, facts["intrinsics"] = read.intrinsics, topics.camera + read.distortion
    if camera is None:
        raise RecordingError(
            f"{bag.path}: no intrinsics for the depth images {topics.scans}; expected a CameraInfo with focal lengths "
            f"or [intrinsics] in a settings file: {held(bag)}"
        )

    def decode(message: Message) -> Array:
        depth = decode_depth(bag.decode(message), camera.depth_scale)
        rows, columns = depth.shape
        if (columns, rows) != (camera.width or columns, camera.height or rows):
            raise FileContentError(f"{columns} × {rows} pixels; expected {camera.width} × {camera.height}")
        return depth_points(depth, camera)

    return decode
