"""Flights in memory, and bags written by rosbags."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.types import Array, Flight, Imu, Scan, Trajectory
from steelnb.io.bag_writer import Messages
from steelnb.io.messages import (
    CAMERA,
    CLOUD,
    IMAGE,
    IMU,
    ODOMETRY,
    POSE_COVARIANCE,
    POSE_STAMPED,
    TF,
    TRANSFORM,
    typestore,
)

KINDS = ("a.bag", "a.mcap", "a.db3")
TRIALS = int(os.environ.get("STEELNB_FUZZ", "100"))
"""Damaged files of each format."""
STAMPS = np.round(0.2 * np.arange(5), 9)
POINTS = np.arange(60, dtype=float).reshape(4, 5, 3) + 1


def T_of(xyz=(0, 0, 0), rpy=(0, 0, 0)) -> Array:
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = xyz, Rotation.from_euler("xyz", rpy).as_matrix()
    return T


def poses(count: int, step_s: float = 0.2, begin_s: float = 0.0, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, 3] = rng.normal(size=(count, 3))
    T[:, :3, :3] = Rotation.random(count, rng).as_matrix()
    return Trajectory(np.round(begin_s + step_s * np.arange(count), 9), T)


def made_up(count: int = 6, rows: int = 5, columns: int = 7, begin_s: float = 0.0) -> Flight:
    """Organised float32 scans with one NaN, random poses, a mount, and an IMU at 50 Hz."""
    rng = np.random.default_rng(1)
    prior = poses(count, begin_s=begin_s)
    scans = []
    for stamp in prior.stamp_s:
        points = rng.normal(size=(rows, columns, 3)).astype(np.float32).astype(np.float64)
        points[0, 0] = np.nan
        scans.append(Scan(float(stamp), points))
    time_s = np.round(np.arange(prior.stamp_s[0], prior.stamp_s[-1], 0.02), 9)
    imu = Imu(time_s, rng.normal(size=(len(time_s), 3)), rng.normal(size=(len(time_s), 3)))
    return Flight(scans, prior, T_of((0.06, -0.01, 0.02), (0.1, -0.2, 0.3)), imu, "made-up")


class Bagged:
    """A bag under construction. Messages are received at their stamps."""

    def __init__(self, path: Path) -> None:
        self.path, self.make, self.rows = path, Messages(1 if path.suffix == ".bag" else 2), []

    def clouds(self, topic="/points", stamps=STAMPS, frame="tof", points=POINTS) -> "Bagged":
        for stamp in stamps:
            message = self.make.cloud(ns(stamp), points)
            message.header.frame_id = frame
            self.rows.append((topic, CLOUD, float(stamp), message))
        return self

    def odometry(self, topic="/odom", trajectory=None, child="base_link", kind=ODOMETRY, frame="odom") -> "Bagged":
        trajectory = trajectory or poses(len(STAMPS))
        for stamp, T in zip(trajectory.stamp_s, trajectory.T_world_drone, strict=True):
            message = self.make.odometry(ns(stamp), T)
            message.child_frame_id, message.header.frame_id = child, frame
            if kind == POSE_STAMPED:
                message = self.make.make(POSE_STAMPED, message.header, message.pose.pose)
            elif kind == POSE_COVARIANCE:
                message = self.make.make(POSE_COVARIANCE, message.header, message.pose)
            elif kind == TRANSFORM:
                message = self.make.transform(ns(stamp), frame, child, T).transforms[0]
            self.rows.append((topic, kind, float(stamp), message))
        return self

    def tf(self, parent, child, T, stamp=0.0, topic="/tf_static") -> "Bagged":
        self.rows.append((topic, TF[0], stamp, self.make.transform(ns(stamp), parent, child, T)))
        return self

    def moving(self, parent, child, trajectory=None, topic="/tf") -> "Bagged":
        """A transform at each stamp of a trajectory."""
        trajectory = trajectory or poses(len(STAMPS))
        for stamp, T in zip(trajectory.stamp_s, trajectory.T_world_drone, strict=True):
            self.tf(parent, child, T, float(stamp), topic)
        return self

    def imu(self, stamps, force, rate=(0.0, 0.0, 0.0), topic="/imu", frame="base_link") -> "Bagged":
        """Readings ``(3,)`` or one a stamp."""
        values = (np.broadcast_to(np.asarray(each, dtype=float), (len(stamps), 3)) for each in (force, rate))
        for stamp, *readings in zip(stamps, *values, strict=True):
            message = self.make.imu(ns(stamp), *readings)
            message.header.frame_id = frame
            self.rows.append((topic, IMU, float(stamp), message))
        return self

    def images(self, topic, pixels, encoding, frame="camera_optical_frame", stamps=STAMPS) -> "Bagged":
        for stamp in stamps:
            self.rows.append((topic, IMAGE, float(stamp), self.image(pixels, encoding, frame, stamp)))
        return self

    def image(self, pixels, encoding, frame="camera_optical_frame", stamp=0.0):
        raw = np.ascontiguousarray(pixels)
        data, header = raw.reshape(-1).view(np.uint8), self.make.header(ns(stamp), frame)
        return self.make.make(IMAGE, header, raw.shape[0], raw.shape[1], encoding, 0, raw[0].nbytes, data)

    def camera(
        self, K=(2.0, 0, 1.0, 0, 4.0, 0.5, 0, 0, 1), size=(2, 3), binning=0, roi=(0, 0, 0, 0), stamp_s=0.0,
        topic="/depth/camera_info", frame="c", P=(0.0,) * 12, distortion=(0.0,) * 5,
    ):  # fmt: skip
        part = self.make.make("sensor_msgs/msg/RegionOfInterest", *roi, False)
        arrays = (np.array(distortion), np.array(K), np.eye(3).ravel(), np.array(P))
        header = self.make.header(ns(stamp_s), frame)
        message = self.make.make(CAMERA, header, *size, "plumb_bob", *arrays, binning, binning, part)
        self.rows.append((topic, CAMERA, stamp_s, message))
        return self

    def write(self, in_order: bool = True, little_endian: bool = True) -> Path:
        """Write with rosbags. `bytes` are written unchanged. Unsorted rows are received 0.1 s apart."""
        from rosbags import rosbag1, rosbag2

        one = self.path.suffix == ".bag"
        store = typestore(1 if one else 2)
        folder = self.path.with_suffix(".rows") / "a"
        if one:
            writer: Any = rosbag1.Writer(self.path)
        else:
            folder.parent.mkdir()
            plugin = "MCAP" if self.path.suffix == ".mcap" else "SQLITE3"
            writer = rosbag2.Writer(folder, version=8, storage_plugin=rosbag2.StoragePlugin[plugin])
        rows = sorted(self.rows, key=lambda row: row[2]) if in_order else self.rows
        with writer:
            topics: dict[tuple[str, str], Any] = {}
            for k, (topic, kind, stamp, message) in enumerate(rows):
                if (topic, kind) not in topics:
                    topics[topic, kind] = writer.add_connection(topic, kind, typestore=store)
                raw = message
                if not isinstance(message, bytes):
                    more = {} if one else {"little_endian": little_endian}
                    raw = (store.serialize_ros1 if one else store.serialize_cdr)(message, kind, **more)
                writer.write(topics[topic, kind], ns(stamp if in_order else 0.1 * k), raw)
        if not one:
            (folder / f"a{self.path.suffix}").rename(self.path)
        return self.path


def ns(stamp_s: float) -> int:
    return round(stamp_s * 1e9)
