"""Writer of a `Flight` to a ROS 1 bag or an MCAP file with rosbags, one scan in memory at a time."""

import heapq
import os
import tempfile
from collections.abc import Callable, Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError, OutputError
from steelnb.core.files import OVERWRITE, check_writable, new_folder
from steelnb.core.types import Array, Flight, Trajectory
from steelnb.io.messages import CLOUD, IMU, ODOMETRY, TF, typestore
from steelnb.io.recordings import truth_path
from steelnb.io.trajectories import write_tum

WORLD, BODY, SENSOR = "odom", "base_link", "tof"
"""Frame names. The world frame is odom of REP 105, since the poses drift."""
TOPICS = {"/tf_static": TF[0], "/tf": TF[0], "/odom": ODOMETRY, "/imu": IMU, "/tof/points": CLOUD}
Entry = tuple[int, str, Any]
"""Stamp in nanoseconds, topic, message."""


def check_target(path: Path, overwrite: bool = False) -> None:
    """Raise `InputError` unless the suffix is .bag or .mcap, and `OutputError` if the path or its truth exists, or
    nothing can be written there."""
    if path.suffix.lower() not in (".bag", ".mcap"):
        raise InputError(f"{path}: ending {path.suffix!r}; expected .bag or .mcap")
    for each in (path, truth_path(path)):  # the truth may be another recording's
        if os.path.isdir(each) or (os.path.exists(each) and not overwrite):
            raise OutputError(f"{each}: exists already; expected a new name, or {OVERWRITE}")
    check_writable(path.parent)


def write_flight(
    path: Path | str,
    flight: Flight,
    truth: Trajectory | None = None,
    on_progress: Callable[[float], None] = lambda _: None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a flight to a ROS 1 bag (.bag) or an MCAP file (.mcap), as the nodes of a drone would record it.

    The file holds the scans (PointCloud2, float32), the drifting poses (Odometry and tf), the mount (tf_static) and the
    IMU. The ``truth``, if given, goes to ``STEM.truth.tum`` beside it. ``on_progress`` is called with the fraction
    written. Raises `InputError` and `OutputError`; no partial file is left on failure.
    """
    from rosbags import rosbag1, rosbag2

    path = Path(path)
    check_target(path, overwrite)
    if not len(flight.scans):
        raise InputError("flight: no scans; expected at least one to write")
    ros = 1 if path.suffix.lower() == ".bag" else 2
    store = typestore(ros)
    serialize = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    with new_folder(path.parent) as folder, tempfile.TemporaryDirectory(dir=folder) as scratch:
        bag_file, bag_folder = Path(scratch, "bag.bag"), Path(scratch, "bag")
        mcap: Any = {"version": 8, "storage_plugin": rosbag2.StoragePlugin.MCAP}
        writer: Any = rosbag1.Writer(bag_file) if ros == 1 else rosbag2.Writer(bag_folder, **mcap)
        with writer:
            topics = {topic: kind for topic, kind in TOPICS.items() if topic != "/imu" or flight.imu}
            connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in topics.items()}
            for stamp_ns, topic, message in _entries(flight, Messages(ros), on_progress):
                writer.write(connections[topic], stamp_ns, serialize(message, TOPICS[topic]))
        (bag_file if ros == 1 else bag_folder / "bag.mcap").rename(folder / path.name)
        if truth is not None:
            write_tum(truth_path(folder / path.name), truth)


def _entries(flight: Flight, make: "Messages", on_progress: Callable[[float], None]) -> Iterator[Entry]:
    """All messages sorted by stamp, created lazily."""
    stamps = [_ns(stamp_s) for stamp_s in flight.prior.stamp_s.tolist()]

    def poses_and_scans() -> Iterator[Entry]:
        yield stamps[0], "/tf_static", make.transform(stamps[0], BODY, SENSOR, flight.T_drone_sensor)
        for k, (stamp, T, scan) in enumerate(zip(stamps, flight.prior.T_world_drone, flight.scans, strict=True), 1):
            yield stamp, "/tf", make.transform(stamp, WORLD, BODY, T)
            yield stamp, "/odom", make.odometry(stamp, T)
            yield stamp, "/tof/points", make.cloud(stamp, scan.points)
            on_progress(k / len(stamps))

    def inertial() -> Iterator[Entry]:
        if (imu := flight.imu) is not None:
            for stamp_s, force, rate in zip(imu.stamp_s.tolist(), imu.specific_force, imu.angular_rate, strict=True):
                yield _ns(stamp_s), "/imu", make.imu(_ns(stamp_s), force, rate)

    return heapq.merge(inertial(), poses_and_scans(), key=lambda entry: entry[0])


class Messages:
    """Constructors of ROS 1 or ROS 2 messages, which differ only in their headers."""

    def __init__(self, ros: int) -> None:
        self._sequence, self._store = (0,) if ros == 1 else (), typestore(ros)

    def transform(self, stamp_ns: int, parent: str, child: str, T_parent_child: Array) -> Any:
        """TFMessage with one transform."""
        kind = "geometry_msgs/msg/TransformStamped"
        return self.make(TF[0], [self.make(kind, self.header(stamp_ns, parent), child, _pose(T_parent_child))])

    def odometry(self, stamp_ns: int, T_world_drone: Array) -> Any:
        """Odometry without velocities."""
        zero, covariance = (0.0, 0.0, 0.0), np.zeros(36)
        twist, pose = ((zero, zero), covariance), (_pose(T_world_drone), covariance)
        return self.make(ODOMETRY, self.header(stamp_ns, WORLD), BODY, pose, twist)

    def imu(self, stamp_ns: int, force: Array, rate: Array) -> Any:
        """Specific force and angular rate; −1 in the covariance of the orientation marks it as unknown."""
        orientation, unknown, covariance = (0.0, 0.0, 0.0, 1.0), np.array([-1.0, *[0] * 8]), np.zeros(9)
        readings = (tuple(rate.tolist()), covariance, tuple(force.tolist()), covariance)
        return self.make(IMU, self.header(stamp_ns, BODY), orientation, unknown, *readings)

    def cloud(self, stamp_ns: int, points: Array) -> Any:
        """PointCloud2 of float32 x, y, z without padding; organised for points ``(H, W, 3)``."""
        rows, columns = points.shape[:2] if points.ndim == 3 else (1, len(points))
        data = np.ascontiguousarray(points, dtype="<f4").reshape(-1).view(np.uint8)
        fields = [self.make("sensor_msgs/msg/PointField", axis, 4 * k, 7, 1) for k, axis in enumerate("xyz")]
        header, dense = self.header(stamp_ns, SENSOR), bool(np.isfinite(points).all())
        return self.make(CLOUD, header, rows, columns, fields, False, 12, 12 * columns, data, dense)

    def header(self, stamp_ns: int, frame: str) -> tuple:
        """Field values of a header, which has a sequence number in ROS 1."""
        return (*self._sequence, divmod(stamp_ns, 10**9), frame)

    def make(self, kind: str, *values: Any) -> Any:
        """A message of type ``kind`` from its field values; a tuple stands for a nested message."""
        fields = self._store.fielddefs[kind][1]
        pairs = zip(fields, values, strict=True)
        return self._store.types[kind](*(self.make(of, *v) if isinstance(v, tuple) else v for (_, (_, of)), v in pairs))


def _pose(T: Array) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return tuple(T[:3, 3].tolist()), tuple(Rotation.from_matrix(T[:3, :3]).as_quat().tolist())


def _ns(stamp_s: float) -> int:
    if not 0 <= stamp_s < 2**31:
        raise InputError(f"stamp {stamp_s:.10g} s: expected 0 to 2147483648 s, as ROS has them")
    return round(Decimal(stamp_s) * 10**9)  # a float product would be off by 100 ns
