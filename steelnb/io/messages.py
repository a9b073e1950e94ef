"""ROS messages → arrays: points of PointCloud2 and of depth images, poses, inertial readings, stamps.

A message is read as its definition says. What contradicts itself is an `InputError` of that message.
"""

import functools
from typing import Any

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array

CLOUD, IMAGE, CAMERA = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
IMU, ODOMETRY, POSE_STAMPED = "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE, TRANSFORM = "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/TransformStamped"
POSES = (ODOMETRY, POSE_STAMPED, POSE_COVARIANCE, TRANSFORM)
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
DEPTHS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""Types and units, metres, of depth images (REP 118). An image called mono16 is one only if the user says so."""
SAID_DEPTHS = ("16UC1", "32FC1")
"""Encodings that say that an image is of depth."""
POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Datatypes of PointField."""


@functools.cache
def typestore(ros: int) -> Any:
    """Definitions of the standard messages of ROS 1 or 2 and of tf."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    for kind in TF:
        if kind not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return store


@np.errstate(invalid="ignore", over="ignore")
def cloud_points(message: Any, unit_m: float = 1.0) -> Array:
    """Points of a PointCloud2, metres: ``(H, W, 3)`` if it is organised, else ``(N, 3)``. Invalid points are NaN rows.

    Raises `InputError` for missing fields, and for sizes that exceed the data.
    """
    fields, order = {field.name: field for field in message.fields}, ">" if message.is_bigendian else "<"
    if missing := {*"xyz"} - {*fields}:
        raise InputError(f"PointCloud2 with fields {', '.join(fields)}; expected {', '.join(sorted(missing))} too")
    rows, columns, step = int(message.height), int(message.width), int(message.point_step)
    data = np.frombuffer(message.data, np.uint8)
    # Some drivers leave row_step zero, or give the size of all data. Data of the size of all points have no padding.
    row_step = columns * step if rows * columns * step == len(data) else int(message.row_step)
    points = np.empty((rows, columns, 3))
    for k, axis in enumerate("xyz"):
        if fields[axis].datatype not in POINT_TYPES:
            raise InputError(f"PointCloud2 whose {axis} has datatype {fields[axis].datatype}; expected 1 to 8")
        kind, offset = np.dtype(order + POINT_TYPES[fields[axis].datatype]), int(fields[axis].offset)
        if offset + kind.itemsize > step or columns * step > row_step or rows * row_step > len(data):
            sizes = f"{rows} × {columns} points with point_step {step} and row_step {row_step}"
            raise InputError(f"PointCloud2 of {sizes} in {len(data)} bytes of data, {axis} at {offset}")
        if points.size:
            points[..., k] = np.ndarray((rows, columns), kind, data, offset, (row_step, step))
    if unit_m != 1:
        points *= unit_m
    points[~np.isfinite(points[..., 0] + points[..., 1] + points[..., 2])] = np.nan
    return points if min(rows, columns) > 1 else points.reshape(-1, 3)


@np.errstate(invalid="ignore", over="ignore")
def depth_points(image: Any, camera: Any, unit_m: float | None = None) -> Array:
    """Points ``(H, W, 3)`` of a depth image in optical axes, metres, NaN where there is no depth: 0, less, NaN,
    infinite, or the largest integer. ``camera``: its CameraInfo, whose distortion is left out.

    Raises `InputError` for contradicting sizes.
    """
    if image.encoding not in DEPTHS:
        raise InputError(f"Image with encoding {image.encoding!r}; expected a depth image, {', '.join(DEPTHS)}")
    kind, usual_m = DEPTHS[image.encoding]
    rows, columns, step = int(image.height), int(image.width), int(image.step)
    dtype, data = np.dtype((">" if image.is_bigendian else "<") + kind), np.frombuffer(image.data, np.uint8)
    if columns * dtype.itemsize > step or rows * step > len(data):
        raise InputError(f"Image of {rows} × {columns} pixels with step {step} in {len(data)} bytes of data")
    raw = np.ndarray((rows, columns), dtype, data, strides=(step, dtype.itemsize))
    depth = raw * np.float64(usual_m if unit_m is None else unit_m)
    largest = np.iinfo(dtype).max if dtype.kind == "u" else np.inf
    depth[~((depth > 0) & np.isfinite(depth)) | (raw == largest)] = np.nan
    K = camera_matrix(camera, rows, columns)
    right = (np.arange(columns) - K[0, 2]) / K[0, 0]
    down = (np.arange(rows) - K[1, 2]) / K[1, 1]
    return np.stack([depth * right, depth * down[:, None], depth], axis=-1)


def camera_matrix(camera: Any, rows: int, columns: int) -> Array:
    """``K (3, 3)`` of an image of this size from its CameraInfo, with region and binning as that defines them.

    Raises `InputError` if it is of another size, or not calibrated.
    """
    K = np.array(getattr(camera, "k", getattr(camera, "K", None)), dtype=float).reshape(3, 3)  # ROS 1 has K
    if not np.isfinite(K).all() or min(K[0, 0], K[1, 1]) <= 0:
        raise InputError(f"CameraInfo with K {K.ravel().tolist()}; expected that of a calibrated camera")
    roi, binning = camera.roi, np.array([max(camera.binning_x, 1), max(camera.binning_y, 1)])
    whole = np.array([camera.width, camera.height])
    part = np.array([roi.width, roi.height]) if roi.width and roi.height else whole
    if (part // binning).tolist() == [columns, rows]:
        K[:2, 2] -= roi.x_offset, roi.y_offset
        K[:2] /= binning[:, None]
    elif whole.tolist() != [columns, rows]:
        both = f"an image of {columns} × {rows} pixels, and a CameraInfo of {whole[0]} × {whole[1]}"
        raise InputError(f"{both}; expected that of the image")
    return K


def pose_numbers(message: Any, kind: str) -> list[float]:
    """Position and quaternion xyzw of a message with a pose."""
    if kind == TRANSFORM:
        return numbers(message.transform.translation, message.transform.rotation)
    pose = message.pose if kind == POSE_STAMPED else message.pose.pose
    return numbers(pose.position, pose.orientation)


def stamp_of(message: Any) -> float:
    """Stamp in the header, seconds."""
    stamp = message.header.stamp
    return float((stamp.sec * 10**9 + stamp.nanosec) / 10**9)


def frames_of(message: Any) -> tuple[str, str]:
    """Frame and child frame of a message, "" if it has none; ROS 1 allowed a slash before a name."""
    return message.header.frame_id.lstrip("/"), getattr(message, "child_frame_id", "").lstrip("/")


def numbers(*parts: Any) -> list[float]:
    """Components of vectors and quaternions in one list."""
    return [float(getattr(part, axis)) for part in parts for axis in "xyzw" if hasattr(part, axis)]


def measures_all(imu: Any) -> bool:
    """Whether an Imu measures acceleration and rate: its definition says that it does not by −1 in a covariance."""
    return -1 not in (imu.angular_velocity_covariance[0], imu.linear_acceleration_covariance[0])
