"""Flights recorded in bags: which topics, clocks and frames, and the scans one by one."""

from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array, Imu, IntArray, Trajectory
from steelnb.io import messages as ros
from steelnb.io.clocks import far_stamps, rising_stamps
from steelnb.io.containers import Container, LostIndexError
from steelnb.io.frames import Frames, drone_axes, sensor_frames
from steelnb.io.scanning import Raw
from steelnb.io.topics import PoseSource, camera_topic, pose_source, scan_topic
from steelnb.io.trajectories import read_trajectory, trajectory_of
from steelnb.io.transforms import Tree, is_world_name


class Clock(NamedTuple):
    """Which stamps count: those in the messages or, ``by_log``, the times of recording; ``offset_s`` is added to those
    of scans."""

    by_log: bool = False
    offset_s: float = 0.0


class OpenedBag(NamedTuple):
    """``stamp_s (N,)`` of all scans, NaN of those that are not used; ``walk`` over their decoders; poses of the drone,
    ``T_drone_sensor (4, 4)``, what a `Flight` tells, and counts of what was skipped."""

    stamp_s: Array
    walk: Callable[[IntArray], Iterator[Callable[[], Array]]]
    prior: Trajectory
    T_drone_sensor: Array
    facts: dict[str, str]
    imu: Imu | None
    skipped: Counter[str]


def open_bag(path: Path, scans: str | None, poses: str | None, mount: Array | None, clock: Clock) -> OpenedBag:
    """Open a bag. ``mount``: ``T_drone_sensor`` if the user gives one. Raises `InputError`."""
    container = Container(path)
    while True:
        try:
            return _Bag(container, clock).open(scans, poses, mount)
        except LostIndexError:  # a file fails in the middle, and is scanned from now on
            continue


class _Bag:
    """One pass over the small messages and the headers of the scans, and what follows from it."""

    def __init__(self, container: Container, clock: Clock) -> None:
        self.bag, self.clock, self.skipped = container, clock, Counter[str]()
        self.notes: dict[str, None] = {}
        self.faults: dict[str, InputError] = {}
        self.rows: dict[Any, array[float]] = defaultdict(lambda: array("d"))
        self.frame_of: dict[str, tuple[str, str]] = {}
        self.scan_frames: list[str] = []
        self.cameras: dict[str, ros.CameraInfo] = {}
        self.shape: tuple[int, int] | None = None
        self.longest: Raw | None = None

    def open(self, scans: str | None, poses: str | None, mount: Array | None) -> OpenedBag:
        topic, imus = scan_topic(self.bag, scans), self.bag.of_type(ros.IMU)[:1]
        is_depth = self.bag.types[topic] == ros.IMAGE
        source = pose_source(self.bag, poses, topic)
        self._read(topic, *source.topics, *source.tf, *imus, *(self.bag.of_type(ros.CAMERA) if is_depth else ()))
        camera, tree, stamp_s = self._camera(topic) if is_depth else None, self._tree(), self._scan_stamps(topic)
        used = [name for name, stamp in zip(self.scan_frames, stamp_s.tolist(), strict=True) if stamp == stamp]
        try:
            prior, world, body, said = self._poses(source, tree, tree.resolve(Counter(used).most_common(1)[0][0]))
            frames = sensor_frames(tree, world, body, self.scan_frames, stamp_s, is_depth, mount)
        except InputError as fault:
            raise InputError(str(fault) if str(self.bag.path) in str(fault) else f"{self.bag.path}: {fault}") from None
        unplaced = np.isnan(frames.stamp_s) & ~np.isnan(stamp_s)
        self.skipped["scan without a transform to the drone"] += int(unplaced.sum())
        facts = {"scans": f"{topic} ({self.bag.types[topic].rpartition('/')[2]})", "poses": said}
        facts |= {"mount": frames.source, "frames": frames.chain} | ({"imu": imus[0]} if imus else {})
        lost = ["what is whole is read"] if self.bag.notes else []
        notes = [*self.bag.notes, *lost, *self.notes, *frames.notes]
        facts |= {"notes": "; ".join(notes)} if notes else {}
        imu = self._imu(imus[0], tree, body) if imus else None
        walk = partial(self._walk, topic, camera, frames)
        return OpenedBag(frames.stamp_s, walk, prior, frames.T_drone_sensor, facts, imu, self.skipped)

    def _read(self, scans: str, *others: str) -> None:
        """Store the values of small messages, and stamps and frames of the scans. Raises `InputError`."""
        for raw in self.bag.messages(scans, *others):
            if raw.kind == ros.PATH:  # decoding each message of a path that grows takes the square of its length
                self.longest = raw if self.longest is None or len(raw.data) >= len(self.longest.data) else self.longest
                continue
            try:
                self._store(raw, self.bag.decode(raw), raw.topic == scans)
            except InputError as fault:
                self.faults.setdefault(raw.topic, fault)
                self.skipped[f"{raw.kind.rpartition('/')[2]} message that cannot be decoded"] += 1
                if raw.topic == scans:  # it keeps its number
                    self.rows[scans].extend((np.nan, raw.log_ns / 1e9))
                    self.scan_frames.append("")
        if np.isnan(self.rows[scans][::2]).all():
            raise self.faults.get(scans) or InputError(
                f"{self.bag.path}: no message of {scans} can be read ({'; '.join(self.bag.notes)})"
            )

    def _store(self, raw: Raw, message: Any, is_scan: bool) -> None:
        if raw.kind in ros.TF:
            for each in message.transforms:
                key = _frame(each.header.frame_id), _frame(each.child_frame_id), raw.topic.endswith("tf_static")
                self.rows[key].extend((*self._times(raw, each), *ros.pose_numbers(each, ros.TRANSFORM)))
            return
        frame = _frame(message.header.frame_id)
        self.frame_of[raw.topic] = frame, _frame(getattr(message, "child_frame_id", ""))
        if raw.kind == ros.CAMERA:
            self.cameras[raw.topic] = ros.camera_of(message)
            return
        self.rows[raw.topic].extend(self._times(raw, message))
        if is_scan:
            self.scan_frames.append(frame)
            self._look_at(message, raw.kind)
        elif raw.kind == ros.IMU:
            self.rows[raw.topic].extend(ros.numbers(message.linear_acceleration, message.angular_velocity))
        else:
            self.rows[raw.topic].extend(ros.pose_numbers(message, raw.kind))

    def _times(self, raw: Raw, message: Any) -> tuple[float, float]:
        """The stamp that counts and the time of recording, seconds."""
        log_s = raw.log_ns / 1e9
        return log_s if self.clock.by_log else ros.stamp_of(message), log_s

    def _look_at(self, message: Any, kind: str) -> None:
        """Note what contradicts a scan's message. A fault is that of the scan, when it is read."""
        try:
            layout = ros.cloud_layout(message) if kind == ros.CLOUD else ros.depth_layout(message)
        except InputError:
            return
        self.shape = self.shape or layout.shape
        self.notes |= dict.fromkeys(layout.notes)

    def _rows(self, key: Any, values: int, what: str) -> Array:
        """Rows of stamp and values of messages whose stamps are right."""
        rows = np.array(self.rows[key]).reshape(-1, values + 2)
        far = far_stamps(rows[:, 0], rows[:, 1])
        rising = rising_stamps(rows[~far, 0], strictly=False)
        self.skipped[f"{what} whose stamp is far from the time of recording"] += int(far.sum())
        self.skipped[f"{what} whose stamp does not rise"] += int((~far).sum()) - len(rising)
        return np.delete(rows[~far][rising], 1, axis=1)

    def _scan_stamps(self, topic: str) -> Array:
        """Stamps of all scans, NaN where they are wrong."""
        rows = np.array(self.rows[topic]).reshape(-1, 2)
        known = np.flatnonzero(~np.isnan(rows[:, 0]))
        far = known[far_stamps(*rows[known].T)]
        if len(far):
            first = "{:.3f} s, recorded at {:.3f} s".format(*rows[far[0]])
            self.skipped[f"scan whose stamp is far from the time of recording (the first: {first})"] = len(far)
        rows[far, 0] = np.nan
        return rows[:, 0] + self.clock.offset_s

    def _tree(self) -> Tree:
        tree = Tree()
        for key in [key for key in self.rows if isinstance(key, tuple)]:
            parent, child, is_static = key
            rows = self._rows(key, 7, "transform")
            if is_static:  # has no stamp that counts, and the last is valid
                rows = np.array(self.rows[key]).reshape(-1, 9)[-1:, [0, *range(2, 9)]]
            try:
                tree.add(parent, child, trajectory_of(self.bag.path, rows, self.skipped), is_static)
            except InputError:
                self.notes[f"no transform {parent} → {child} is valid"] = None
        return tree

    def _poses(self, source: PoseSource, tree: Tree, sensor: str) -> tuple[Trajectory, str, str, str]:
        """Poses of the drone, names of the world and of the drone's frame, and the source in words."""
        world, body, topic = "", "", source.topics[0] if source.topics else ""
        if source.uses_tf:
            try:
                world, body = map(tree.resolve, source.pair or tree.drone(sensor))
                return _turned(tree.poses(world, body), body), world, body, f"tf {world} → {body}"
            except InputError:
                if not topic:
                    raise
        if source.file:
            found, said = read_trajectory(source.file, self.skipped), source.file
        elif self.bag.types[topic] == ros.PATH:
            found, world, said = self._path(topic)
        elif topic in self.frame_of:
            (world, body), said = self.frame_of[topic], topic
            found = trajectory_of(self.bag.path, self._rows(topic, 7, "pose"), self.skipped)
        else:
            raise self.faults[topic]
        body = tree.resolve(body) or tree.body_of(sensor)
        if not world and is_world_name(sensor) and sensor not in tree.frames:
            world = sensor
        world = tree.resolve(world)
        if world and world != body and tree.between(world, body) is None:
            tree.add(world, body, found)
            tree.move_still([(world, body)])
        return _turned(found, body), world, body, said

    def _path(self, topic: str) -> tuple[Trajectory, str, str]:
        """Poses of a Path topic: those of its longest message, as some grow and others keep the latest poses."""
        if self.clock.by_log or self.longest is None:
            raise InputError(
                f"{topic}: the poses of a Path have only their own stamps; expected another topic of poses"
            )
        message = self.bag.decode(self.longest)
        rows = [(ros.stamp_of(each), *ros.pose_numbers(each, ros.POSE_STAMPED)) for each in message.poses]
        found = trajectory_of(self.bag.path, np.array(rows, dtype=float).reshape(-1, 8), self.skipped)
        return found, _frame(message.header.frame_id), f"{topic} (the longest Path of it, {len(rows)} poses)"

    def _camera(self, topic: str) -> ros.CameraInfo:
        """The camera of depth images, and a note if its size is not theirs."""
        camera = self.cameras[camera_topic(self.bag, topic, list(self.cameras))]
        if self.shape is not None:
            with suppress(InputError):  # it is the fault of each scan
                self.notes |= dict.fromkeys(filter(None, ros.camera_matrix(camera, *self.shape)[1:]))
        return camera

    def _imu(self, topic: str, tree: Tree, body: str) -> Imu:
        """Inertial samples with increasing stamps, in the axes of the drone if a transform relates them."""
        rows = self._rows(topic, 6, "inertial sample")
        rows = rows[np.isfinite(rows).all(axis=1)]
        rows = rows[rising_stamps(rows[:, 0])]
        place = tree.place(body, tree.resolve(self.frame_of[topic][0]), rows[:1, 0])
        T_drone_imu = np.eye(4) if place is None else drone_axes(body).T @ place.T_target_source[0]
        R_drone_imu = T_drone_imu[:3, :3]
        return Imu(rows[:, 0], rows[:, 1:4] @ R_drone_imu.T, rows[:, 4:] @ R_drone_imu.T)

    def _walk(
        self, topic: str, camera: ros.CameraInfo | None, frames: Frames, number: IntArray
    ) -> Iterator[Callable[[], Array]]:
        """Decoders of the scans with these increasing numbers."""
        selected, last = set(number.tolist()), int(number.max(initial=-1))

        def points(raw: Raw, k: int) -> Array:
            message = self.bag.decode(raw)
            found = ros.cloud_points(message) if camera is None else ros.depth_points(message, camera)
            return frames.convert(found, k)

        for k, raw in enumerate(self.bag.messages(topic)):
            if k in selected:
                yield partial(points, raw, k)
            if k >= last:
                return


def _turned(poses: Trajectory, body: str) -> Trajectory:
    """Poses of the drone's axes from those of a frame, which may be optical."""
    return Trajectory(poses.stamp_s, poses.T_world_drone @ drone_axes(body))


def _frame(name: str) -> str:
    return name.lstrip("/")
