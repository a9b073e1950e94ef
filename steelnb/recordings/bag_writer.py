"""`Recording` → ROS 1 bag, MCAP or sqlite file, or ROS 2 folder: what a drone's own nodes would have recorded."""

import heapq
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steelnb.datatypes import Array
from steelnb.errors import OutputError, RecordingError
from steelnb.recordings.bag_files import STORAGES, TRANSFORMS, typestore
from steelnb.recordings.pointcloud2 import encode_points
from steelnb.recordings.recording import Recording
from steelnb.recordings.stamps import NANO, nanoseconds
from steelnb.recordings.topics import CLOUD, IMAGE, IMU, ODOMETRY

WORLD, BODY, SENSOR, CAMERA = "odom", "base_link", "tof", "camera"
"""Frames. The poses drift, so the world is REP 105's odom."""
Storage = Literal["ros1", "mcap", "sqlite"]
Entry = tuple[int, int, str, Any]
"""Nanoseconds, rank among those of the same stamp, topic, message."""


@dataclass(frozen=True)
class _Topic:
    kind: str
    latched: bool = False


TOPICS = {
    "/tf_static": _Topic(TRANSFORMS[0], latched=True),
    "/tf": _Topic(TRANSFORMS[0]),
    "/odom": _Topic(ODOMETRY),
    "/imu": _Topic(IMU),
    "/tof/points": _Topic(CLOUD),
    "/camera/image": _Topic(IMAGE),
}


def write_bag(path: Path, recording: Recording, storage: Storage, on_progress: Callable[[float], None]) -> None:
    """Write scans (PointCloud2, float32), poses (Odometry and tf), extrinsics (tf_static), IMU and pictures.

    A path that ends in .bag, .mcap or .db3 becomes that file; another a ROS 2 folder with its metadata. The truth is
    not written. Raises `OutputError`; what is there by then is the caller's to remove. Raises `RecordingError` for a
    stamp that bags cannot hold.
    """
    try:
        if storage == "ros1":
            _write_ros1(path, recording, on_progress)
        else:
            _write_ros2(path, recording, storage, on_progress)
    except sqlite3.Error as fault:
        raise OutputError(f"{path.name}: cannot be written: {fault}") from None


def _write_ros1(path: Path, recording: Recording, on_progress: Callable[[float], None]) -> None:
    from rosbags.rosbag1 import Writer

    store = typestore(1)
    with Writer(path) as writer:
        connections = {
            topic: writer.add_connection(
                topic, TOPICS[topic].kind, typestore=store, latching=int(TOPICS[topic].latched)
            )
            for topic in _topics(recording)
        }
        for stamp_ns, _, topic, message in _entries(recording, Messages(1), on_progress):
            writer.write(connections[topic], stamp_ns, store.serialize_ros1(message, TOPICS[topic].kind))


def _write_ros2(path: Path, recording: Recording, storage: Storage, on_progress: Callable[[float], None]) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer

    store = typestore(2)
    single = path.suffix.lower() in STORAGES
    folder = path.with_suffix("") if single else path
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer(folder, version=8, storage_plugin=plugin) as writer:
        connections = {
            topic: writer.add_connection(
                topic, TOPICS[topic].kind, typestore=store, offered_qos_profiles=[_quality(TOPICS[topic].latched)]
            )
            for topic in _topics(recording)
        }
        for stamp_ns, _, topic, message in _entries(recording, Messages(2), on_progress):
            writer.write(connections[topic], stamp_ns, store.serialize_cdr(message, TOPICS[topic].kind))
    if single:
        # Its metadata is in the file too (MCAP) or can be found again (`ros2 bag reindex`).
        os.replace(folder / f"{folder.name}.{'mcap' if storage == 'mcap' else 'db3'}", path)
        shutil.rmtree(folder)


def _topics(recording: Recording) -> list[str]:
    absent = {"/imu"} if recording.imu is None or not len(recording.imu.stamp_s) else set()
    absent |= {"/camera/image"} if recording.pictures is None else set()
    return [topic for topic in TOPICS if topic not in absent]


def _entries(recording: Recording, make: "Messages", on_progress: Callable[[float], None]) -> Iterator[Entry]:
    """All messages in the order of their stamps, made as they are asked for."""
    poses, stamps = recording.poses, recording.scans.stamp_s
    quaternion = Rotation.from_matrix(poses.T_world_drone[:, :3, :3]).as_quat()
    starts = [each[0] for each in (poses.stamp_s, stamps) if len(each)]

    def fixed() -> Iterator[Entry]:
        T = recording.T_drone_sensor
        turn = Rotation.from_matrix(T[:3, :3]).as_quat()
        for start in [min(starts)] if starts else []:
            yield _ns(start), 0, "/tf_static", make.transform(_ns(start), BODY, SENSOR, T[:3, 3], turn)

    def moving() -> Iterator[Entry]:
        for stamp, place, turn in zip(poses.stamp_s, poses.position, quaternion, strict=True):
            yield _ns(stamp), 1, "/tf", make.transform(_ns(stamp), WORLD, BODY, place, turn)
            yield _ns(stamp), 2, "/odom", make.odometry(_ns(stamp), place, turn)

    def inertial() -> Iterator[Entry]:
        if (imu := recording.imu) is not None:
            for stamp, force, rate in zip(imu.stamp_s, imu.specific_force, imu.angular_rate, strict=True):
                yield _ns(stamp), 3, "/imu", make.imu(_ns(stamp), force, rate)

    def scans() -> Iterator[Entry]:
        for k, scan in enumerate(recording.scans.walk()):
            yield _ns(scan.stamp_s), 4, "/tof/points", make.cloud(_ns(scan.stamp_s), scan.points)
            on_progress((k + 1) / len(stamps))

    def pictures() -> Iterator[Entry]:
        if recording.pictures is not None:
            for picture in recording.pictures.walk():
                yield _ns(picture.stamp_s), 5, "/camera/image", make.image(_ns(picture.stamp_s), picture.pixels)

    yield from heapq.merge(fixed(), moving(), inertial(), scans(), pictures(), key=lambda entry: entry[:2])


class Messages:
    """The messages of ROS 1 or 2; they differ in their headers alone."""

    def __init__(self, ros: int) -> None:
        self._ros, self._types = ros, typestore(ros).types

    def transform(self, stamp_ns: int, parent: str, child: str, place: Array, turn: Array) -> Any:
        """tf with one transform."""
        transform = self._make("geometry_msgs/msg/Transform", self._vector(place), self._quaternion(turn))
        stamped = self._make("geometry_msgs/msg/TransformStamped", self._header(stamp_ns, parent), child, transform)
        return self._make(TRANSFORMS[0], [stamped])

    def odometry(self, stamp_ns: int, place: Array, turn: Array) -> Any:
        """Odometry without velocities."""
        point = self._make("geometry_msgs/msg/Point", *map(float, place))
        pose = self._make("geometry_msgs/msg/Pose", point, self._quaternion(turn))
        still = self._make("geometry_msgs/msg/Twist", self._vector(np.zeros(3)), self._vector(np.zeros(3)))
        return self._make(
            ODOMETRY,
            self._header(stamp_ns, WORLD),
            BODY,
            self._make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)),
            self._make("geometry_msgs/msg/TwistWithCovariance", still, np.zeros(36)),
        )

    def imu(self, stamp_ns: int, force: Array, rate: Array) -> Any:
        """Specific force and angular rate; no orientation, which −1 in its covariance says."""
        unknown = np.zeros(9)
        unknown[0] = -1.0
        level = self._quaternion(np.array([0, 0, 0, 1.0]))
        header, none = self._header(stamp_ns, BODY), np.zeros(9)
        return self._make(IMU, header, level, unknown, self._vector(rate), none, self._vector(force), none)

    def cloud(self, stamp_ns: int, points: Array) -> Any:
        """PointCloud2, organised where the points are."""
        p = encode_points(points)
        return self._make(
            CLOUD,
            self._header(stamp_ns, SENSOR),
            p.height,
            p.width,
            [self._make("sensor_msgs/msg/PointField", f.name, f.offset, f.datatype, f.count) for f in p.fields],
            p.is_bigendian,
            p.point_step,
            p.row_step,
            p.data,
            p.is_dense,
        )

    def image(self, stamp_ns: int, pixels: NDArray[np.uint8]) -> Any:
        """rgb8 or mono8."""
        rows, columns = pixels.shape[:2]
        encoding, step = ("rgb8", 3 * columns) if pixels.ndim == 3 else ("mono8", columns)
        data = np.ascontiguousarray(pixels, dtype=np.uint8).reshape(-1)
        return self._make(IMAGE, self._header(stamp_ns, CAMERA), rows, columns, encoding, 0, step, data)

    def _header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", *divmod(stamp_ns, NANO))
        return self._make("std_msgs/msg/Header", *((0,) if self._ros == 1 else ()), stamp, frame)

    def _vector(self, xyz: Array) -> Any:
        return self._make("geometry_msgs/msg/Vector3", *map(float, xyz))

    def _quaternion(self, xyzw: Array) -> Any:
        return self._make("geometry_msgs/msg/Quaternion", *map(float, xyzw))

    def _make(self, kind: str, *values: Any) -> Any:
        return self._types[kind](*values)


def _ns(stamp_s: float) -> int:
    stamp_ns = nanoseconds(float(stamp_s))
    if not 0 <= stamp_ns < 2**31 * NANO:
        raise RecordingError(f"stamp {stamp_s} s; expected 0 to 2³¹ s, which is what bags hold")
    return stamp_ns


def _quality(latched: bool) -> Any:
    """Reliable; latched topics are kept for those who come late, as ROS 2 expects of tf_static."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    forever = QosTime(2147483647, 4294967295)
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    kept = (QosHistory.KEEP_LAST, 1 if latched else 10, QosReliability.RELIABLE, durability)
    return Qos(*kept, forever, forever, QosLiveliness.AUTOMATIC, forever, False)
