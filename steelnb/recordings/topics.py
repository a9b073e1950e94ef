"""Which topics of a bag hold what: by their types, by name where several fit."""

from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from steelnb.errors import FileContentError, RecordingError, TopicError
from steelnb.recordings.bag_files import TRANSFORMS, Bag
from steelnb.recordings.bag_images import DEPTHS, PICTURES
from steelnb.recordings.choice import Choice

CLOUD = "sensor_msgs/msg/PointCloud2"
IMAGE = "sensor_msgs/msg/Image"
CAMERA = "sensor_msgs/msg/CameraInfo"
IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
POSES = (ODOMETRY, POSE, POSE_COVARIANCE, TRANSFORM)
_SHOWN = 30


@dataclass(frozen=True)
class Topics:
    """The topics chosen. ``poses`` None: from tf, or from the trajectory file that the user named; ``unclear`` says of
    optional ones why none was taken."""

    scans: str
    depth: bool
    poses: str | None
    truth: str | None
    pictures: str | None
    imu: str | None
    camera: str | None
    transforms: tuple[str, ...]
    unclear: dict[str, str]


def choose_topics(bag: Bag, choice: Choice) -> Topics:
    """The topics of a bag that make a recording.

    Scans are PointCloud2 or, where there are none, depth images. Raises `TopicError` where several fit and none is
    named, or where the one named is not there or of no use; `RecordingError` where there are no scans.
    """
    images = _encodings(bag, [topic for topic, kind in bag.types.items() if kind == IMAGE])
    depths = [topic for topic, encoding in images.items() if encoding in DEPTHS]
    clouds = of_type(bag, CLOUD)
    scans = _one(bag, "scans", clouds or depths, choice.scans, [*clouds, *depths])
    if scans is None:
        raise RecordingError(
            f"{bag.path}: no scans; expected a topic of type PointCloud2, or depth images: {held(bag)}"
        )
    truth = choice.truth if choice.truth in bag.types else None
    if choice.truth and not truth and not Path(choice.truth).is_file():
        raise TopicError(f"{bag.path}: no topic and no file {choice.truth!r}: {held(bag)}")
    if truth:
        _one(bag, "truth", [], truth, of_type(bag, *POSES))
    transforms = tuple(of_type(bag, *TRANSFORMS))
    unclear: dict[str, str] = {}
    poses = None
    from_file = choice.poses is not None and choice.poses not in bag.types and Path(choice.poses).is_file()
    if not from_file and choice.poses not in transforms:
        possible = of_type(bag, *POSES)
        poses = _one(bag, "poses", [topic for topic in possible if topic != truth], choice.poses, possible)
        if poses is None and not transforms:
            poses = truth  # all that there is; noise can be added to them
    pictures = _optional(
        bag,
        "pictures",
        [topic for topic, encoding in images.items() if encoding in PICTURES],
        choice.pictures,
        unclear,
    )
    return Topics(
        scans=scans,
        depth=scans in depths,
        poses=poses,
        truth=truth,
        pictures=pictures,
        imu=_optional(bag, "imu", of_type(bag, IMU), None, unclear),
        camera=_camera_of(bag, scans) if scans in depths else None,
        transforms=transforms,
        unclear=unclear,
    )


def of_type(bag: Bag, *kinds: str) -> list[str]:
    """The topics that have messages of these types."""
    return [topic for topic, kind in bag.types.items() if kind in kinds]


def held(bag: Bag) -> str:
    """What a bag holds, for a message."""
    if not bag.types:
        return "it holds no messages"
    listed = [f"{topic} ({kind.rpartition('/')[2]})" for topic, kind in sorted(bag.types.items())]
    return f"it has {', '.join(listed[:_SHOWN])}{', ...' if len(listed) > _SHOWN else ''}"


def _one(bag: Bag, what: str, fits: Collection[str], named: str | None, possible: Collection[str]) -> str | None:
    if named is not None:
        if named not in bag.types:
            raise TopicError(f"{bag.path}: no topic {named!r} for the {what}: {held(bag)}")
        if named not in possible:
            raise TopicError(
                f"{bag.path}: {named} is of type {bag.types[named]}, not for the {what}; "
                f"expected one of {', '.join(possible) or 'none that it has'}"
            )
        return named
    if len(fits) > 1:
        listed = ", ".join(f"{topic} ({bag.types[topic].rpartition('/')[2]})" for topic in sorted(fits))
        raise TopicError(f"{bag.path}: {len(fits)} topics fit for the {what}; expected one to be named out of {listed}")
    return next(iter(fits), None)


def _optional(bag: Bag, what: str, fits: Collection[str], named: str | None, unclear: dict[str, str]) -> str | None:
    """As `_one`, but without an error where several fit: then none is taken, and that is said."""
    if named is None and len(fits) > 1:
        unclear[what] = f"none: {len(fits)} topics fit: {', '.join(sorted(fits))}"
        return None
    return _one(bag, what, fits, named, fits)


def _encodings(bag: Bag, topics: Collection[str]) -> dict[str, str]:
    """The encoding of the first image of each topic that can be read."""
    found = {}
    for topic in topics:
        for message in bag.walk([topic]):
            with suppress(FileContentError):
                found[topic] = str(bag.decode(message).encoding)
                break
    return found


def _camera_of(bag: Bag, images: str) -> str | None:
    """The CameraInfo beside a topic of images, or the only one."""
    cameras = of_type(bag, CAMERA)
    beside = f"{images.rpartition('/')[0]}/camera_info"
    return beside if beside in cameras else cameras[0] if len(cameras) == 1 else None
