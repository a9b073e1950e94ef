"""Topics and raw messages of a ROS 1 bag, an MCAP or sqlite file, or a ROS 2 folder, read by rosbags.

rosbags meets damaged files with exceptions of many types, assertions among them; here each becomes one of ours. The
definitions that a bag brings along are not used: the standard types are the same everywhere, and one that cannot be
parsed would keep all others from being read.
"""

import functools
import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from steelnb.errors import FileContentError, FileMissingError, SteelnbError, UnsupportedFormatError

STORAGES = (".mcap", ".db3")
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


class Message(NamedTuple):
    """A message as it lies in the bag: its topic, when it was received, its bytes."""

    topic: str
    received_ns: int
    raw: memoryview


class Bag:
    """What a bag holds; each walk opens it anew.

    ``types`` maps each topic that has messages to its type, in ROS 2 spelling: ``sensor_msgs/msg/Imu``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.ros = 1 if path.suffix.lower() == ".bag" else 2
        self._files = _files(path)
        self.types: dict[str, str] = {}
        self.counts: dict[str, int] = {}
        for file in self._files:
            with self._opened(file) as reader:
                for connection in reader.connections:
                    if connection.msgcount:
                        self.types.setdefault(connection.topic, connection.msgtype)
                        self.counts[connection.topic] = self.counts.get(connection.topic, 0) + connection.msgcount

    @property
    def form(self) -> str:
        """Its form in words."""
        if self.ros == 1:
            return "ROS 1 bag"
        kinds = {file.suffix for file in self.path.glob("*")} if self.path.is_dir() else {self.path.suffix}
        return f"ROS 2 {'MCAP' if '.mcap' in kinds else 'sqlite'}{' folder' if self.path.is_dir() else ''}"

    def walk(self, topics: Collection[str]) -> Iterator[Message]:
        """All messages of some topics as they were received. Raises `FileContentError` where the bag is damaged."""
        for file in self._files:
            with self._opened(file) as reader:
                wanted = [each for each in reader.connections if each.topic in topics]
                for connection, received_ns, raw in reader.messages(wanted) if wanted else ():
                    yield Message(connection.topic, received_ns, memoryview(raw))

    def decode(self, message: Message) -> Any:
        """The message as an object with the attributes of its type. Raises `FileContentError`."""
        store, kind = typestore(self.ros), self.types[message.topic]
        try:
            read = store.deserialize_ros1 if self.ros == 1 else store.deserialize_cdr
            return read(message.raw, kind)
        except Exception as fault:
            raise FileContentError(f"{self.path}: {message.topic}: not a {kind}: {_line(fault)}") from None

    def stamp_ns(self, message: Message) -> int:
        """The stamp in the header that the message begins with, in nanoseconds. Raises `FileContentError`."""
        try:
            if self.ros == 1:
                seconds, rest = struct.unpack_from("<II", message.raw, 4)
            else:
                seconds, rest = struct.unpack_from("<iI" if message.raw[1] else ">iI", message.raw, 4)
        except (struct.error, IndexError):
            raise FileContentError(
                f"{self.path}: {message.topic}: a message of {len(message.raw)} bytes; expected one with a stamp"
            ) from None
        return seconds * 10**9 + rest

    @contextmanager
    def _opened(self, file: Path) -> Iterator[Any]:
        """rosbags' reader of one file; what it raises, at any message, is told as ours."""
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2

        with _explained(file), Reader1(file) if self.ros == 1 else Reader2(file) as reader:
            yield reader


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag: a file by its ending, a folder by what is in it."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or any(file.suffix.lower() in STORAGES for file in path.iterdir())
    return path.suffix.lower() in (".bag", *STORAGES)


@functools.cache
def typestore(ros: int) -> Any:
    """rosbags' definitions of the standard messages of ROS 1 or 2, tf's added to those of ROS 1."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    for kind in TRANSFORMS:
        if kind not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return store


def _files(path: Path) -> list[Path]:
    """What rosbags is to open: a file, a folder with its metadata, or the files of a folder without."""
    if not path.exists():
        raise FileMissingError(f"{path}: does not exist; expected a bag")
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return [path]
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in STORAGES)
    if not files:
        raise UnsupportedFormatError(f"{path}: a folder; expected metadata.yaml, or files that end in .mcap or .db3")
    return files


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    try:
        yield
    except SteelnbError:
        raise
    except (PermissionError, FileNotFoundError) as fault:
        raise FileMissingError(f"{path}: cannot be read: {fault.strerror or _line(fault)}") from None
    except Exception as fault:
        raise FileContentError(f"{path}: {_line(fault)}; expected a complete bag") from None


def _line(fault: Exception) -> str:
    """What an exception says, on one line."""
    text = " ".join(" ".join(map(str, fault.args)).split())[:200].rstrip(".")
    return text or f"damaged ({type(fault).__name__})"
