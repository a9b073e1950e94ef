"""Which topics of a bag hold the scans and the poses: those of a suitable type, or those that the user names."""

import itertools
import os
import re
from contextlib import suppress
from typing import NamedTuple

from steelnb.core.errors import InputError
from steelnb.io import messages as ros
from steelnb.io.containers import Container
from steelnb.io.encodings import REPLAYED
from steelnb.io.folders import TRAJECTORIES
from steelnb.io.layouts import DEPTHS

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
LOOKED_AT = 10
"""Number of messages that tell what an IMU measures."""


class PoseSource(NamedTuple):
    """Where the poses of the drone come from: a trajectory ``file``; or transforms, which ``uses_tf`` says, between
    the ``pair`` of world and drone if it is named; or the only one of ``topics``. ``tf``: topics of transforms;
    ``left_out``: of poses that are too few to be the drone's."""

    tf: tuple[str, ...]
    uses_tf: bool = False
    topics: tuple[str, ...] = ()
    file: str = ""
    pair: tuple[str, str] | None = None
    left_out: tuple[str, ...] = ()


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
    """Image topics that are named or whose first message is a depth image, and faults of first messages."""
    found, faults = [], []
    for topic in bag.of_type(ros.IMAGE):
        try:
            encoding = bag.decode(next(bag.messages(topic))).encoding
        except InputError as fault:
            faults.append(fault)
            continue
        is_grey = encoding == "mono16" and "depth" not in topic.lower()  # images in the infrared are mono16, too
        if topic == name or (encoding in DEPTHS and not is_grey):
            found.append(topic)
        elif "depth" in topic.lower():
            kinds = ", ".join(DEPTHS)
            faults.append(InputError(f"{bag.path}: {topic} has encoding {encoding!r}; expected a depth image, {kinds}"))
    return found, faults


def pose_source(bag: Container, name: str | None, scans: str) -> PoseSource:
    """The source of the poses for the topic of the scans. Raises `InputError`.

    By default the only topic of Odometry or PoseStamped, else tf, else the only one of another type with poses. Topics
    with one or two poses for many scans, such as goals, are left out.
    """
    tf = _tf_topics(bag, scans)
    first = bag.of_type(ros.ODOMETRY, ros.POSE_STAMPED)
    few = [topic for topic in first if bag.count(topic) < POSES_MIN and 2 * bag.count(topic) < bag.count(scans)]
    if name is None and few and (tf or len(few) < len(first)):
        first = [topic for topic in first if topic not in few]
    else:
        few = []
    others = bag.of_type(ros.POSE_COVARIANCE, ros.TRANSFORM, ros.PATH)
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
    if name or first:
        topic = bag.choose("poses", name, [*first, *others] if name else first)
        return PoseSource(tf, topics=(topic,), left_out=tuple(few))
    if tf:
        return PoseSource(tf, uses_tf=True, topics=tuple(others) if len(others) == 1 else (), left_out=tuple(few))
    return PoseSource(tf, topics=(bag.choose("poses", None, others),))


def imu_topics(bag: Container, name: str | None) -> list[str]:
    """The topic of an IMU of this name, else those whose readings are all measured."""
    if name:
        return [bag.choose("an IMU", name, bag.of_type(ros.IMU))]
    measured = {topic: _measured(bag, topic) for topic in bag.of_type(ros.IMU)}
    parts = set().union(*(own for own in measured.values() if "both" in own))
    return [topic for topic, own in measured.items() if "both" in own and own == parts]


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
