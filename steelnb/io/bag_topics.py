"""The topics of a bag that make a flight: found by their types, or named."""

from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from steelnb.errors import FileContentError, RecordingError, TopicError
from steelnb.io.bag_files import TRANSFORMS, Bag
from steelnb.io.images import DEPTHS

CLOUD, IMAGE = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
SENSED = (CLOUD, IMAGE, COMPRESSED)
CAMERA, IMU = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Imu"
ODOMETRY, TRANSFORM = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped"
POSE, POSE_COVARIANCE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
POSES = (ODOMETRY, POSE, POSE_COVARIANCE, TRANSFORM)


class Topics(NamedTuple):
    """The topics chosen. ``poses`` None: from tf, or from a trajectory file. ``camera`` and ``lens`` are the
    CameraInfo of depth images and of ``images``."""

    scans: str
    depth: bool
    poses: str | None
    imu: str | None
    camera: str | None
    images: str | None
    lens: str | None
    transforms: tuple[str, ...]


def choose_topics(
    bag: Bag, scans: str | None, poses: str | None, truth: str | None, images: str | None = None
) -> tuple[Topics, dict[str, str]]:
    """The topics that make a flight, and facts about them. Scans are PointCloud2 or, without any, depth images; images
    are all others."""
    clouds, depths = bag.of_type(CLOUD), _depth_images(bag)
    chosen = one_topic(bag, "scans", clouds or depths, scans, [*clouds, *depths])
    if chosen is None:
        raise RecordingError(f"{bag.path}: no scans; expected a topic of PointCloud2 or depth images: {bag.holds()}")
    transforms = tuple(bag.of_type(*TRANSFORMS))
    prior = None
    in_file = poses is not None and poses not in bag.types and Path(poses).exists()
    if not in_file and poses not in transforms:
        possible = bag.of_type(*POSES)
        prior = one_topic(bag, "poses", [topic for topic in possible if topic != truth], poses, possible)
        if prior is None and not transforms and truth in possible:
            prior = truth  # the only poses; noise can be added to them
    facts = {"form": bag.form, "scans": chosen}
    inertial, (seen, fits) = bag.of_type(IMU), _images(bag, depths)
    if len(inertial) > 1:
        facts["imu"] = f"none: {len(inertial)} topics fit: {', '.join(sorted(inertial))}"
    if len(fits) > 1 and images is None:
        facts["images"] = f"none: {len(fits)} topics fit: {', '.join(sorted(fits))}; expected one to be named"
    shown = one_topic(bag, "images", fits[:1] if len(fits) == 1 else [], images, seen)
    camera = _camera_info(bag, chosen) if chosen in depths else None
    lens = _camera_info(bag, shown, alone=not depths) if shown else None
    imu = inertial[0] if len(inertial) == 1 else None
    return Topics(chosen, chosen in depths, prior, imu, camera, shown, lens, transforms), facts


def _images(bag: Bag, depths: Collection[str]) -> tuple[list[str], list[str]]:
    """The topics of images but ``depths``, and those of them that are not another one's, compressed."""
    raw, every = bag.of_type(IMAGE), bag.of_type(IMAGE, COMPRESSED)
    seen = [topic for topic in every if topic not in depths]
    return seen, [topic for topic in seen if topic.rpartition("/")[0] not in raw]


def _camera_info(bag: Bag, topic: str, alone: bool = True) -> str | None:
    """The CameraInfo beside a topic of images, or beside that of which it holds the compressed ones, or ``alone`` in
    the bag."""
    cameras, space = bag.of_type(CAMERA), topic.rpartition("/")[0]
    for beside in (f"{space}/camera_info", f"{space.rpartition('/')[0]}/camera_info"):
        if beside in cameras:
            return beside
    return cameras[0] if alone and len(cameras) == 1 else None


def one_topic(bag: Bag, role: str, fits: Collection[str], named: str | None, possible: Collection[str]) -> str | None:
    """The topic named, or the only one that fits; None without any. Raises `TopicError`."""
    if named is None:
        if len(fits) > 1:
            listed = ", ".join(f"{topic} ({bag.types[topic].rpartition('/')[2]})" for topic in sorted(fits))
            raise TopicError(f"{bag.path}: {len(fits)} topics fit for the {role}; expected one to be named: {listed}")
        return next(iter(fits), None)
    if named not in bag.types:
        raise TopicError(f"{bag.path}: no topic {named!r} for the {role}: {bag.holds()}")
    if named not in possible:
        expected = ", ".join(possible) or "none that it has"
        raise TopicError(
            f"{bag.path}: {named} is of type {bag.types[named]}, not for the {role}; expected one of {expected}"
        )
    return named


def _depth_images(bag: Bag) -> list[str]:
    """Topics of images whose first readable one is a depth image."""
    found = []
    for topic in bag.of_type(IMAGE):
        for message in bag.walk([topic]):
            with suppress(FileContentError):
                found += [topic] if bag.decode(message).encoding in DEPTHS else []
                break
    return found
