"""Messages of files that have lost their index: records of MCAP, ROS 1 and sqlite files, one after the other.

rosbags reads a file by its index, which a recorder writes last. After a crash or a power cut there is none, and what is
whole is read here. The formats are those of mcap.dev/spec and wiki.ros.org/Bags/Format/2.0.
"""

import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from steelnb.io.encodings import foreign
from steelnb.io.messages import TF

MCAP_MAGIC, BAG_MAGIC, SQLITE_MAGIC = b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n", b"SQLite format 3\0"
OnDamage = Callable[[str], None]


class Raw(NamedTuple):
    """A message as it was recorded: time in nanoseconds, topic, type, encoding (cdr or ros1), and bytes."""

    log_ns: int
    topic: str
    kind: str
    encoding: str
    data: Any


def scan(path: Path, on_damage: OnDamage) -> Iterator[Raw]:
    """Messages of a file in the order of its records. ``on_damage`` is told what cannot be read.

    It yields nothing for a file of another format.
    """
    with path.open("rb") as file:
        begin = file.read(32)
        found = [read for magic, read in _READERS.items() if begin.startswith(magic[:16])]
        if not found:
            what = foreign(begin)
            on_damage(f"is {what}" if what else f"begins with {begin[:12]!r}" if begin else "is empty")
            return
        try:
            yield from found[0](file, on_damage)
        except Exception:  # of a size, a name or a text that is damaged, or of a library
            on_damage(f"is cut short or damaged at byte {file.tell()}")


def has_magic(path: Path) -> bool:
    """Whether a file begins as one of these formats."""
    with path.open("rb") as file:
        return file.read(16).startswith(tuple(magic[:16] for magic in _READERS))


def _left(file: BinaryIO) -> int:
    begin = file.tell()
    left = file.seek(0, 2) - begin
    file.seek(begin)
    return left


def _exactly(file: BinaryIO, size: int) -> bytes:
    """The next bytes. Raises EOFError if there are fewer; a damaged size allocates nothing."""
    if size > _left(file):
        raise EOFError
    return file.read(size)


def _unpack(form: str, file: BinaryIO) -> tuple[int, ...]:
    return struct.unpack("<" + form, _exactly(file, struct.calcsize("<" + form)))


def _text(file: BinaryIO) -> str:
    return _exactly(file, *_unpack("I", file)).decode()


def _mcap(file: BinaryIO, on_damage: OnDamage) -> Iterator[Raw]:
    """Messages of an MCAP file, sorted by time within each chunk."""
    from rosbags.rosbag2.storage_mcap import decompress

    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str, str]] = {}

    def records(part: BinaryIO, chunks: bool = True) -> Iterator[tuple[bytes, BinaryIO]]:
        """Kind and content of each record up to the footer; all that is left of a chunk that is cut short."""
        while (kind := part.read(1)) and kind != b"\x02":
            (size,) = _unpack("Q", part)
            is_cut, is_chunk = size > _left(part), kind == b"\x06"
            if is_chunk and not chunks:
                part.seek(size, 1)
            elif is_chunk or not is_cut:
                yield kind, BytesIO(part.read(-1 if is_cut else size))
            if is_cut:
                raise EOFError
        if part is file and not kind:
            raise EOFError

    def learn(kind: bytes, body: BinaryIO) -> None:
        if kind == b"\x03":
            (schema,) = _unpack("H", body)
            schemas[schema] = _text(body)
        elif kind == b"\x04":
            channel, schema = _unpack("HH", body)
            topic, encoding = _text(body), _text(body)
            channels[channel] = topic, ros_type(schemas.get(schema, "")), encoding

    def messages(part: BinaryIO) -> Iterator[Raw]:
        for kind, body in records(part):
            learn(kind, body)
            if kind == b"\x05":
                channel, _, log_ns, _ = _unpack("HIQQ", body)
                if channel in channels:
                    yield Raw(log_ns, *channels[channel], body.read())
            elif kind == b"\x06":
                yield from chunk(body)

    def chunk(body: BinaryIO) -> Iterator[Raw]:
        found: list[Raw] = []
        is_whole = False
        try:
            _, _, size, check = _unpack("QQQI", body)
            compression, (packed,) = _text(body), _unpack("Q", body)
            is_whole = _left(body) >= packed  # the last may be cut short
            data = body.read(packed)
            found.extend(messages(BytesIO(decompress(data, compression, size, check) if is_whole else data)))
        except Exception:  # of a decompressor, or of a record
            on_damage("has a damaged chunk") if is_whole else None
        yield from sorted(found, key=lambda raw: raw.log_ns)

    file.seek(len(MCAP_MAGIC))
    with suppress(Exception):  # told below
        # A summary at the end repeats what a damaged chunk may have held.
        for kind, body in records(file, chunks=False):
            learn(kind, body)
    file.seek(len(MCAP_MAGIC))
    yield from messages(file)


def _bag(file: BinaryIO, on_damage: OnDamage) -> Iterator[Raw]:
    """Messages of a ROS 1 bag. The records of a chunk that is not compressed are read one by one, whatever its size:
    a recorder that was killed has not written it."""
    from rosbags.rosbag1.reader import decompressors

    connections: dict[int, tuple[str, str]] = {}

    def header(part: BinaryIO) -> dict[str, bytes]:
        fields, content = {}, BytesIO(_exactly(part, *_unpack("I", part)))
        while content.tell() < len(content.getvalue()):
            name, _, value = _exactly(content, *_unpack("I", content)).partition(b"=")
            fields[name.decode()] = value
        return fields

    def messages(part: BinaryIO) -> Iterator[Raw]:
        while part.read(1):
            part.seek(-1, 1)
            fields, (size,) = header(part), _unpack("I", part)
            if fields["op"] == b"\x05" and fields["compression"] == b"none":
                continue
            data = _exactly(part, size)
            number = int.from_bytes(fields.get("conn", b""), "little")
            if fields["op"] == b"\x07":
                about = header(BytesIO(struct.pack("<I", len(data)) + data))
                connections[number] = fields["topic"].decode(), ros_type(about["type"].decode())
            elif fields["op"] == b"\x02" and number in connections:
                second, nanosecond = struct.unpack("<II", fields["time"])
                yield Raw(second * 10**9 + nanosecond, *connections[number], "ros1", data)
            elif fields["op"] == b"\x05":
                yield from chunk(fields["compression"].decode(), data)

    def chunk(compression: str, data: bytes) -> Iterator[Raw]:
        found: list[Raw] = []
        try:
            found.extend(messages(BytesIO(decompressors[compression](data))))
        except Exception:  # of a decompressor, or of a record
            on_damage("has a damaged chunk")
        yield from found

    file.seek(len(BAG_MAGIC))
    yield from messages(file)


def _sqlite(file: BinaryIO, on_damage: OnDamage) -> Iterator[Raw]:
    """Messages of a sqlite file in the order in which they were written, without its index of times."""
    path = Path(file.name).resolve()
    file.seek(0, 2)
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro&immutable=1", uri=True)) as database:
        database.execute("PRAGMA writable_schema = ON")  # else a file with fewer pages than stated is not opened
        query = "SELECT id, name, type, serialization_format FROM topics"
        topics = {row[0]: (row[1], ros_type(row[2]), row[3]) for row in database.execute(query)}
        for topic, log_ns, data in database.execute("SELECT topic_id, timestamp, data FROM messages NOT INDEXED"):
            if topic in topics and isinstance(data, bytes) and isinstance(log_ns, int):
                yield Raw(log_ns, *topics[topic], data)


def ros_type(name: str) -> str:
    """Name of a type as in ROS 2: sensor_msgs/msg/Imu for sensor_msgs/Imu; both names of transforms are one."""
    name = name if name.count("/") != 1 else name.replace("/", "/msg/")
    return TF[0] if name in TF else name


_READERS = {MCAP_MAGIC: _mcap, BAG_MAGIC: _bag, SQLITE_MAGIC: _sqlite}
