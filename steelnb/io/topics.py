"""Which topics of a bag hold the scans and the poses: those of a suitable type, or those that the user names."""

import itertools
import re
from contextlib import suppress

from steelnb.core.errors import InputError
from steelnb.io import messages as ros
from steelnb.io.containers import Container
from steelnb.io.encodings import REPLAYED
from steelnb.io.layouts import DEPTHS, depth_encoding

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
CLOUDS_MIN, SELDOM = 3, 20
"""Clouds are of a map if other messages hold more than `SELDOM` times as many scans, or more than twice as many if
there are fewer than `CLOUDS_MIN` clouds. A LiDAR at 10 Hz may stand beside depth images at 90 Hz."""
NO_DEPTH = {"confidence", "ir", "infra", "infrared", "amplitude", "intensity", "disparity"}
"""Words in the names of topics whose images have the encoding of depth but hold something else."""
LOOKED_AT = 10
"""Number of messages that tell what an IMU measures, or whether images are of depth."""


def scan_topic(bag: Container, name: str | None) -> str:
    """The topic of the scans. Raises `InputError`."""
    clouds, packed = bag.of_type(ros.CLOUD), dict[str, str]()
    for pattern, words in PACKED.items():
        found = [topic for topic, kind in bag.types.items() if re.fullmatch(pattern, kind)]
        packed |= {t: words for t in found if bag.types[t] != ros.COMPRESSED_IMAGE or "depth" in t.lower()}
    count = max(map(bag.count, clouds), default=0)
    most = count * (2 if count < CLOUDS_MIN else SELDOM)
    looks = bool(name) or any(bag.count(topic) > most for topic in bag.of_type(ros.IMAGE))
    images, faults = depth_images(bag, name) if looks else ([], [])
    if not name and any(bag.count(topic) > most for topic in (*images, *packed)):
        clouds = []
    candidates = [*clouds, *images] if name else clouds or images
    if name in packed or (packed and not candidates):
        topic = name if name in packed else next(iter(packed))
        raise InputError(f"{topic} is {packed[topic]}")
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
            words = re.split(r"[^a-z]+", re.sub(r"depth_to_\w+", "depth", topic.lower()))
            is_other = not NO_DEPTH.isdisjoint(words) and "depth" not in topic.lower().rpartition("/")[2]
            if topic == name or (kind in DEPTHS and not is_grey and not is_other):
                found.append(topic)
                break
            if "depth" in topic.lower():
                expected = f"expected a depth image, {', '.join(DEPTHS)}"
                fault = fault or InputError(f"{topic} has encoding {encoding!r}; {expected}")
        else:
            faults += [fault] if fault else []
    return found, faults


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
        both = f"{images} is in frame {frame_of[images]!r}, and the only CameraInfo, {topic}, in {frame_of[topic]!r}"
        raise InputError(f"{both}; expected that of its own camera")
    return topic
