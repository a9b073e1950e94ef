"""ROS messages → arrays: points of PointCloud2 and of depth images, poses, inertial samples.

A driver's sizes are checked against the data before they are used. What has one sensible reading is read that way and
noted; anything else is an `InputError` of that message.
"""

from typing import Any, NamedTuple

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array

CLOUD, IMAGE, CAMERA = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
COMPRESSED_IMAGE, IMU, PATH = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Imu", "nav_msgs/msg/Path"
ODOMETRY, POSE_STAMPED = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE, TRANSFORM = "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/TransformStamped"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Datatypes of PointField."""
DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4", "64FC1": "f8"}
"""Encodings of depth images (REP 118; some drivers call 16UC1 mono16)."""
INTEGER_M = 1e-3
"""Unit of integers: REP 118 says so for depth, and PointCloud2 has no unit."""
PLAUSIBLE_M = 1e-4, 1e7
"""Bounds of most coordinates, UTM included. Bytes in the wrong order give any power of ten."""
CERTAIN, DOUBTS = 0.48, 8.0
"""Bytes are reordered if that makes values this many times less doubtful, and `CERTAIN` is the most doubt of none."""
ORDER = {"<": "little-endian", ">": "big-endian"}


class Layout(NamedTuple):
    """How the bytes of a message are read: ``shape`` rows × columns, ``strides`` in bytes, ``order`` of the bytes, and
    ``notes`` on what contradicts the message."""

    shape: tuple[int, int]
    strides: tuple[int, int]
    order: str
    notes: tuple[str, ...]


class CameraInfo(NamedTuple):
    """A CameraInfo: ``K (3, 3)`` of an image of ``width × height`` pixels, binned by ``binning``; ``roi`` is the part
    that is sent, as x, y, width, height in unbinned pixels."""

    K: Array
    width: int
    height: int
    binning: tuple[int, int]
    roi: tuple[int, int, int, int]


def cloud_points(message: Any) -> Array:
    """Points of a PointCloud2, metres: ``(H, W, 3)`` if it is organised, else ``(N, 3)``. Invalid points are NaN rows.

    Raises `InputError` for missing fields and for sizes that no reading reconciles with the data.
    """
    shape, strides, order, _ = cloud_layout(message)
    points = np.empty((*shape, 3))
    for k, field in enumerate(_xyz(message) if points.size else ()):
        kind = np.dtype(order + POINT_TYPES[field.datatype])
        raw = np.ndarray(shape, kind, message.data, field.offset, strides)
        points[..., k] = raw
        if kind.kind != "f":
            points[..., k] *= INTEGER_M
            points[..., k][_no_return(raw)] = np.nan
    points[~np.isfinite(points).all(axis=-1)] = np.nan
    return points if min(shape) > 1 else points.reshape(-1, 3)


def cloud_layout(message: Any) -> Layout:
    """Layout of a PointCloud2. Raises `InputError`."""
    fields = _xyz(message)
    size, rows, columns, step = (int(n) for n in (len(message.data), message.height, message.width, message.point_step))
    needed = max(field.offset + np.dtype(POINT_TYPES[field.datatype]).itemsize for field in fields)
    notes = []
    if not rows * columns:
        if not size:
            return Layout((0, 0), (step, step), "<", ())
        if (rows + columns) * step != size or step < needed:
            raise InputError(f"{size} bytes of data in {rows} × {columns} points")
        notes.append(f"{rows} × {columns} points are read as {rows + columns}")
        rows, columns = 1, rows + columns
    if step < needed:
        if size % (rows * columns) or size // (rows * columns) < needed:
            raise InputError(f"point_step {step}: expected {needed} bytes or more, as x, y and z end there")
        notes.append(f"point_step {step} is read as {size // (rows * columns)}")
        step = size // (rows * columns)
    row_step, note = _row_step("row_step", int(message.row_step), rows, columns, step, size)
    view = [(field, message.data, (rows, columns), (row_step, step)) for field in fields]
    order, swapped = _byte_order(bool(message.is_bigendian), [_sample(*each) for each in view])
    notes += [note, swapped]
    integers = {POINT_TYPES[field.datatype] for field in fields if field.datatype < 7}
    notes += [f"x, y and z are integers ({', '.join(sorted(integers))}), taken as millimetres"] if integers else []
    return Layout((rows, columns), (row_step, step), order, tuple(filter(None, notes)))


def depth_points(image: Any, camera: CameraInfo) -> Array:
    """Points ``(H, W, 3)`` of a depth image in optical axes, metres, NaN where there is no depth; distortion is left.

    No depth is 0, less, NaN, infinite, or the largest integer. Raises `InputError` for contradicting sizes.
    """
    shape, strides, order, _ = depth_layout(image)
    raw = np.ndarray(shape, order + DEPTHS[image.encoding], image.data, strides=strides)
    depth = raw * np.float64(1.0 if raw.dtype.kind == "f" else INTEGER_M)
    depth[~((depth > 0) & np.isfinite(depth)) | _no_return(raw)] = np.nan
    K, _ = camera_matrix(camera, *shape)
    right = (np.arange(image.width) - K[0, 2]) / K[0, 0]
    down = (np.arange(image.height) - K[1, 2]) / K[1, 1]
    return np.stack([depth * right, depth * down[:, None], depth], axis=-1)


def depth_layout(image: Any) -> Layout:
    """Layout of a depth image. Raises `InputError`."""
    if image.encoding not in DEPTHS:
        raise InputError(f"encoding {image.encoding!r}; expected a depth image, {', '.join(DEPTHS)}")
    kind, rows, columns = np.dtype(DEPTHS[image.encoding]), int(image.height), int(image.width)
    if not rows * columns:
        raise InputError(f"{rows} × {columns} pixels")
    step, note = _row_step("step", int(image.step), rows, columns, kind.itemsize, len(image.data))
    pixels = np.ndarray((rows, columns), kind, image.data, strides=(step, kind.itemsize))
    order, swapped = _byte_order(bool(image.is_bigendian), [pixels[:: rows // 8 + 1].ravel()])
    renamed = "encoding mono16 is read as 16UC1, millimetres" if image.encoding == "mono16" else ""
    return Layout((rows, columns), (step, kind.itemsize), order, tuple(filter(None, (note, swapped, renamed))))


def camera_of(message: Any) -> CameraInfo:
    """The camera of a CameraInfo; ROS 1 writes its K in upper case."""
    roi = message.roi
    return CameraInfo(
        np.array(getattr(message, "k", getattr(message, "K", None)), dtype=float).reshape(3, 3),
        int(message.width), int(message.height), (max(int(message.binning_x), 1), max(int(message.binning_y), 1)),
        (int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)),
    )  # fmt: skip


def camera_matrix(camera: CameraInfo, height: int, width: int) -> tuple[Array, str]:
    """``K (3, 3)`` of an image of this size, and a note if it differs from that of its CameraInfo.

    Region, binning and a whole ratio of sizes are accounted for as in ROS's image_geometry. Raises `InputError`.
    """
    K, (x, y, part_width, part_height) = camera.K.copy(), camera.roi
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise InputError(f"CameraInfo with focal lengths {K[0, 0]:g}, {K[1, 1]:g}; expected a calibrated camera")
    whole = camera.width, camera.height
    is_central = 0 <= K[0, 2] <= width and 0 <= K[1, 2] <= height  # all that can be checked without a size
    if whole == (width, height) or (whole == (0, 0) and is_central):
        return K, ""
    part = (part_width, part_height) if part_width and part_height else whole
    for begin, size, binning in (((x, y), part, camera.binning), ((0, 0), whole, (1, 1))):
        binned = size[0] // binning[0], size[1] // binning[1]
        for up, down in ((binned, (width, height)), ((width, height), binned)):
            ratio = up[0] // max(down[0], 1)
            if ratio and up == (ratio * down[0], ratio * down[1]):
                scale = np.array(binning) * (ratio if up is binned else 1 / ratio)
                K[:2, 2] -= begin
                K[:2] /= scale[:, None]
                return K, f"image of {width} × {height}, CameraInfo of {whole[0]} × {whole[1]}: its K is scaled"
    raise InputError(
        f"image of {width} × {height}, CameraInfo of {whole[0]} × {whole[1]}; expected the same size or a whole ratio"
    )


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


def _xyz(message: Any) -> list[Any]:
    """The fields x, y and z of a PointCloud2."""
    fields = {field.name: field for field in reversed(message.fields) if field.datatype in POINT_TYPES}
    if not all(axis in fields for axis in "xyz"):
        names = ", ".join(str(field.name) for field in message.fields) or "none"
        raise InputError(f"fields {names}; expected x, y and z of a numeric type")
    return [fields[axis] for axis in "xyz"]


def _row_step(name: str, declared: int, rows: int, columns: int, step: int, size: int) -> tuple[int, str]:
    """Bytes from row to row, and a note if these are not the ``declared`` ones. Raises `InputError`."""
    tight = columns * step
    if rows * tight > size:
        raise InputError(f"{size} bytes of data; expected {rows * tight} for {rows} × {columns} of {step} bytes")
    if rows == 1:  # many drivers leave it at zero, and nothing needs it
        is_row = size in (tight, declared)
        return tight, "" if is_row else f"data are {size - tight} bytes longer than their points: the rest is left out"
    if declared >= tight and (rows - 1) * declared + tight <= size <= rows * declared:
        return declared, ""
    if rows * tight == size:
        return tight, f"{name} {declared} is read as {tight}, which fits the data"
    if declared >= tight and size > rows * declared and size % declared == 0:
        return declared, f"data are {size // declared - rows} rows longer than stated: the rest is left out"
    raise InputError(f"{name} {declared} and {size} bytes of data; expected {rows} rows of {tight} bytes or more")


def _sample(field: Any, data: Any, shape: tuple[int, int], strides: tuple[int, int]) -> Array:
    """Some hundred values of a field, little-endian."""
    view: Array = np.ndarray(shape, "<" + POINT_TYPES[field.datatype], data, field.offset, strides)
    return view[:: shape[0] // 8 + 1, :: shape[1] // 64 + 1].ravel()


def _byte_order(is_big: bool, samples: list[Any]) -> tuple[str, str]:
    """Order of the bytes of ``samples``, which are little-endian views, and a note if it is not the flagged one.

    The flag is believed unless the other order is far more plausible: coordinates of a usual size, neighbours alike.
    """
    (flagged, other), is_known = (">", "<") if is_big else ("<", ">"), False
    for values in samples:
        doubt = _doubt(values.view(flagged + values.dtype.str[1:]))
        if doubt <= CERTAIN:
            return flagged, ""
        least = DOUBTS * _doubt(values.view(other + values.dtype.str[1:]))
        if doubt <= least:  # false for NaN, of values that say nothing
            return flagged, ""
        is_known |= doubt > least
    if not is_known:
        return flagged, ""
    return other, f"is_bigendian is {is_big}, but only as {ORDER[other]} the data make sense: they are read so"


def _doubt(values: Any) -> float:
    """How odd values look: for floats the share outside `PLAUSIBLE_M`, for integers the step between neighbours. NaN if
    there are none but zeros."""
    with np.errstate(invalid="ignore", over="ignore"):
        if values.dtype.kind == "f":
            size = np.abs(values[np.isfinite(values) & (values != 0)])
            odd = (size < PLAUSIBLE_M[0]) | (size > PLAUSIBLE_M[1])
            return float(odd.mean()) + CERTAIN / DOUBTS if size.size else np.nan
        returned = values[(values != 0) & ~_no_return(values)].astype(float)
        steps = np.abs(np.diff(returned))
        # A constant image has no steps; then the nearer reading wins.
        return float(np.median(steps) + 1e-3 * np.median(np.abs(returned)) + CERTAIN / DOUBTS) if steps.size else np.nan


def _no_return(raw: Any) -> Any:
    """Where an integer is the largest of its type, or the smallest of a signed one: no return."""
    if raw.dtype.kind == "f":
        return np.zeros(raw.shape, bool)
    bounds = np.iinfo(raw.dtype)
    return (raw == bounds.max) | ((raw == bounds.min) & (bounds.min < 0))
