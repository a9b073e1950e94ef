"""Which topics of a bag hold the scans and the poses: those of a suitable type, or those that the user names."""

import itertools
import os
import re
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.io import messages as ros
from steelnb.io.containers import Container
from steelnb.io.encodings import REPLAYED
from steelnb.io.folders import TRAJECTORIES
from steelnb.io.frame_names import is_world_name
from steelnb.io.headers import Headers
from steelnb.io.layouts import DEPTHS, depth_encoding
from steelnb.io.transforms import Tree

SCANS = "clouds (PointCloud2 or depth images)"
PACKED = {
    ".*/CompressedImage": "a compressed depth image; expected a raw one, which `ros2 run image_transport republish "
    "compressedDepth raw` makes (ROS 1: rosrun)",
    ".*Packet.*|.*(?:Velodyne|Pandar|[rR]slidar)Scan|.*UdpFrame": f"packets of a LiDAR, not points; {REPLAYED}",
    ".*/CustomMsg": "a Livox's own message; expected PointCloud2, which its driver publishes with xfer_format 0",
    ".*LaserScan": "a scan of one plane; expected clouds (PointCloud2) of a sensor that measures in three dimensions",
    "sensor_msgs/msg/PointCloud": "an old PointCloud; expected PointCloud2 (ROS 1: point_cloud_converter)",
}
"""Messages of scans that are not read, by patterns of their types: what they are, and the remedy."""
POSES_MIN = 3
"""A topic with fewer poses may be a goal or a start."""
GOALS = {"setpoint", "goal", "target", "command", "cmd", "reference", "desired"}
"""Words in the names of topics of where a drone should be."""
REACH_MIN_M, STILL_M, REACHES = 1.0, 0.1, (0.5, 2.0)
"""Poses that stay within the second while those of tf reach farther than the first are not the drone's; and bounds of
the ratio of two reaches, beyond which they are compared with words."""
LOOKED_AT = 10
"""Number of messages that tell what an IMU measures, or whether images are of depth."""


class PoseSource(NamedTuple):
    """Where the poses of the drone come from: a trajectory ``file``; or transforms, which ``uses_tf`` says, between
    the ``pair`` of world and drone if it is named; or the only one of ``topics``. ``tf``: topics of transforms;
    ``is_named``: the user chose it; ``notes`` say which topics of poses are left out."""

    tf: tuple[str, ...]
    uses_tf: bool = False
    topics: tuple[str, ...] = ()
    file: str = ""
    pair: tuple[str, str] | None = None
    is_named: bool = False
    notes: tuple[str, ...] = ()


def scan_topic(bag: Container, name: str | None) -> str:
    """The topic of the scans. Raises `InputError`."""
    clouds, packed = bag.of_type(ros.CLOUD), dict[str, str]()
    for pattern, words in PACKED.items():
        found = [topic for topic, kind in bag.types.items() if re.fullmatch(pattern, kind)]
        packed |= {t: words for t in found if bag.types[t] != ros.COMPRESSED_IMAGE or "depth" in t.lower()}
    images, faults = depth_images(bag, name) if name or not clouds else ([], [])
    candidates = [*clouds, *images] if name else clouds or images
    if name in packed or (packed and not candidates):
        topic = name if name in packed else next(iter(packed))
        raise InputError(f"{bag.path}: {topic} is {packed[topic]}")
    if faults and not candidates:
        raise faults[0]
    return bag.choose(SCANS, name, candidates)


def depth_images(bag: Container, name: str | None) -> tuple[list[str], list[InputError]]:
    """Image topics that are named or one of whose first messages is a depth image, and faults of first messages."""
    found, faults = [], []
    for topic in bag.of_type(ros.IMAGE):
        fault: InputError | None = None
        for raw in itertools.islice(bag.messages(topic), LOOKED_AT):
            try:
                encoding = bag.decode(raw).encoding
            except InputError as damage:
                fault = fault or damage
                continue
            kind = depth_encoding(encoding)
            is_grey = kind == "mono16" and "depth" not in topic.lower()  # images in the infrared are mono16, too
            if topic == name or (kind in DEPTHS and not is_grey):
                found.append(topic)
                break
            if "depth" in topic.lower():
                expected = f"expected a depth image, {', '.join(DEPTHS)}"
                fault = fault or InputError(f"{bag.path}: {topic} has encoding {encoding!r}; {expected}")
        else:
            faults += [fault] if fault else []
    return found, faults


def pose_source(bag: Container, name: str | None, scans: str) -> PoseSource:
    """The source of the poses for the topic of the scans. Raises `InputError`.

    By default the only topic of Odometry or PoseStamped, else tf, else the only one of another type with poses. Left
    out are topics of goals by their names, and those with one or two poses for many scans; see also `settled`.
    """
    tf = _tf_topics(bag, scans)
    first, notes = bag.of_type(ros.ODOMETRY, ros.POSE_STAMPED), list[str]()
    others = bag.of_type(ros.POSE_COVARIANCE, ros.TRANSFORM, ros.PATH)
    if name is None:
        few = [topic for topic in first if bag.count(topic) < POSES_MIN and 2 * bag.count(topic) < bag.count(scans)]
        goals = [topic for topic in first if topic not in few and _is_goal(topic)]
        if few and (tf or len(few) < len(first)):
            notes += [f"poses of {topic} are left out: {bag.count(topic)} of them" for topic in few]
            first = [topic for topic in first if topic not in few]
        if goals and (len(goals) < len(first) or others or any(not topic.endswith("tf_static") for topic in tf)):
            notes += [
                f"poses of {topic} are left out: of a goal by its name (--poses {topic} takes them)" for topic in goals
            ]
            first, others = [topic for topic in first if topic not in goals], others or goals
    if name in bag.of_type(*ros.TF):
        space = name.rpartition("/")[0]
        return PoseSource(tuple(t for t in bag.of_type(*ros.TF) if t.rpartition("/")[0] == space), uses_tf=True)
    if name and name not in bag.types:
        if os.path.isfile(name):  # Path.is_file raises for a name that is too long
            return PoseSource(tf, file=name)
        if pair := re.fullmatch(r"(?:tf )?\s*/?([^>→]+?)\s*(?:-?>|→)\s*/?([^>→]+?)\s*", name):
            objects = tuple(bag.of_type(ros.ODOMETRY, ros.POSE_STAMPED, ros.POSE_COVARIANCE, ros.TRANSFORM))
            return PoseSource(tf, uses_tf=True, topics=objects, pair=(pair[1], pair[2]))
    if name and name not in bag.types and os.path.splitext(name)[1].lower() in TRAJECTORIES:
        raise InputError(f"{bag.path}: no topic and no file {name!r}; expected a topic of poses, or a trajectory")
    if name is not None or first:
        topic = bag.choose("poses", name, [*first, *others] if name is not None else first)
        return PoseSource(tf, topics=(topic,), is_named=name is not None, notes=tuple(notes))
    if tf:
        return PoseSource(tf, uses_tf=True, topics=tuple(others) if len(others) == 1 else (), notes=tuple(notes))
    return PoseSource(tf, topics=(bag.choose("poses", None, others),), notes=tuple(notes))


def settled(source: PoseSource, headers: Headers, tree: Tree, sensor: str) -> PoseSource:
    """The source when the transforms are known: tf has the drone's poses if those of the only topic are in a frame that
    moves with the drone, as of a marker, or stay where they are. Raises `InputError`."""
    moves, is_goal = any(edge.moves for edge in tree.edges.values()), any(map(_is_goal, source.topics))
    if source.uses_tf and not source.topics and not moves and headers.unstamped:
        text = next(iter(headers.unstamped.values()))
        raise InputError(f"{text}; expected the time of each (--clock bag: of recording)")
    if source.uses_tf and source.pair is None and is_goal:  # nothing else has poses if nothing moves on tf
        return source._replace(topics=()) if moves else source._replace(notes=())
    topic = "" if source.uses_tf or source.is_named else next(iter(source.topics), "")
    objects = [*headers.objects(topic)] if topic else []
    try:
        world, body = tree.drone(sensor) if moves and len(objects) == 1 else ("", "")
        is_drone = is_world_name(world) and not is_world_name(body)  # no gimbal on a drone, and no odom in a map
        path = tree.poses(world, body) if is_drone else None
    except InputError:
        path = None
    if path is None or (sensor in tree.frames and body not in tree.above(sensor)):
        return source
    frame, child = tree.resolve(objects[0][0], sensor), objects[0][1]
    rows = headers.rows_of(topic, objects[0], 7)
    own_m, tf_m = _reaches(rows[:, [0, 2, 3, 4]], np.column_stack([path.stamp_s, path.position]))
    is_still = own_m < STILL_M and tf_m > REACH_MIN_M
    why = f"they stay, and {body} moves by {tf_m:.2g} m on tf" if is_still else ""
    if not child and not is_world_name(frame) and body in tree.above(frame):
        why = f"they are in {frame}, which moves with {body}"
    if why:
        note = f"poses of {topic} are left out: {why} (--poses {topic} takes them)"
        return PoseSource(source.tf, uses_tf=True, notes=(*source.notes, note))
    if max(own_m, tf_m) > REACH_MIN_M and not REACHES[0] < own_m / max(tf_m, STILL_M) < REACHES[1]:
        note = f"poses of {topic} reach {own_m:.2g} m, those of tf {tf_m:.2g} m (--poses '{world}>{body}' takes these)"
        return source._replace(notes=(*source.notes, note))
    return source


def _reaches(*paths: Array) -> list[float]:
    """How far each path, rows ``(N, 4)`` of stamp and position, reaches in the time of all but for a few poses; NaN if
    that is unknown."""
    whole = [path[np.isfinite(path).all(axis=1)] for path in paths]
    begin_s = max(path[:, 0].min(initial=np.inf) for path in whole)
    end_s = min(path[:, 0].max(initial=-np.inf) for path in whole)
    shared = [path[(begin_s <= path[:, 0]) & (path[:, 0] <= end_s), 1:] for path in whole]
    if min(map(len, shared)) < POSES_MIN:
        return [np.nan] * len(paths)
    return [float(np.linalg.norm(np.subtract(*np.quantile(each, [0.95, 0.05], axis=0)))) for each in shared]


def _is_goal(topic: str) -> bool:
    """Whether the words of a topic's name are those of where a drone should be."""
    return bool(GOALS & {word.lower().rstrip("s") for word in re.findall("[A-Z]?[a-z]+", topic)})


def imu_topics(bag: Container, name: str | None, scans: str, *poses: str) -> list[str]:
    """The topic of an IMU of this name, else those whose readings are all measured.

    If another namespace than those of scans and poses has the same topics, it is of another drone, whose IMU is left
    out where there is another.
    """
    if name:
        return [bag.choose("an IMU", name, bag.of_type(ros.IMU))]
    measured = {topic: _measured(bag, topic) for topic in bag.of_type(ros.IMU)}
    parts = set().union(*(own for own in measured.values() if "both" in own))
    found = [topic for topic, own in measured.items() if "both" in own and own == parts]
    own = {_split(topic)[0] for topic in (scans, *poses)} - {""}
    alike = bag.of_type(ros.IMU, ros.ODOMETRY, ros.POSE_STAMPED)
    mine = {rest for space, rest in map(_split, alike) if space in own}
    others = {space for space, rest in map(_split, alike) if space not in own and rest in mine}
    return [topic for topic in found if _split(topic)[0] not in others] or found


def _split(topic: str) -> tuple[str, str]:
    """First part of a topic's name, which is "" if there is only one, and the rest."""
    space, _, rest = topic.strip("/").partition("/")
    return (space, rest) if rest else ("", space)


def _measured(bag: Container, topic: str) -> set[str]:
    """What an IMU measures by its first messages: −1 in a covariance says that it does not measure ``both``, and
    zeros say nothing but beside another topic that has the part."""
    found = {"both"}
    for raw in itertools.islice(bag.messages(topic), LOOKED_AT):
        with suppress(InputError):
            one = bag.decode(raw)
            parts = {"force": one.linear_acceleration, "rate": one.angular_velocity}
            found |= {name for name, part in parts.items() if any(ros.numbers(part))}
            if -1 in (one.angular_velocity_covariance[0], one.linear_acceleration_covariance[0]):
                found -= {"both"}
    return found


def camera_topic(bag: Container, images: str, frame_of: dict[str, str]) -> str:
    """The topic of the camera of some images: the nearest by name, of several the one in their frame.

    ``frame_of``: frames of the images and of all CameraInfo. Raises `InputError`, also if the only one is that of
    another camera by its name and by its frame.
    """
    cameras, folder = [name for name in frame_of if name != images], images.rpartition("/")[0]
    near = [
        [name for name in cameras if name.rpartition("/")[0] == each] for each in (folder, folder.rpartition("/")[0])
    ]
    found = near[0] or near[1] or cameras
    found = [name for name in found if frame_of[name] == frame_of[images]] or found if len(found) > 1 else found
    topic = bag.choose(f"CameraInfo of {images}", None, found)
    if topic not in (*near[0], *near[1]) and len({frame_of[topic], frame_of[images], ""}) == 3:
        raise InputError(
            f"{bag.path}: {images} is in frame {frame_of[images]!r}, and the only CameraInfo, {topic}, in"
            f" {frame_of[topic]!r}; expected that of its own camera"
        )
    return topic


def _tf_topics(bag: Container, scans: str) -> tuple[str, ...]:
    """Topics of transforms: of several namespaces those that the scans are in, since drones have frames alike."""
    found = bag.of_type(*ros.TF)
    return tuple([topic for topic in found if scans.startswith(f"{topic.rpartition('/')[0]}/")] or found)
