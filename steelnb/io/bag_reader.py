"""Reader of ROS 1 bags, MCAP and sqlite files and ROS 2 folders: stamps, poses, mounts, IMU, and scans one by one.

ROS is not needed. The readers and the standard types of rosbags are used rather than its `AnyReader`, which compiles
the message definitions in the bag and fails if one of them cannot be parsed.
"""

import functools
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.files import damaged, reading
from steelnb.core.types import Array, Imu, IntArray, Trajectory
from steelnb.io.trajectories import pose_matrices, trajectory_of

CLOUD, IMAGE, CAMERA = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
IMU, ODOMETRY, POSE_STAMPED = "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
FLOATS = {7: "f4", 8: "f8"}
"""Accepted PointField datatypes of coordinates."""
DEPTHS = {"16UC1": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""Encodings of depth images (REP 118): type, and unit in metres."""
T_OPTICAL_SENSOR = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
"""Rotation from x forward, y left, z up to optical axes: z forward, x right, y down (REP 103)."""
WORLDS = ("odom", "world", "map")
"""Parent frames of poses, the preferred first (REP 105): poses in odom drift but do not jump."""

Decoder = tuple[str, Callable[[], Any]]
"""Topic and decoder of a message."""


@functools.cache
def typestore(ros: int) -> Any:
    """Definitions of the standard messages of ROS 1 or 2 and of tf."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    for kind in TF:
        if kind not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return store


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag: a file by its suffix, a folder by its metadata."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix.lower() in (".bag", ".mcap", ".db3")


class Bag:
    """A bag, opened again for every pass. ``types`` holds the message type of each topic with messages.

    `read` stores the values of small messages, but only the stamps of scans.
    """

    def __init__(self, path: Path) -> None:
        from rosbags import rosbag1, rosbag2

        self.path, ros = path, 1 if path.suffix.lower() == ".bag" else 2
        self._reader: Any = rosbag1.Reader if ros == 1 else rosbag2.Reader
        self._decode = typestore(1).deserialize_ros1 if ros == 1 else typestore(2).deserialize_cdr
        with reading(path, "a bag", folder=path.is_dir()), self._reader(path) as reader:
            self.types = {each.topic: each.msgtype for each in reader.connections if each.msgcount}
        self.skipped: Counter[str] = Counter()
        self.frame_of: dict[str, str] = {}
        self._cameras: dict[str, Array] = {}
        self._static: dict[str, tuple[str, Array]] = {}
        self._rows: dict[str, array[float]] = defaultdict(lambda: array("d"))

    def of_type(self, *kinds: str) -> list[str]:
        """Topics of these message types."""
        return [topic for topic, kind in self.types.items() if kind in kinds]

    def choose(self, role: str, name: str | None, candidates: list[str]) -> str:
        """The candidate topic with that name, or the only candidate. Raises `InputError`."""
        if name in candidates or (name is None and len(candidates) == 1):
            return name or candidates[0]
        found = f"no topic {name!r}" if name else f"no {role}" if not candidates else f"several topics of {role}"
        topics = [f"{topic} ({kind.rpartition('/')[2]})" for topic, kind in sorted(self.types.items())]
        listed = ", ".join(topics) or "none"
        raise InputError(f"{self.path}: {found}; expected one topic of {role}, or its name, among {listed}")

    def messages(self, *topics: str, convert: Callable[[Any], Any] = lambda message: message) -> Iterator[Decoder]:
        """Topic and decoder of each message, which also converts it. Both raise `InputError` if the bag is damaged."""
        with reading(self.path, "a bag", folder=self.path.is_dir()), self._reader(self.path) as reader:
            selected = [each for each in reader.connections if each.topic in topics]
            for connection, _, raw in reader.messages(selected) if selected else ():
                yield connection.topic, partial(self._decoded, raw, connection.msgtype, convert)

    def _decoded(self, raw: bytes, kind: str, convert: Callable[[Any], Any]) -> Any:
        with damaged(self.path, f"a bag of readable {kind.rpartition('/')[2]} messages"):
            return convert(self._decode(raw, kind))

    def read(self, *topics: str) -> None:
        """Store all messages of some topics. Raises `InputError` if one cannot be decoded."""
        for topic, decode in self.messages(*topics):
            self._store(topic, self.types[topic], decode())

    def _store(self, topic: str, kind: str, message: Any) -> None:
        if kind in TF:
            for each in message.transforms:
                parent, child = each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/")
                pose = _numbers(each.transform.translation, each.transform.rotation)
                if topic.endswith("tf_static"):
                    self._static[child] = parent, pose_matrices(np.array([pose]))[0]
                elif parent in WORLDS:
                    self.frame_of[f"tf {parent} → {child}"] = child
                    self._rows[f"tf {parent} → {child}"].extend((_stamp_s(each), *pose))
            return
        if kind != POSE_STAMPED:  # a PoseStamped names only the world frame
            self.frame_of[topic] = getattr(message, "child_frame_id", message.header.frame_id).lstrip("/")
        if kind == CAMERA:
            self._cameras[topic] = np.array(getattr(message, "k", getattr(message, "K", None))).reshape(3, 3)
            return
        self._rows[topic].append(_stamp_s(message))
        if kind == IMU:
            self._rows[topic].extend(_numbers(message.linear_acceleration, message.angular_velocity))
        elif kind in (ODOMETRY, POSE_STAMPED):
            pose = message.pose if kind == POSE_STAMPED else message.pose.pose
            self._rows[topic].extend(_numbers(pose.position, pose.orientation))

    def stamp_s(self, scans: str) -> Array:
        """Stamps ``(N,)`` of the scans."""
        return np.array(self._rows[scans])

    def poses_of_tf(self) -> str:
        """Name of a moving transform in the first of `WORLDS`. Raises `InputError` if there is none."""
        moving = [name for name in self.frame_of if name.startswith("tf ")]
        return min(moving, key=lambda name: WORLDS.index(name.split()[1])) if moving else self.choose("poses", None, [])

    def poses(self, name: str) -> Trajectory:
        """Poses of the drone from a topic or from tf."""
        found = trajectory_of(self.path, np.array(self._rows[name]).reshape(-1, 8), self.skipped)
        return Trajectory(found.stamp_s, found.T_world_drone @ _axes(self.frame_of.get(name, "")))

    def imu(self, topic: str, body: str) -> Imu:
        """Inertial samples with increasing stamps, in the axes of the drone if tf_static relates them."""
        rows = np.array(self._rows[topic]).reshape(-1, 7)
        rows = rows[np.isfinite(rows).all(axis=1)]
        rows = rows[np.diff(np.maximum.accumulate(rows[:, 0]), prepend=-np.inf) > 0]
        R_drone_imu = self.mount(body, self.frame_of[topic], optical=False)[0][:3, :3]
        return Imu(rows[:, 0], rows[:, 1:4] @ R_drone_imu.T, rows[:, 4:] @ R_drone_imu.T)

    def mount(self, body: str, frame: str, optical: bool) -> tuple[Array, str]:
        """``T_drone_frame (4, 4)`` from tf_static, or the identity if unknown, and its source in words.

        ``optical``: the points of the frame have already been converted from optical axes.
        """
        body = body or "base_link"
        (T_root_body, body_root), (T_root_frame, frame_root) = self._to_root(body), self._to_root(frame)
        if body_root != frame_root:
            return np.eye(4), f"no tf_static from {body} to {frame or 'the sensor'}: identity assumed"
        T_drone_frame = np.linalg.inv(_axes(body)) @ np.linalg.inv(T_root_body) @ T_root_frame
        return T_drone_frame @ (T_OPTICAL_SENSOR if optical else np.eye(4)), f"tf_static {body} → {frame}"

    def _to_root(self, frame: str) -> tuple[Array, str]:
        """``T_root_frame (4, 4)`` from tf_static, and the name of the root."""
        T_root_frame = np.eye(4)
        for _ in self._static:  # bounds the depth of the tree
            parent, T_parent_frame = self._static.get(frame, (frame, np.eye(4)))
            T_root_frame, frame = T_parent_frame @ T_root_frame, parent
        return T_root_frame, frame

    def to_points(self, scans: str) -> tuple[Callable[[Any], Array], bool]:
        """Converter of a message to points ``(H, W, 3)`` or ``(N, 3)``, and whether it converts from optical axes.

        Depth images have optical axes, as have clouds in a frame with an optical name. Raises `InputError`.
        """
        read: Callable[[Any], Array] = cloud_points
        optical = _axes(self.frame_of.get(scans, "")) is T_OPTICAL_SENSOR
        if self.types[scans] != CLOUD:
            folder = scans.rpartition("/")[0]
            near = [name for name in self._cameras if name.rpartition("/")[0] in (folder, folder.rpartition("/")[0])]
            K = self._cameras[self.choose(f"CameraInfo of {scans}", None, near or list(self._cameras))]
            read, optical = partial(depth_points, K=K), True
        return (lambda message: read(message) @ T_OPTICAL_SENSOR[:3, :3]) if optical else read, optical

    def walk(self, topic: str, to_points: Callable[[Any], Array], number: IntArray) -> Iterator[Callable[[], Array]]:
        """Decoders of the scans with these increasing numbers."""
        selected, last = set(number.tolist()), int(number.max(initial=-1))
        for k, (_, decode) in enumerate(self.messages(topic, convert=to_points)):
            if k in selected:
                yield decode
            if k >= last:
                return

    def depth_images(self) -> list[str]:
        """Image topics whose first message is a depth image."""
        first = {topic: next(self.messages(topic))[1]() for topic in self.of_type(IMAGE)}
        return [topic for topic, image in first.items() if image.encoding in DEPTHS]


def cloud_points(message: Any) -> Array:
    """Points of a PointCloud2, metres: ``(H, W, 3)`` if it is organised, else ``(N, 3)``. Invalid points are NaN rows.

    ``row_step`` of a single row is ignored, since many drivers leave it at zero. Raises `InputError` for missing or
    unsupported fields, and ValueError for inconsistent sizes.
    """
    height, width, step = message.height, message.width, message.point_step
    fields = {field.name: field for field in message.fields if field.datatype in FLOATS}
    if not all(axis in fields for axis in "xyz"):
        names = ", ".join(str(field.name) for field in message.fields) or "none"
        raise InputError(f"fields {names}; expected x, y and z as float32 or float64")
    order, row = ">" if message.is_bigendian else "<", message.row_step if height > 1 else width * step
    points = np.empty((height, width, 3))
    for k, axis in enumerate("xyz" if points.size else ""):
        kind, offset = order + FLOATS[fields[axis].datatype], fields[axis].offset
        points[..., k] = np.ndarray((height, width), kind, message.data, offset, (row, step))
    points[~np.isfinite(points).all(axis=-1)] = np.nan
    return points if height > 1 and width > 1 else points.reshape(-1, 3)


def depth_points(image: Any, K: Array) -> Array:
    """Points ``(H, W, 3)`` of a depth image in optical axes, metres, NaN where there is no depth.

    ``K (3, 3)`` is the camera matrix; there is no distortion. Raises ValueError for inconsistent sizes.
    """
    name, unit_m = DEPTHS[image.encoding]
    kind, shape = np.dtype((">" if image.is_bigendian else "<") + name), (image.height, image.width)
    depth = np.ndarray(shape, kind, image.data, strides=(image.step, kind.itemsize)) * np.float64(unit_m)
    depth[~((depth > 0) & np.isfinite(depth))] = np.nan
    right = (np.arange(image.width) - K[0, 2]) / K[0, 0]
    down = (np.arange(image.height) - K[1, 2]) / K[1, 1]
    return np.stack([depth * right, depth * down[:, None], depth], axis=-1)


def _axes(frame: str) -> Array:
    """Rotation ``(4, 4)`` from the drone's axes to a frame's: optical axes by its name (REP 103), else the identity."""
    return T_OPTICAL_SENSOR if frame.endswith(("_optical_frame", "_optical")) else np.eye(4)


def _stamp_s(message: Any) -> float:
    stamp = message.header.stamp
    return float((stamp.sec * 10**9 + stamp.nanosec) / 10**9)


def _numbers(*parts: Any) -> list[float]:
    """Components of vectors and quaternions in one list."""
    return [float(getattr(part, axis)) for part in parts for axis in "xyzw" if hasattr(part, axis)]
