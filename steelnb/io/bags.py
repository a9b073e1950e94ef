"""Flights recorded in bags, read by rosbags: topics by their types, headers in one pass, and the scans one by one."""

import heapq
import os
import weakref
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.files import damaged, display_name
from steelnb.core.types import Array, Imu, IntArray, Trajectory
from steelnb.io import messages as ros
from steelnb.io.folders import CLOUDS, Recorded
from steelnb.io.trajectories import read_trajectory, trajectory_of
from steelnb.io.transforms import ScanFrames, Tree, check_mounts, scan_frames, turned_up, up_axes
from steelnb.settings.recording import RecordingOptions

SUFFIXES = {".bag": "rosbag reindex", ".mcap": "mcap recover", ".db3": "ros2 bag reindex"}
"""Suffixes of files of messages, and what repairs them."""


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a file by its suffix, a folder by its metadata or by files of messages without
    clouds."""
    if not os.path.isdir(path):  # is_dir raises for a name that is too long
        return path.suffix.lower() in SUFFIXES
    held = {file.suffix.lower() for file in path.glob("[!.]*") if file.is_file()}
    return (path / "metadata.yaml").is_file() or bool(held & {*SUFFIXES} and not held & CLOUDS)


class Raw(NamedTuple):
    """A message as it is in the file: the time of recording, and how to decode it."""

    log_ns: int
    topic: str
    kind: str
    decode: Callable[[], Any]


class Bag:
    """The messages of a recording in order of time. ``types`` and ``counts`` of each topic with messages.

    The files stay open as long as the object is used. Raises `InputError` with what may repair a file.
    """

    def __init__(self, path: Path) -> None:
        files = [path]
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            files = sorted(file for file in path.glob("[!.]*") if file.suffix.lower() in SUFFIXES)
        stack = ExitStack()
        weakref.finalize(self, stack.close)
        self.path, self._readers, self.repair = path, list[Any](), SUFFIXES.get(files[0].suffix.lower(), "")
        self.repair = self.repair or "ros2 bag reindex"
        self.types, self.counts = dict[str, str](), Counter[str]()
        for file in files:
            with self._readable(file):
                self._readers.append(stack.enter_context(_reader(file)))
        self._readers.sort(key=lambda reader: reader.start_time)
        for each in (each for reader in self._readers for each in reader.connections if each.msgcount):
            self.types[each.topic] = each.msgtype
            self.counts[each.topic] += each.msgcount
        if not self.types:
            raise InputError(f"{path}: no message in it; `{self.repair}` may find some")

    def of_type(self, *kinds: str) -> list[str]:
        """Topics of these message types."""
        return [topic for topic, kind in self.types.items() if kind in kinds]

    def messages(self, *topics: str) -> Iterator[Raw]:
        """Messages of some topics in the order in which they were recorded."""
        with self._readable(self.path):
            yield from heapq.merge(
                *(self._part(reader, topics) for reader in self._readers), key=lambda raw: raw.log_ns
            )

    def first(self, topic: str) -> Any:
        """The first message of a topic."""
        for raw in self.messages(topic):
            return raw.decode()
        raise InputError(f"no message of {topic} can be read; `{self.repair}` may find more")

    def _part(self, reader: Any, topics: tuple[str, ...]) -> Iterator[Raw]:
        selected = [each for each in reader.connections if each.topic in topics]
        for connection, log_ns, data in reader.messages(selected) if selected else ():
            yield Raw(log_ns, connection.topic, connection.msgtype, partial(self._decode, connection, data))

    def _decode(self, connection: Any, data: bytes) -> Any:
        is_ros1 = not hasattr(connection.ext, "serialization_format")
        store = ros.typestore(1 if is_ros1 else 2)
        with damaged(self.path, f"a bag of readable messages ({connection.topic})"):
            return (store.deserialize_ros1 if is_ros1 else store.deserialize_cdr)(data, connection.msgtype)

    def _readable(self, file: Path) -> Any:
        return damaged(file, f"a recording that rosbags reads (if it is damaged, `{self.repair}` may help)")

    def choose(self, role: str, option: str, stated: str | None, candidates: list[str], others: list[str]) -> str:
        """The topic of this name among ``candidates`` and ``others``, else the only candidate. Raises `InputError`
        that lists the topics and names the option."""
        if stated in (*candidates, *others) or (stated is None and len(candidates) == 1):
            return stated or candidates[0]
        shown = candidates or others or sorted(self.types)
        listed = ", ".join(f"{t} ({self.types[t].rpartition('/')[2]}, {self.counts[t]} messages)" for t in shown)
        found = f"{len(candidates) or 'no'} topics of {role}" if stated is None else f"no topic {stated!r} of {role}"
        raise InputError(f"{found}; expected one of them ({option} TOPIC): {listed}")


def _reader(file: Path) -> Any:
    from rosbags import rosbag1, rosbag2

    return rosbag1.Reader(file) if file.suffix.lower() == ".bag" else rosbag2.Reader(file)


def open_bag(path: Path, options: RecordingOptions, T_stated: Array | None) -> Recorded:
    """Open a bag. ``T_stated``: ``T_drone_sensor (4, 4)`` if the user states it. Raises `InputError`."""
    try:
        return _Headers(Bag(path), options).opened(T_stated)
    except InputError as fault:
        text = str(fault)
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None


class _Headers:
    """What one pass through the small messages and the headers of the scans gives.

    ``rows``: stamp, time of recording and values of the messages of a topic, by its frames, or of a transform;
    ``frames``: that of each scan; ``faults``: the first message of a topic that cannot be decoded.
    """

    def __init__(self, bag: Bag, options: RecordingOptions) -> None:
        self.bag, self.options, self.skipped = bag, options, Counter[str]()
        images, poses = bag.of_type(ros.IMAGE), bag.of_type(*ros.POSES)
        depths = [topic for topic in images if bag.first(topic).encoding in ros.SAID_DEPTHS]
        self.scans = bag.choose("scans", "--scans", options.scans, [*bag.of_type(ros.CLOUD), *depths], images)
        self.camera = bag.first(self._camera_topic()) if self.scans in images else None
        stated = options.poses or ""
        self.pair = (stated.partition(">")[0], stated.partition(">")[2]) if ">" in stated else None
        folder = bag.path if bag.path.is_dir() else bag.path.parent
        found = [file for file in (Path(stated), folder / stated) if stated not in poses and os.path.isfile(file)]
        self.file = found[0] if found else None
        self.poses = poses if self.pair else []
        if not self.pair and self.file is None and (poses or stated):
            self.poses = [bag.choose("poses", "--poses", options.poses, poses, [])]
        inertial = bag.of_type(ros.IMU)
        measured = [topic for topic in inertial if ros.measures_all(bag.first(topic))]
        self.imu = ""
        if options.imu != "none" and (measured or options.imu):
            self.imu = bag.choose("an IMU, or none", "--imu", options.imu, measured, inertial)
        self.rows: dict[tuple[str, ...], array[float]] = defaultdict(lambda: array("d"))
        self.frames: list[str] = []
        self.faults: dict[str, InputError] = {}
        for raw in bag.messages(self.scans, *bag.of_type(*ros.TF), *self.poses, self.imu):
            self._store(raw)
        if np.isnan(self._of(self.scans)[:, 0]).all():
            lost = f"no message of {self.scans} can be read; `{bag.repair}` may find more"
            raise self.faults.get(self.scans) or InputError(lost)

    def _camera_topic(self) -> str:
        """The CameraInfo beside the images, else the only one."""
        beside, known = f"{self.scans.rpartition('/')[0]}/camera_info", self.bag.of_type(ros.CAMERA)
        if beside not in known and len(known) != 1:
            listed = ", ".join(known) or "none"
            raise InputError(f"{self.scans}: no CameraInfo {beside}; expected it, or a single one, among {listed}")
        return beside if beside in known else known[0]

    def _store(self, raw: Raw) -> None:
        try:
            message = raw.decode()
        except InputError as fault:
            self.faults.setdefault(raw.topic, fault)
            self.skipped[f"{raw.kind.rpartition('/')[2]} message that cannot be decoded"] += 1
            if raw.topic == self.scans:  # it keeps its number
                self.rows[(self.scans,)].extend((np.nan, raw.log_ns / 1e9))
                self.frames.append("")
            return
        if raw.kind in ros.TF:
            kind = "tf_static" if raw.topic.endswith("tf_static") else "tf"
            for each in message.transforms:
                self._add((kind, *ros.frames_of(each)), raw, each, ros.pose_numbers(each, ros.TRANSFORM))
        elif raw.topic == self.scans:
            self._add((self.scans,), raw, message, [])
            self.frames.append(ros.frames_of(message)[0])
        elif raw.topic == self.imu:
            values = ros.numbers(message.linear_acceleration, message.angular_velocity)
            self._add((self.imu, ros.frames_of(message)[0]), raw, message, values)
        else:
            self._add((raw.topic, *ros.frames_of(message)), raw, message, ros.pose_numbers(message, raw.kind))

    def _add(self, key: tuple[str, ...], raw: Raw, message: Any, values: list[float]) -> None:
        log_s = raw.log_ns / 1e9
        self.rows[key].extend((log_s if self.options.clock == "bag" else ros.stamp_of(message), log_s, *values))

    def _of(self, *key: str, values: int = 0) -> Array:
        return np.array(self.rows[key]).reshape(-1, values + 2)

    def _poses_of(self, *key: str) -> Trajectory:
        """Poses of a topic and two frames, or the transform between these."""
        return trajectory_of(" ".join(key), _by_stamp(self._of(*key, values=7)), self.skipped)

    def opened(self, T_stated: Array | None) -> Recorded:
        """The parts of the flight, and what was taken from where. ``T_stated``: the mount if the user states it."""
        bag, options = self.bag, self.options
        rows = self._of(self.scans)
        stamp_s, tree = rows[:, 0] + options.time_offset, self._tree()
        sensor = Counter(np.array(self.frames)[~np.isnan(stamp_s)].tolist()).most_common(1)[0][0]
        self.frames = [sensor if lost else frame for frame, lost in zip(self.frames, np.isnan(stamp_s), strict=True)]
        prior, world, body, said = self._prior(tree, sensor)
        is_depth = self.camera is not None
        if options.scans_in == "world":
            self.frames = [body] * len(self.frames)  # no frame matters: the poses bring the points back
        T_body_drone = up_axes(world, options.world == "ned")[1]
        frames = scan_frames(tree, world, body, self.frames, stamp_s, T_stated, is_depth, options.optical, T_body_drone)
        if T_stated is not None and options.mount_sigma and tree.between(body, sensor):
            of_tf = scan_frames(tree, world, body, self.frames, stamp_s, None, is_depth, options.optical, T_body_drone)
            check_mounts(T_stated, of_tf.T_drone_sensor, options.mount_sigma)
        unplaced = ~frames.known & ~np.isnan(stamp_s)
        self.skipped["scan without a transform to the drone at its time"] += int(unplaced.sum())
        ahead_ms = 1e3 * (rows[:, 1] - rows[:, 0])
        late = "recorded {:.0f} ms after them in the median, {:.0f} to {:.0f}".format(
            *np.nanpercentile(ahead_ms, [50, 0, 100])
        )
        kind = bag.types[self.scans].rpartition("/")[2]
        encoding = f" {bag.first(self.scans).encoding}" if is_depth else ""
        imu, of_imu = self._readings(tree, body) if self.imu else (None, "none")
        facts = {
            "scans": f"{self.scans} ({kind}{encoding}), {len(stamp_s)} messages",
            "poses": said,
            "frames": frames.chain,
            "clock": f"{'times of recording' if options.clock == 'bag' else 'header stamps'} of scans; {late}",
            "mount": frames.mount,
            "imu": of_imu,
        }
        stamps = np.where(frames.known, stamp_s, np.nan)
        return Recorded(stamps, partial(self._walk, frames), prior, frames.T_drone_sensor, facts, imu, self.skipped)

    def _tree(self) -> Tree:
        tree = Tree()
        for kind, parent, child in [key for key in self.rows if key[0] in ("tf", "tf_static")]:
            rows, is_static = self._of(kind, parent, child, values=7), kind == "tf_static"
            rows = rows[-1:] if is_static else rows  # the last one holds, whatever its stamp
            try:
                path = trajectory_of(f"{parent} → {child}", _by_stamp(rows), Counter())  # repeated ones are usual
            except InputError:
                self.skipped[f"transforms {parent} → {child}, none of them valid,"] += len(rows)
                continue
            tree.add(parent, child, path, is_static)
        return tree

    def _prior(self, tree: Tree, sensor: str) -> tuple[Trajectory, str, str, str]:
        """Poses of the drone, z up, names of the world and of the drone's frame, and the source in words."""
        source, pairs = "tf", [key[1:] for key in self.rows if key[0] in self.poses]
        if self.file:
            found, world, body = read_trajectory(self.file, self.options, self.skipped), "", ""
            source = display_name(self.file)
        elif pairs and (not self.pair or self.pair in pairs):
            world, body = self._chosen(tree, sensor, [self.pair] if self.pair else pairs)
            source = next(topic for topic in self.poses if (topic, world, body) in self.rows)
            found = self._poses_of(source, world, body)
        else:
            world, body = self.pair or self._chosen(tree, sensor, tree.moving_pairs(sensor))
            found = tree.poses(world, body)
        if not body and sensor != world and sensor in tree.frames:
            body = tree.fixed_above(sensor)
        if world and world != body and not tree.between(world, body):
            tree.add(world, body, found)
        kind = self.bag.types[source].rpartition("/")[2] if source in self.bag.types else ""
        said = f"{source}{kind and f' ({kind})'}, {body or 'the drone'}{world and f' in {world}'}"
        return turned_up(found, world, self.options.world == "ned"), world, body, said

    def _chosen(self, tree: Tree, sensor: str, pairs: list[Any]) -> tuple[str, str]:
        """The only pair of frames, or the only one whose body carries the sensor by tf_static. Raises `InputError`."""
        ways = {pair: tree.between(pair[1], sensor) for pair in pairs}
        carrying = [pair for pair, way in ways.items() if pair[1] == sensor or (way and tree.is_static(way))]
        found = pairs if len(pairs) == 1 else carrying
        if len(found) != 1:
            if not pairs:
                raise InputError("no topic of poses, and no transform above the scans moves; expected --poses FILE")
            listed = ", ".join(f"{world}>{body}" for world, body in pairs)
            raise InputError(f"poses of several frames; expected one of them (--poses 'WORLD>BODY'): {listed}")
        return found[0]

    def _readings(self, tree: Tree, body: str) -> tuple[Imu | None, str]:
        """Inertial readings in the axes of the drone, if a transform relates them; and the source in words."""
        key, *others = [key for key in self.rows if key[0] == self.imu]
        if others:
            raise InputError(
                f"{self.imu}: readings in frames {key[1]}, {others[0][1]}; expected one frame, or --imu none"
            )
        rows = self._of(*key, values=6)
        if not tree.between(body, key[1]) and body != key[1]:
            return None, f"{self.imu} is left out: no transform from {body} to its frame {key[1] or 'without a name'}"
        R_drone_imu = tree.place(body, key[1], rows[:1, 0])[0][0, :3, :3]
        usable = np.isfinite(rows).all(axis=1)
        stamp_s, first = np.unique(rows[usable, 0], return_index=True)
        self.skipped["inertial reading that is not finite or has a repeated stamp"] += len(rows) - len(first)
        force, rate = rows[usable][first, 2:5] @ R_drone_imu.T, rows[usable][first, 5:] @ R_drone_imu.T
        return Imu(stamp_s, force, rate), f"{self.imu}, {len(first)} readings in {key[1]}"

    def _walk(self, frames: ScanFrames, number: IntArray) -> Iterator[Callable[[], Array]]:
        """Decoders of the scans with these increasing numbers."""
        unit_m, wanted = self.options.unit_m, iter(number.tolist())

        def points(raw: Raw, k: int) -> Array:
            if self.camera is None:
                return frames.convert(ros.cloud_points(raw.decode(), unit_m or 1.0), k)
            return frames.convert(ros.depth_points(raw.decode(), self.camera, unit_m), k)

        next_k = next(wanted, -1)
        for k, raw in enumerate(self.bag.messages(self.scans)):
            if k == next_k:
                yield partial(points, raw, k)
                if (next_k := next(wanted, -1)) < 0:
                    return


def _by_stamp(rows: Array) -> Array:
    """Rows of stamp and values, sorted, from rows of stamp, time of recording and values."""
    return np.delete(rows[np.argsort(rows[:, 0], kind="stable")], 1, axis=1)
