"""Files of messages: ROS 1 bags, MCAP and sqlite files, ROS 2 folders, and folders of parts without metadata.

rosbags reads the files and the standard types; ROS is not needed. Its `AnyReader` is not used: it compiles every
message definition in a recording, fails if one of them cannot be parsed, and takes one ROS 2 recording at a time.
"""

import functools
import heapq
import os
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any

from steelnb.core.errors import InputError
from steelnb.io.clouds import READERS
from steelnb.io.messages import CLOUD, IMAGE, TF
from steelnb.io.scanning import Raw, has_magic, ros_type, scan

SUFFIXES = (".bag", ".mcap", ".db3", ".active")
"""Suffixes of files of messages; a recorder that was killed leaves X.bag.active."""
FORMS = {
    ".bag": ("a ROS 1 bag", ", of which `rosbag reindex` may find more"),
    ".active": ("a ROS 1 bag", ", of which `rosbag reindex` may find more"),
    ".mcap": ("an MCAP file", ", of which `mcap recover` may find more"),
    ".db3": ("a sqlite file of ROS 2", ", of which `sqlite3 FILE .recover` may find more"),
    "": ("a ROS 2 folder with .db3 or .mcap files", ""),
}
"""What a file of messages is, and what repairs it."""
GAP_MAX_S, OVERLAP_MAX_S = 60.0, 0.5
"""Parts of one recording follow each other; farther apart, they are several recordings."""
ENCODINGS = ("cdr", "ros1")
"""Encodings of messages that are read, of ROS 2 and of ROS 1."""
NO_SCHEMA = "__schemaless__"
"""What rosbags calls a type whose schema it has not found."""
ZSTD, ZSTD_MAGIC = ".zstd", b"\x28\xb5\x2f\xfd"


class LostIndexError(Exception):
    """The library fails on a file, which is scanned from then on."""


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
    """Whether a path looks like a bag: a file by its suffix, a folder by its metadata or by parts without clouds."""
    if not os.path.isdir(path):
        return path.name.lower().removesuffix(ZSTD).endswith(SUFFIXES)
    if (path / "metadata.yaml").is_file():
        return True
    files = [file for file in path.glob("[!.]*") if not file.is_dir()]
    return any(map(is_bag, files)) and {file.suffix.lower() for file in files}.isdisjoint({*READERS} - {".txt", ".csv"})


class Container:
    """The messages of a recording in order of time. ``types``: message type of each topic with messages.

    ``notes`` says what could not be read. Every pass opens the files again. Raises `InputError`.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.notes, self.left_out = path, dict[str, None](), dict[str, None]()
        self.parts = [Part(file, self.notes, self.left_out) for file in self._files()]
        self.types = {topic: kind for part in self.parts for topic, kind in part.types.items()}
        if not self.types:
            unread = sorted({encoding for part in self.parts for encoding in part.unread})
            if unread:
                raise InputError(f"{path}: messages in {', '.join(unread)}; expected cdr or ros1, the encodings of ROS")
            form, repair = FORMS[next((part.path.suffix.lower() for part in self.parts), "")]
            repair = repair if any(has_magic(part.path) for part in self.parts if part.path.is_file()) else ""
            why = f" ({'; '.join(self.notes)})" if self.notes else ""
            if path.is_dir() and any(path.glob(f"*{ZSTD}")):
                repair = f": unpack its files (`unzstd *{ZSTD}`), since its metadata.yaml cannot be used"
            raise InputError(f"{path}: no whole message in it{why}; expected {form}{repair}")
        self._check_parts()

    def _files(self) -> list[Path]:
        """The files of a recording; a folder with compressed files is left to the library, which unpacks them."""
        if not self.path.is_dir():
            if self.path.suffix.lower() == ZSTD:
                raise InputError(f"{self.path}: is compressed; expected it unpacked (`unzstd {self.path.name}`)")
            return [self.path]
        metadata, here = self.path / "metadata.yaml", sorted(filter(os.path.isfile, self.path.glob("[!.]*")))
        text = metadata.read_text(encoding="utf-8", errors="replace") if metadata.is_file() else ""
        listed = re.findall(r"^\s*- +['\"]?([^'\"\n]+\.(?:db3|mcap)(?:\.zstd)?)['\"]?\s*$", text, re.M)
        names = {PurePath(name.strip()).name for name in listed}
        missing = sorted(names - {file.name for file in here})
        if missing:
            self.notes[f"{metadata.name} names {', '.join(missing)}, which is missing"] = None
        found = [file for file in here if file.name in names]
        found = found or [file for file in here if file.suffix.lower() in SUFFIXES]
        packed = [file.name for file in found or here if file.suffix.lower() == ZSTD]
        if packed and (missing or not names):
            raise InputError(f"{self.path}: {packed[0]} is compressed; expected it unpacked (`unzstd {packed[0]}`)")
        return [self.path] if packed else found

    def _check_parts(self) -> None:
        """Raise `InputError` if the parts are several recordings: far apart, or with the same scans at one time."""
        parts = sorted((part for part in self.parts if part.types), key=lambda part: part.span_ns)
        end_ns, seen = parts[0].span_ns[1], {*parts[0].scans}
        for part in parts[1:]:
            gap_s = (part.span_ns[0] - end_ns) / 1e9
            if gap_s > GAP_MAX_S or (gap_s < -OVERLAP_MAX_S and seen & part.scans):
                what = f"{part.path.name} begins {abs(gap_s):.0f} s {'after' if gap_s > 0 else 'before'} the others end"
                names = ", ".join(each.path.name for each in parts)
                raise InputError(f"{self.path}: bags in it: {names}; {what}; expected parts of one recording, or a bag")
            end_ns, seen = max(end_ns, part.span_ns[1]), seen | part.scans

    def of_type(self, *kinds: str) -> list[str]:
        """Topics of these message types."""
        return [topic for topic, kind in self.types.items() if kind in kinds]

    def count(self, topic: str) -> int:
        """Number of messages of a topic."""
        return sum(part.counts[topic] for part in self.parts)

    def choose(self, role: str, name: str | None, candidates: list[str]) -> str:
        """The candidate topic with that name, or the only candidate. Raises `InputError`."""
        if name in candidates or (name is None and len(candidates) == 1):
            return name or candidates[0]
        kinds = {topic: kind.rpartition("/")[2] for topic, kind in sorted(self.types.items())}
        found = f"{'several topics of' if candidates else 'no'} {role}" if name is None else f"no topic {name!r}"
        found = f"{name} is {kinds[name]}" if name in kinds else found
        topics = ", ".join(f"{topic} ({kinds[topic]})" for topic in sorted(candidates or kinds))
        expected = f"one topic of {role}, or its name, among" if candidates else "one in the recording, which has"
        raise InputError(f"{found}; expected {expected} {topics}")

    def messages(self, *topics: str) -> Iterator[Raw]:
        """Messages of some topics in the order in which they were recorded; those of one part as in its file."""
        streams = [part.messages({*topics}) for part in self.parts]
        merged = streams[0] if len(streams) == 1 else heapq.merge(*streams, key=lambda raw: raw.log_ns)
        yield from (raw for raw in merged if raw.kind == self.types[raw.topic])

    def decode(self, raw: Raw) -> Any:
        """A message as an object of rosbags. Raises `InputError` if it is damaged."""
        data = raw.data
        try:
            if bytes(data[:4]) == ZSTD_MAGIC:  # a ROS 2 recording may compress every message
                from rosbags.rosbag2.reader import zstd  # type: ignore[attr-defined]

                data = zstd.decompress(data)
            store = typestore(1 if raw.encoding == "ros1" else 2)
            return (store.deserialize_ros1 if raw.encoding == "ros1" else store.deserialize_cdr)(data, raw.kind)
        except Exception as fault:  # damaged bytes raise anything in the library
            words = " ".join(str(fault).split())[:200] or type(fault).__name__
            kind = raw.kind.rpartition("/")[2]
            raise InputError(f"{self.path}: not a bag of readable {kind} messages ({raw.topic}): {words}") from None


class Part:
    """A file of messages, or a ROS 2 folder with compressed ones.

    ``types``: message type of each topic with messages; ``unread``: other encodings in it; ``span_ns``: times of the
    first and last message; ``scans``: topics of clouds and images. ``notes`` collects what could not be read, and
    ``left_out`` what was not.
    """

    def __init__(self, path: Path, notes: dict[str, None], left_out: dict[str, None]) -> None:
        self.path, self._notes = path, notes
        for beside in (path.with_name(f"{path.name}-{ending}") for ending in ("wal", "journal")):
            if beside.exists() and beside.stat().st_size:
                merged = f'sqlite3 {path.name} "PRAGMA wal_checkpoint"'
                self._note(f"is not all: {beside.name} beside it has more, which is not read before `{merged}`")
        try:
            with self._reader() as reader:
                chunks = getattr(getattr(reader, "storage", None), "chunks", ())
                self._is_scanned = any(not chunk.channel_count for chunk in chunks)  # no index of messages
                known = [each.msgtype for each in reader.connections]
                # A summary need repeat neither channels nor schemas.
                self._is_scanned |= bool(chunks) and (not known or NO_SCHEMA in known)
                held = [((each.topic, each.msgtype, _encoding(each)), each.msgcount) for each in reader.connections]
                self.span_ns = reader.start_time, reader.end_time
        except Exception:  # of the library: no index, another profile, damage
            self._is_scanned = True
        if self._is_scanned:
            held = [*self._survey().items()]
        self.types: dict[str, str] = {}
        self.counts = Counter[str]()
        self.unread = {encoding for (*_, encoding), count in held if count and encoding not in ENCODINGS}
        for (topic, kind, encoding), count in held:
            if count and encoding in ENCODINGS:
                self.counts[topic] += count
                if self.types.setdefault(topic, ros_type(kind)) != ros_type(kind):
                    left_out[f"{path.name} has {topic} also as {kind.rpartition('/')[2]}, which is left out"] = None
        self.scans = {topic for topic, kind in self.types.items() if kind in (CLOUD, IMAGE)}

    def messages(self, topics: set[str]) -> Iterator[Raw]:
        """Messages of some topics. Raises `LostIndexError` if the library fails; the next pass scans the file."""
        if self._is_scanned:
            yield from (raw for raw in scan(self.path, self._note) if raw.topic in topics and raw.encoding in ENCODINGS)
            return
        try:
            with self._reader() as reader:
                selected = [
                    each for each in reader.connections if each.topic in topics and _encoding(each) in ENCODINGS
                ]
                for connection, log_ns, data in reader.messages(selected) if selected else ():
                    if not isinstance(log_ns, int):
                        raise TypeError(log_ns)
                    kind = ros_type(connection.msgtype)  # some recorders leave out the /msg/
                    yield Raw(log_ns, connection.topic, kind, _encoding(connection), data)
        except Exception:  # of the library, in the middle of a damaged file
            self._is_scanned = self.path.is_file()
            if not self._is_scanned:
                raise InputError(f"{self.path}: damaged; expected a readable ROS 2 folder") from None
            raise LostIndexError from None

    def _reader(self) -> Any:
        from rosbags import rosbag1, rosbag2

        return (rosbag1 if self.path.suffix.lower() in (".bag", ".active") else rosbag2).Reader(self.path)

    def _survey(self) -> Counter[tuple[str, str, str]]:
        """Number of messages of each topic, type and encoding, and their times, from one pass through the file."""
        held, self.span_ns = Counter[tuple[str, str, str]](), (2**63, 0)
        try:
            for raw in scan(self.path, self._note) if self.path.is_file() else ():
                held[raw.topic, raw.kind, raw.encoding] += 1
                self.span_ns = min(self.span_ns[0], raw.log_ns), max(self.span_ns[1], raw.log_ns)
        except OSError as fault:
            raise InputError(f"{self.path}: cannot be read: {fault.strerror or fault}") from None
        return held

    def _note(self, words: str) -> None:
        self._notes[f"{self.path.name} {words}"] = None


def _encoding(connection: Any) -> str:
    """Encoding of a connection's messages; those of a ROS 1 bag name none."""
    return str(getattr(connection.ext, "serialization_format", "ros1"))
