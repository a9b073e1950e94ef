"""`Flight` → ROS 1 bag, MCAP or sqlite file, or ROS 2 folder, by rosbags' writers, one scan in memory at a time."""

import heapq
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.errors import OutputError, RecordingError, UnsupportedFormatError, needs
from steelnb.files import new_folder, replace_files
from steelnb.images import GreyImage
from steelnb.io.bag_files import STORAGES, TRANSFORMS, truth_path, typestore
from steelnb.io.bag_topics import CAMERA, CLOUD, IMAGE, IMU, ODOMETRY, TRANSFORM
from steelnb.io.calibration import T_SENSOR_OPTICAL
from steelnb.io.trajectories import write_tum
from steelnb.types import Array, Flight, Trajectory

WORLD, BODY, SENSOR, OPTICAL = "odom", "base_link", "tof", "camera_optical_frame"
"""Frames. The poses drift, so the world is REP 105's odom."""
TOPICS = {
    "/tf_static": TRANSFORMS[0], "/tf": TRANSFORMS[0], "/odom": ODOMETRY, "/imu": IMU, "/tof/points": CLOUD,
    "/camera/camera_info": CAMERA, "/camera/image_raw": IMAGE,
}  # fmt: skip
BAG_FILES = ("metadata.yaml", *(f"*{ending}" for ending in STORAGES))
"""What a ROS 2 folder consists of."""
Entry = tuple[int, int, str, Any]
"""Nanoseconds, rank among those of the same stamp, topic, message."""


def write_flight(
    path: Path | str,
    flight: Flight,
    truth: Trajectory | None = None,
    on_progress: Callable[[float], None] | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a flight as a drone's own nodes would record it, and the truth, if any, to ``STEM.truth.tum`` beside it.

    Scans (PointCloud2, float32), drifting poses (Odometry and tf), the mounts (tf_static), the IMU, and
    a camera's images (Image, mono8, with CameraInfo). A path that ends
    in .bag, .mcap or .db3 becomes that file, one without ending a ROS 2 folder. ``on_progress`` gets the share done.
    ``overwrite`` replaces a recording and its truth. Nothing half-written stays. Raises `UnsupportedFormatError`,
    `OutputError`, `RecordingError` for a stamp that bags cannot hold, and what reading the scans raises.
    """
    path = Path(path).absolute()
    check_target(path, truth is not None, overwrite)
    with new_folder(path.parent, overwrite=overwrite) as folder:
        try:
            _write(folder / path.name, flight, on_progress or (lambda _: None))
        except sqlite3.Error as fault:
            raise OutputError(f"{path}: cannot be written: {fault}") from None
        if truth is not None:
            write_tum(truth_path(folder / path.name), truth)
        if overwrite and path.is_dir():  # a ROS 2 folder: folders, unlike files, cannot be renamed over others
            replace_files(folder / path.name, path, BAG_FILES)


def check_target(path: Path, with_truth: bool, overwrite: bool = False) -> None:
    """Raise `UnsupportedFormatError` or `OutputError` for a path that `write_flight` would refuse.

    With ``overwrite``, a recording of the same kind is replaced, and its truth by that of the new one. All else that
    exists is refused: folders that hold no recording, and the truth of a recording of another ending.
    """
    if path.suffix.lower() not in ("", ".bag", *STORAGES):
        raise UnsupportedFormatError(
            f"{path}: ending {path.suffix!r}; expected .bag, .mcap, .db3 or a folder name for ROS 2"
        )
    there = os.path.lexists(path)
    if there and not overwrite:
        raise OutputError(f"{path}: exists already; expected a new name, or --force to overwrite")
    if there and not (path.is_file() if path.suffix else (path / "metadata.yaml").is_file()):
        raise OutputError(f"{path}: exists and is no such recording; expected a new name, or a recording to overwrite")
    if truth_path(path).exists() and not (there and with_truth):
        why = "holds another flight's truth" if with_truth else "would be taken for this flight's truth"
        raise OutputError(f"{truth_path(path)}: {why}; expected no such file")
    place = next(folder for folder in path.absolute().parents if folder.exists())
    if not place.is_dir() or not os.access(place, os.W_OK):
        raise OutputError(f"{path}: cannot be written: {place} is no folder that can be written to")


def _write(path: Path, flight: Flight, on_progress: Callable[[float], None]) -> None:
    with needs("io"):
        from rosbags import rosbag1, rosbag2

    ros = 1 if path.suffix.lower() == ".bag" else 2
    store, single = typestore(ros), path.suffix.lower() in STORAGES
    with tempfile.TemporaryDirectory() as plain:
        # rosbags puts the path of a sqlite file into a URI, where #, ? and % have a meaning.
        Path(plain, "out").symlink_to(path.parent)
        folder = Path(plain, "out", "bag") if single else path
        plugin = rosbag2.StoragePlugin.SQLITE3 if path.suffix.lower() == ".db3" else rosbag2.StoragePlugin.MCAP
        serialize = store.serialize_ros1 if ros == 1 else store.serialize_cdr
        writer: Any = rosbag1.Writer(path) if ros == 1 else rosbag2.Writer(folder, version=8, storage_plugin=plugin)
        with writer:
            connections = {}
            for topic, kind in TOPICS.items():
                if topic == "/imu" and (flight.imu is None or not len(flight.imu.stamp_s)):
                    continue
                if topic.startswith("/camera/") and not flight.images:
                    continue
                latched = topic == "/tf_static"
                more: dict[str, Any] = (
                    {"latching": int(latched)} if ros == 1 else {"offered_qos_profiles": [_quality(latched)]}
                )
                connections[topic] = writer.add_connection(topic, kind, typestore=store, **more)
            for stamp_ns, _, topic, message in _entries(flight, Messages(ros), on_progress):
                writer.write(connections[topic], stamp_ns, serialize(message, TOPICS[topic]))
        if single:
            # Its metadata is in the file too (MCAP) or can be found again (`ros2 bag reindex`).
            os.replace(folder / f"{folder.name}{path.suffix.lower()}", path)
            shutil.rmtree(folder)


def _entries(flight: Flight, make: "Messages", on_progress: Callable[[float], None]) -> Iterator[Entry]:
    """All messages in the order of their stamps, made as they are asked for."""
    prior, stamps = flight.prior, [_ns(stamp_s) for stamp_s in flight.prior.stamp_s.tolist()]
    quaternion = Rotation.from_matrix(prior.T_world_drone[:, :3, :3]).as_quat()

    def poses() -> Iterator[Entry]:
        mounts = {SENSOR: flight.T_drone_sensor}
        if flight.images:  # in a frame of optical axes, as image_pipeline's nodes expect
            mounts[OPTICAL] = flight.images.T_drone_camera @ T_SENSOR_OPTICAL
        for frame, mount in mounts.items() if stamps else ():
            turn = Rotation.from_matrix(mount[:3, :3]).as_quat()
            yield stamps[0], 0, "/tf_static", make.transform(stamps[0], BODY, frame, mount[:3, 3], turn)
        for stamp, place, turn in zip(stamps, prior.position, quaternion, strict=True):
            yield stamp, 1, "/tf", make.transform(stamp, WORLD, BODY, place, turn)
            yield stamp, 2, "/odom", make.odometry(stamp, place, turn)

    def inertial() -> Iterator[Entry]:
        if (imu := flight.imu) is not None:
            for stamp_s, force, rate in zip(imu.stamp_s.tolist(), imu.specific_force, imu.angular_rate, strict=True):
                yield _ns(stamp_s), 3, "/imu", make.imu(_ns(stamp_s), force, rate)

    def scans() -> Iterator[Entry]:
        for k, (stamp, scan) in enumerate(zip(stamps, flight.scans, strict=True)):
            yield stamp, 4, "/tof/points", make.cloud(stamp, scan.points)
            on_progress((k + 1) / len(stamps))

    def images() -> Iterator[Entry]:
        if (camera := flight.images) is not None:
            for stamp_s, image in zip(camera.stamp_s.tolist(), camera.images, strict=True):
                if image is not None:
                    yield _ns(stamp_s), 5, "/camera/camera_info", make.camera(_ns(stamp_s), camera.K, image.shape)
                    yield _ns(stamp_s), 6, "/camera/image_raw", make.image(_ns(stamp_s), image)

    return heapq.merge(poses(), inertial(), scans(), images(), key=lambda entry: entry[:2])


class Messages:
    """The messages of ROS 1 or 2, which differ in their headers alone."""

    def __init__(self, ros: int) -> None:
        self._sequence, self._store = (0,) if ros == 1 else (), typestore(ros)

    def transform(self, stamp_ns: int, parent: str, child: str, place: Array, turn: Array) -> Any:
        """tf with one transform."""
        pose = (tuple(place.tolist()), tuple(turn.tolist()))
        return self.make(TRANSFORMS[0], [self.make(TRANSFORM, self.header(stamp_ns, parent), child, pose)])

    def odometry(self, stamp_ns: int, place: Array, turn: Array) -> Any:
        """Odometry without velocities."""
        pose, still, unknown = (tuple(place.tolist()), tuple(turn.tolist())), (0.0, 0.0, 0.0), np.zeros(36)
        return self.make(ODOMETRY, self.header(stamp_ns, WORLD), BODY, (pose, unknown), ((still, still), unknown))

    def imu(self, stamp_ns: int, force: Array, rate: Array) -> Any:
        """Specific force and angular rate; no orientation, which −1 in its covariance says."""
        unknown, none, level = np.array([-1.0, 0, 0, 0, 0, 0, 0, 0, 0]), np.zeros(9), (0.0, 0.0, 0.0, 1.0)
        turning, pushed = tuple(rate.tolist()), tuple(force.tolist())
        return self.make(IMU, self.header(stamp_ns, BODY), level, unknown, turning, none, pushed, none)

    def cloud(self, stamp_ns: int, points: Array) -> Any:
        """PointCloud2 of float32 x, y, z without padding, organised where the points ``(H, W, 3)`` are."""
        rows, columns = points.shape[:2] if points.ndim == 3 else (1, len(points))
        with np.errstate(over="ignore", invalid="ignore"):
            numbers = np.ascontiguousarray(points, dtype="<f4")
        fields = [self.make("sensor_msgs/msg/PointField", axis, 4 * k, 7, 1) for k, axis in enumerate("xyz")]
        data, dense = numbers.reshape(-1).view(np.uint8), bool(np.isfinite(numbers).all())
        header = self.header(stamp_ns, SENSOR)
        return self.make(CLOUD, header, rows, columns, fields, False, 12, 12 * columns, data, dense)

    def camera(self, stamp_ns: int, K: Array, shape: tuple[int, int]) -> Any:
        """CameraInfo without distortion of images of rows and columns ``shape``."""
        roi, P = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False), np.column_stack([K, np.zeros(3)])
        calibration = (np.zeros(5), K.ravel(), np.eye(3).ravel(), P.ravel())
        return self.make(CAMERA, self.header(stamp_ns, OPTICAL), *shape, "plumb_bob", *calibration, 0, 0, roi)

    def image(self, stamp_ns: int, grey: GreyImage) -> Any:
        """Image of grey levels ``(H, W)``."""
        rows, columns = grey.shape
        return self.make(IMAGE, self.header(stamp_ns, OPTICAL), rows, columns, "mono8", 0, columns, grey.ravel())

    def header(self, stamp_ns: int, frame: str) -> tuple:
        """Values of a header, with a sequence number in ROS 1."""
        return (*self._sequence, divmod(stamp_ns, 10**9), frame)

    def make(self, kind: str, *values: Any) -> Any:
        """A message of a type from the values of its fields; a tuple holds those of a message inside it."""
        fields = self._store.fielddefs[kind][1]
        pairs = zip(fields, values, strict=True)
        return self._store.types[kind](*(self.make(of, *v) if isinstance(v, tuple) else v for (_, (_, of)), v in pairs))


def _ns(stamp_s: float) -> int:
    stamp_ns = round(Decimal(stamp_s) * 10**9)  # a product of floating-point numbers would miss it by a hundred
    if not 0 <= stamp_ns < 2**31 * 10**9:
        raise RecordingError(f"stamp {stamp_s} s; expected 0 to 2³¹ s, which is what bags hold")
    return stamp_ns


def _quality(latched: bool) -> Any:
    """Reliable; latched topics are kept for late subscribers, as ROS 2 expects of tf_static."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    forever = QosTime(2147483647, 4294967295)
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    kept = (QosHistory.KEEP_LAST, 1 if latched else 10, QosReliability.RELIABLE, durability)
    return Qos(*kept, forever, forever, QosLiveliness.AUTOMATIC, forever, False)
