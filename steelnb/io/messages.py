"""ROS messages → arrays: points of PointCloud2 and of depth images, cameras, poses, stamps."""

from typing import Any, NamedTuple

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.io.layouts import DEPTHS, cloud_layout, depth_encoding, depth_layout, no_return, views

CLOUD, IMAGE, CAMERA = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
COMPRESSED_IMAGE, IMU, PATH = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Imu", "nav_msgs/msg/Path"
ODOMETRY, POSE_STAMPED = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE, TRANSFORM = "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/TransformStamped"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
INTEGER_M = 1e-3
"""Unit of integers: REP 118 says so for depth, and PointCloud2 has no unit."""
FAR_DEPTH_M, FAR_SHARE = 65.5, 0.01
"""The farthest depth stands for nothing if it exceeds the first, this share of the pixels has it, and all others are
less than half as far: simulators and converters write 65.535, 1000 or 65504 where they see nothing."""
CENTRE = 0.2, 0.8
"""Where a principal point usually is, as a share of the image's size."""
FOCAL_MIN = 1.0
"""Minimum focal length of a camera, pixels: some programs give it as a share of the image's size."""


class CameraInfo(NamedTuple):
    """A CameraInfo: ``K (3, 3)`` of an image of ``width × height`` pixels, binned by ``binning``; ``roi`` is the part
    that is sent, as x, y, width, height in unbinned pixels; ``distortion`` names a model with parameters other than
    zero, else is empty; ``P (3, 3)`` is the K of rectified images, zero if there is none."""

    K: Array
    width: int
    height: int
    binning: tuple[int, int]
    roi: tuple[int, int, int, int]
    distortion: str = ""
    P: Array = np.zeros((3, 3))

    def equals(self, other: "CameraInfo") -> bool:
        """Whether all values are equal."""
        same = np.array_equal(self.K, other.K) and np.array_equal(self.P, other.P)
        return same and self[1:-1] == other[1:-1]

    def rectified(self) -> "CameraInfo":
        """The camera of rectified images, without distortion; the same if its P is not given."""
        return self._replace(K=self.P, distortion="") if _is_calibrated(self.P) else self


@np.errstate(invalid="ignore", over="ignore")
def cloud_points(message: Any) -> Array:
    """Points of a PointCloud2, metres: ``(H, W, 3)`` if it is organised, else ``(N, 3)``. Invalid points are NaN rows.

    Raises `InputError` for missing fields and for sizes that no reading reconciles with the data.
    """
    shape, strides, order, _ = cloud_layout(message)
    points = np.empty((*shape, 3))
    for k, raw in enumerate(views(message, shape, strides, order) if points.size else ()):
        points[..., k] = raw
        if raw.dtype.kind != "f":
            points[..., k] *= INTEGER_M
            points[..., k][no_return(raw)] = np.nan
    points[~np.isfinite(points[..., 0] + points[..., 1] + points[..., 2])] = np.nan
    return points if min(shape) > 1 else points.reshape(-1, 3)


@np.errstate(invalid="ignore", over="ignore")
def depth_points(image: Any, camera: CameraInfo) -> Array:
    """Points ``(H, W, 3)`` of a depth image in optical axes, metres, NaN where there is no depth; distortion is left.

    No depth is 0, less, NaN, infinite, the largest number of its type, or one far behind all others (`FAR_DEPTH_M`).
    Raises `InputError` for contradicting sizes.
    """
    shape, strides, order, _ = depth_layout(image)
    raw = np.ndarray(shape, order + DEPTHS[depth_encoding(image.encoding)], image.data, strides=strides)
    depth = raw * np.float64(1.0 if raw.dtype.kind == "f" else INTEGER_M)
    depth[~((depth > 0) & np.isfinite(depth)) | no_return(raw)] = np.nan
    farthest_m = np.fmax.reduce(depth, axis=None, initial=0)
    if farthest_m > FAR_DEPTH_M:
        is_farthest = depth == farthest_m
        is_shared = is_farthest.sum() >= FAR_SHARE * depth.size
        if is_shared and 0 < np.fmax.reduce(depth[~is_farthest], initial=0) < 0.5 * farthest_m:
            depth[is_farthest] = np.nan
    K, _ = camera_matrix(camera, *shape)
    right = (np.arange(image.width) - K[0, 2]) / K[0, 0]
    down = (np.arange(image.height) - K[1, 2]) / K[1, 1]
    return np.stack([depth * right, depth * down[:, None], depth], axis=-1)


def camera_of(message: Any) -> CameraInfo:
    """The camera of a CameraInfo; ROS 1 writes its K in upper case."""
    roi, parameters = message.roi, np.asarray(getattr(message, "d", getattr(message, "D", ())), dtype=float)
    return CameraInfo(
        np.array(getattr(message, "k", getattr(message, "K", None)), dtype=float).reshape(3, 3),
        int(message.width), int(message.height), (max(int(message.binning_x), 1), max(int(message.binning_y), 1)),
        (int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)),
        str(message.distortion_model) if parameters.any() else "",
        np.array(getattr(message, "p", getattr(message, "P", None)), dtype=float).reshape(3, 4)[:, :3],
    )  # fmt: skip


def _is_calibrated(K: Array) -> bool:
    below = np.abs(np.tril(K, -1)).max(initial=0.0)  # rounding may leave something
    return bool(np.isfinite(K).all() and min(K[0, 0], K[1, 1]) > FOCAL_MIN and below < 1e-6 * K[0, 0])


def _is_usual(K: Array, height: int, width: int) -> bool:
    """Whether the principal point is near the middle of an image."""
    share = K[:2, 2] / (width, height)
    return bool(CENTRE[0] <= share.min() and share.max() <= CENTRE[1])


def camera_matrix(camera: CameraInfo, height: int, width: int) -> tuple[Array, str]:
    """``K (3, 3)`` of an image of this size, and a note if it differs from that of its CameraInfo.

    Region, binning and a whole ratio of sizes are accounted for as in ROS's image_geometry. Raises `InputError`.
    """
    K, (x, y, part_width, part_height) = camera.K.copy(), camera.roi
    if not _is_calibrated(K):
        raise InputError(f"CameraInfo with K {K.ravel().tolist()}; expected that of a calibrated camera")
    whole = camera.width, camera.height
    is_central = 0 <= K[0, 2] <= width and 0 <= K[1, 2] <= height  # all that can be checked without a size
    is_usual = _is_usual(K, height, width)
    if whole in ((width, height), (0, 0)) and is_central:
        centre = f"principal point ({K[0, 2]:g}, {K[1, 2]:g}) in {width} × {height} pixels"
        return K, "" if is_usual else f"{centre}: K of the CameraInfo may be that of another size"
    if whole == (width, height):
        centre = f"({K[0, 2]:g}, {K[1, 2]:g})"
        raise InputError(f"CameraInfo with principal point {centre}; expected one in its {width} × {height} pixels")
    sizes = f"image of {width} × {height}, CameraInfo of {whole[0]} × {whole[1]}"
    part = (part_width, part_height) if part_width and part_height else whole
    for begin, size, binning in (((x, y), part, camera.binning), ((0, 0), whole, (1, 1))):
        binned = size[0] // binning[0], size[1] // binning[1]
        for up, down in ((binned, (width, height)), ((width, height), binned)):
            ratio = up[0] // max(down[0], 1)
            if ratio and up == (ratio * down[0], ratio * down[1]):
                scale, scaled = np.array(binning) * (ratio if up is binned else 1 / ratio), K.copy()
                scaled[:2, 2] -= begin
                scaled[:2] /= scale[:, None]
                if is_usual and not _is_usual(scaled, height, width):
                    return K, f"{sizes}: its K is that of the image already, by its principal point"
                return scaled, f"{sizes}: its K is scaled"
    raise InputError(f"{sizes}; expected the same size or a whole ratio")


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


def numbers(*parts: Any) -> list[float]:
    """Components of vectors and quaternions in one list."""
    return [float(getattr(part, axis)) for part in parts for axis in "xyzw" if hasattr(part, axis)]
