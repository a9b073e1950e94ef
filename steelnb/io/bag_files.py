"""Messages of a ROS 1 bag, an MCAP or sqlite file, or a ROS 2 folder, read by rosbags.

Its readers are used apart from `AnyReader`, which compiles the definitions that a bag brings along: one that cannot be
parsed would keep all others from being read. The standard types are the same everywhere.

Points are read where they lie; sizes that do not fit are refused before anything is allocated.
"""

import bz2
import functools
import os
import shutil
import struct
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np

from steelnb.errors import FileContentError, UnsupportedFormatError, needs
from steelnb.files import reading
from steelnb.types import Array

STORAGES = (".mcap", ".db3")
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_SHOWN = 30
UNPACKED_MAX = 1 << 28
"""Bytes to which a compressed chunk or message may unpack: memory that a small file can ask for."""
FLOATS = {7: "f4", 8: "f8"}
"""PointField datatypes that coordinates may have."""


class Message(NamedTuple):
    """A message as it lies in the bag: its topic, when it was received, its bytes."""

    topic: str
    received_ns: int
    raw: memoryview


class Bag:
    """A bag that is opened anew on every walk.

    ``types`` maps each topic that has messages to its type in ROS 2 spelling, such as ``sensor_msgs/msg/Imu``. Raises
    `FileMissingError`, `FileContentError` and `UnsupportedFormatError`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.ros = 1 if path.suffix.lower() == ".bag" else 2
        self._files = _files(path)
        self.types: dict[str, str] = {}
        for file in self._files:
            with self._opened(file) as reader:
                for connection in reader.connections:
                    if connection.msgcount:
                        self.types.setdefault(connection.topic, connection.msgtype)

    @property
    def form(self) -> str:
        """Format in words."""
        if self.ros == 1:
            return "ROS 1 bag"
        kinds = {file.suffix for file in self.path.glob("*")} if self.path.is_dir() else {self.path.suffix}
        return f"ROS 2 {'MCAP' if '.mcap' in kinds else 'sqlite'}{' folder' if self.path.is_dir() else ''}"

    def of_type(self, *kinds: str) -> list[str]:
        """The topics of these types."""
        return [topic for topic, kind in self.types.items() if kind in kinds]

    def holds(self) -> str:
        """The topics and their types, for a message."""
        listed = [f"{topic} ({kind.rpartition('/')[2]})" for topic, kind in sorted(self.types.items())]
        more = ", ..." if len(listed) > _SHOWN else ""
        return f"it has {', '.join(listed[:_SHOWN])}{more}" if listed else "it holds no messages"

    def walk(self, topics: Collection[str]) -> Iterator[Message]:
        """All messages of some topics in the order of the bag. Raises `FileContentError` where it is damaged."""
        for file in self._files:
            with self._opened(file) as reader:
                wanted = [each for each in reader.connections if each.topic in topics]
                for connection, received_ns, raw in reader.messages(wanted) if wanted else ():
                    yield Message(connection.topic, received_ns, memoryview(raw))

    def decode(self, message: Message) -> Any:
        """The message as an object with the attributes of its type. Raises `FileContentError`."""
        store, kind = typestore(self.ros), self.types[message.topic]
        try:
            return (store.deserialize_ros1 if self.ros == 1 else store.deserialize_cdr)(message.raw, kind)
        except Exception as fault:
            raise FileContentError(f"{message.topic}: not a {kind}: {type(fault).__name__}; expected one") from None

    def stamp_s(self, message: Message) -> float:
        """The stamp of the header at the front of the message, decoded alone. Raises `FileContentError`."""
        try:
            order = "<" if self.ros == 1 or message.raw[1] else ">"
            seconds, nano = struct.unpack_from(f"{order}{'I' if self.ros == 1 else 'i'}I", message.raw, 4)
        except (struct.error, IndexError):
            size = len(message.raw)
            raise FileContentError(f"{message.topic}: a message of {size} bytes; expected one with a stamp") from None
        return (seconds * 10**9 + nano) / 10**9

    @contextmanager
    def _opened(self, file: Path) -> Iterator[Any]:
        """rosbags' reader of one file, within the boundary of reading: for damaged files it raises anything."""
        reader = bag_reader(self.ros)
        with reading(file, "a bag", folder=self.ros == 2), reader(file) as opened:
            yield opened


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag: a file by its ending, a folder by its files."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or any(file.suffix.lower() in STORAGES for file in path.iterdir())
    return path.suffix.lower() in (".bag", *STORAGES)


def truth_path(path: Path) -> Path:
    """Where the truth of a recording lies: X.truth.tum for X.bag and for the folder X."""
    path = path.resolve()
    stem = path.with_suffix("") if path.suffix.lower() in (".bag", *STORAGES) else path
    return stem.with_name(f"{stem.name}.truth.tum")


@functools.cache
def bag_reader(ros: int) -> Any:
    """rosbags' reader of ROS 1 or 2: memory for what it unpacks is bounded, and any name of a sqlite file is read."""
    with needs("io"):
        import lz4.frame
        from backports import zstd
        from rosbags import rosbag1, rosbag2
        from rosbags.rosbag2 import reader, storage_mcap
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    class _BoundedZstd(zstd.ZstdFile):
        """A compressed file, which rosbags unpacks to the temporary disk: half of the free space is left to others."""

        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            self._left = self._bound = shutil.disk_usage(tempfile.gettempdir()).free // 2

        def read(self, size: int | None = -1) -> bytes:
            data: bytes = super().read(size)
            self._left -= len(data)
            if self._left < 0:
                raise ValueError(
                    f"it unpacks to more than {self._bound >> 20} MB, half of what is free in {tempfile.gettempdir()}; "
                    "expected less, or TMPDIR on a larger disk"
                )
            return data

    by_lz4, by_zstd = bounded(lz4.frame.LZ4FrameDecompressor), bounded(zstd.ZstdDecompressor)
    rosbag1.reader.decompressors.update(bz2=bounded(bz2.BZ2Decompressor), lz4=by_lz4)
    storage_mcap.DECOMPRESSORS.update(lz4=by_lz4, zstd=by_zstd)
    setattr(reader, "zstd", SimpleNamespace(decompress=by_zstd, open=_BoundedZstd))  # noqa: B010

    class AnyName(Sqlite3Reader):
        """rosbags puts the path into a URI, where #, ? and % have a meaning."""

        def __init__(self, path: Path) -> None:
            super().__init__(Path(quote(os.fsencode(path))))

    for each, key in ((reader.Reader, ".db3"), (reader.DirectoryReader, "sqlite3")):
        each.STORAGE_PLUGINS = {**each.STORAGE_PLUGINS, key: AnyName}
    return rosbag1.Reader if ros == 1 else rosbag2.Reader


def bounded(make: Callable[[], Any]) -> Callable[..., bytes]:
    """A function that unpacks bytes with a new decompressor, to `UNPACKED_MAX` bytes; more are a ValueError."""

    def unpack(data: bytes, *_: Any) -> bytes:
        pieces, size = [], 0
        while data:  # of which there may be several frames
            decompressor = make()
            pieces.append(decompressor.decompress(data, UNPACKED_MAX + 1 - size))
            size += len(pieces[-1])
            if size > UNPACKED_MAX:
                raise ValueError(f"a chunk or a message unpacks to more than {UNPACKED_MAX >> 20} MB; expected less")
            if not decompressor.eof:
                raise ValueError("compressed data end early")
            data = decompressor.unused_data or b""
        return b"".join(pieces)

    return unpack


@functools.cache
def typestore(ros: int) -> Any:
    """rosbags' definitions of the standard messages of ROS 1 or 2, tf among them."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    for kind in TRANSFORMS:
        if kind not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return store


def _files(path: Path) -> list[Path]:
    """A file, a folder with metadata, or the files of a folder without."""
    if not path.is_dir():
        return [path]
    if (path / "metadata.yaml").is_file():
        for file in path.iterdir():  # which rosbags opens, and would wait for
            with reading(file, "a file of a bag", folder=True):
                pass
        return [path]
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in STORAGES)
    if not files:
        raise UnsupportedFormatError(f"{path}: a folder; expected metadata.yaml, or files that end in .mcap or .db3")
    return files


def decode_points(message: Any) -> Array:
    """Points of a PointCloud2, ``(H, W, 3)`` where it is organised, else ``(N, 3)``; NaN rows where not finite.

    Other fields and padding are ignored, and so is ``row_step`` of a single row, which many drivers leave at zero.
    Raises `FileContentError` with the value that does not fit.
    """
    height, width = _whole(message, "height"), _whole(message, "width")
    step, row = _whole(message, "point_step"), _whole(message, "row_step")
    if height == 0 or width == 0:
        return np.zeros((0, 3))
    layout = _layout(message, step)
    row = width * step if height == 1 else row
    if row < width * step:
        raise FileContentError(f"row_step {row}; expected at least {width * step} for {width} points of {step} bytes")
    if len(message.data) < height * row:
        raise FileContentError(f"data of {len(message.data)} bytes; expected {height * row} for {height} rows of {row}")
    data = np.frombuffer(message.data, dtype=np.uint8)
    points = np.empty((height, width, 3))
    with np.errstate(invalid="ignore", over="ignore"):  # signalling NaN; sums of the largest numbers
        for k, (kind, offset) in enumerate(layout):
            points[..., k] = np.ndarray((height, width), kind, data, offset, (row, step))
        invalid = ~np.isfinite(points @ np.ones(3))
    if invalid.any():
        points[invalid] = np.nan
    return points if height > 1 and width > 1 else points.reshape(-1, 3)


def _layout(message: Any, step: int) -> list[tuple[str, int]]:
    """Type and offset of x, y and z in a record of ``step`` bytes."""
    order, layout = ">" if message.is_bigendian else "<", []
    names = [field.name for field in message.fields]
    for axis in "xyz":
        if names.count(axis) != 1:
            raise FileContentError(f"fields {', '.join(map(str, names[:20])) or 'none'}; expected one {axis}")
        field = message.fields[names.index(axis)]
        if field.datatype not in FLOATS:
            raise FileContentError(f"field {axis} of datatype {field.datatype}; expected 7 (FLOAT32) or 8 (FLOAT64)")
        if _whole(field, "count") > 1:  # old drivers write 0 for 1
            raise FileContentError(f"field {axis} with count {field.count}; expected 1")
        layout.append((order + FLOATS[field.datatype], _whole(field, "offset")))
    end = max(offset + np.dtype(kind).itemsize for kind, offset in layout)
    if end > step:
        raise FileContentError(f"point_step {step}; expected at least {end}, where its fields end")
    return layout


def _whole(holder: Any, name: str) -> int:
    value = getattr(holder, name)
    if not 0 <= value < 2**32:
        raise FileContentError(f"{name} {value}; expected a whole number from 0 to 2³² − 1")
    return int(value)
