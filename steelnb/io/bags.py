"""Flights recorded in bags: which topics, clocks and frames, and the scans one by one."""

from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.files import damaged
from steelnb.core.types import Array, Imu, IntArray, Trajectory
from steelnb.io import messages as ros
from steelnb.io.cameras import DepthCamera, camera_at, cameras_of
from steelnb.io.clocks import OF_BAG, taken_together
from steelnb.io.containers import Container, LostIndexError
from steelnb.io.frame_names import check_order, is_body_name, is_world_name
from steelnb.io.frames import Frames, drone_axes, sensor_frames, world_axes
from steelnb.io.headers import Headers
from steelnb.io.inertial import readings_of
from steelnb.io.opened import Opened, joined_parts
from steelnb.io.pose_sources import PoseSource, drone_on_tf, pose_source, settled
from steelnb.io.scanning import Raw
from steelnb.io.topics import imu_topics, scan_topic
from steelnb.io.trajectories import check_units, read_trajectory, trajectory_of
from steelnb.io.transforms import Tree, frame_name

BURST_S = 0.1
"""Of the poses within this time, the first tells the unit."""


class Clock(NamedTuple):
    """Which stamps count: those in the messages or, ``by_log``, the times of recording; ``offset_s`` is added to those
    of scans."""

    by_log: bool = False
    offset_s: float = 0.0


def open_bag(
    path: Path, scans: str | None, poses: str | None, imu: str | None, mount: Array | None, clock: Clock
) -> Opened:
    """Open a bag. ``mount``: ``T_drone_sensor`` if the user gives one. Raises `InputError`."""
    container = Container(path)
    while True:
        try:
            return _Bag(container, clock).open(scans, poses, imu, mount)
        except LostIndexError:  # a file fails in the middle, and is scanned from now on
            continue


class _Bag:
    """What follows from the headers of a bag."""

    def __init__(self, container: Container, clock: Clock) -> None:
        self.bag, self.clock, self.headers = container, clock, Headers(container, clock.by_log)

    def open(self, scans: str | None, poses: str | None, imu: str | None, mount: Array | None) -> Opened:
        topic = scan_topic(self.bag, scans)
        is_depth, source = self.bag.types[topic] == ros.IMAGE, pose_source(self.bag, poses, topic)
        imus = imu_topics(self.bag, imu, topic, *source.topics)
        self.headers.read(topic, *source.topics, *source.tf, *imus, *(self.bag.of_type(ros.CAMERA) if is_depth else ()))
        cameras, tree = cameras_of(self.bag, self.headers, topic) if is_depth else [], self.headers.tree()
        stamp_s, log_s = self.headers.scan_stamps(topic)
        stamp_s += self.clock.offset_s
        for frame, text in self.headers.unstamped.items():
            if any(each == frame or tree.between(frame, each) for each in set(self.headers.scan_frames)):
                raise InputError(f"{self.bag.path}: {text}; expected the time of each (--clock bag: of recording)")
        used = [name for name, stamp in zip(self.headers.scan_frames, stamp_s.tolist(), strict=True) if stamp == stamp]
        try:
            sensor = tree.resolve(Counter(used).most_common(1)[0][0])
            source = settled(source, self.headers, tree, sensor)
            prior, world, body, said = self._poses(source, topic, tree, sensor)
            frames = sensor_frames(tree, world, body, self.headers.scan_frames, stamp_s, is_depth, mount)
            if mount is None:
                self._check_placed(topic, tree, world, body, sensor, frames, stamp_s)
        except InputError as fault:
            raise InputError(str(fault) if str(self.bag.path) in str(fault) else f"{self.bag.path}: {fault}") from None
        unplaced = np.isnan(frames.stamp_s) & ~np.isnan(stamp_s)
        self.headers.skipped["scan without a transform to the drone"] += int(unplaced.sum())
        facts = {"scans": f"{topic} ({self.bag.types[topic].rpartition('/')[2]})", "poses": said}
        facts |= {"mount": frames.source, "frames": frames.chain}
        tried, readings = list[str](), None
        for name in imus:
            if readings is None and name in self.headers.frames_of:
                tried, readings = [*tried, name], self._imu(name, topic, tree, body, prior)
        if left := [name for name in self.bag.of_type(ros.IMU) if name not in tried and not imu]:
            self.headers.notes[f"inertial readings of {', '.join(left)} are left out (--imu TOPIC names an IMU)"] = None
        facts |= {"imu": tried[-1]} if readings is not None else {}
        groups = taken_together(frames.stamp_s, log_s, self.headers.scan_frames, self.headers.repeated)
        count = sum(map(len, groups))
        self.headers.skipped["scan message that repeats another one"] += len(stamp_s) - count
        if len(groups) < count:
            self.headers.notes[f"{count} messages are {len(groups)} scans: those of one stamp are one"] = None
        self.headers.notes |= dict.fromkeys(source.notes)
        lost = ["what is whole is read"] if self.bag.notes else []
        notes = [*self.bag.notes, *lost, *self.bag.left_out, *self.headers.notes, *frames.notes]
        facts |= {"notes": "; ".join(notes)} if notes else {}
        walk, first = partial(self._walk, topic, cameras, frames, groups), [group[0] for group in groups]
        return Opened(frames.stamp_s[first], walk, prior, frames.T_drone_sensor, facts, readings, self.headers.skipped)

    def _check_placed(
        self, scans: str, tree: Tree, world: str, body: str, sensor: str, frames: Frames, stamp_s: Array
    ) -> None:
        """Raise `InputError` if no scan has a place on the drone, or if the clock of a transform to it differs."""
        times, of_poses = {"scans": stamp_s[~np.isnan(stamp_s)]}, tree.keys_between(world, body)
        for key in tree.keys_between(body, sensor):
            if key not in of_poses and tree.edges[key].moves and (path := tree.edges[key].path) is not None:
                times[name := f"transforms {key[0]} → {key[1]}"] = path.stamp_s
                self._check_clocks(scans, key, name)
        if np.isnan(frames.stamp_s).all() and len(times) > 1:
            spans = ", ".join(f"{name} from {each.min():.3f} to {each.max():.3f} s" for name, each in times.items())
            remedy = f"expected transforms around each scan, by one clock{OF_BAG}, or --mount"
            raise InputError(f"no scan has a place on the drone at its time: {spans}; {remedy}")

    def _poses(self, source: PoseSource, scans: str, tree: Tree, sensor: str) -> tuple[Trajectory, str, str, str]:
        """Poses of the drone, names of the world and of the drone's frame, and the source in words."""
        world, body, topic = "", "", source.topics[0] if source.topics else ""
        if source.uses_tf:
            try:
                world, body = map(tree.resolve, source.pair or drone_on_tf(tree, sensor, self.headers.notes))
                found = tree.poses(world, body)
            except InputError:
                named = [each for each in source.topics if source.pair in (None, *self.headers.objects(each))]
                if not named:
                    raise
                topic = named[0]
            else:
                for key in tree.keys_between(world, body):
                    self._check_clocks(scans, key)
                return self._turned(found, world, body), world, body, f"tf {world} → {body}"
        if source.file:
            found, said = read_trajectory(source.file, self.headers.skipped), source.file
        elif self.bag.types[topic] == ros.PATH:
            found, world, said = self._path(topic)
        else:
            found, (world, body), said = self._of_topic(topic, source.pair, tree, sensor)
            self._check_clocks(scans, topic)
        child, body = body, tree.resolve(body or tree.body_of(sensor), sensor)
        if child != body and (child or not is_body_name(body)) and tree.between(body, sensor):
            what = f"poses of {child}" if child else "poses"
            self.headers.notes[f"{what} are taken for those of {body}, which carries {sensor}"] = None
        world = world or (sensor if is_world_name(sensor) and sensor not in tree.frames else "")
        if (world := tree.resolve(world)) and world != body and tree.between(world, body) is None:
            tree.add(world, body, found)
            tree.move_still([(world, body)])
        return self._turned(found, world, body), world, body, said

    def _of_topic(
        self, topic: str, pair: tuple[str, str] | None, tree: Tree, sensor: str
    ) -> tuple[Trajectory, tuple[str, str], str]:
        """Poses of the drone on a topic, its world and its frame, and the source in words. Of several objects, the one
        that ``pair`` names is the drone, or it is chosen as among the frames of tf."""
        objects = [*self.headers.objects(topic)]
        if not objects:
            raise self.headers.faults[topic]
        if len(objects) == 1:
            return self._object(topic, objects[0]), check_order(*objects[0]), topic
        if pair:
            found = self._object(topic, pair)
        else:
            body, known = tree.body_of(sensor), tree.fixed()
            poses = {(frame, child or body): self._object(topic, (frame, child)) for frame, child in objects}
            for names, path in poses.items():
                known.add(*names, path)
            pair = drone_on_tf(known, sensor, self.headers.notes)
            found = poses[pair] if pair in poses else known.poses(*pair)
        world, body = pair
        self.headers.notes[f"{topic} has poses of several frames; those of {body} in {world} are used"] = None
        return found, pair, f"{topic} {world} → {body}"

    def _object(self, topic: str, pair: tuple[str, str]) -> Trajectory:
        rows = self.headers.of_object(topic, pair, 7, "pose")
        self.headers.note_jumps(rows, topic)
        return trajectory_of(f"{self.bag.path}: {topic}", rows, self.headers.skipped)

    def _check_clocks(self, scans: str, others: Any, what: str = "poses") -> None:
        if not self.clock.offset_s:
            self.headers.check_clocks(scans, others, what)

    def _turned(self, poses: Trajectory, world: str, body: str) -> Trajectory:
        """Poses of the drone's axes, z up, from those of a frame in a frame of the world."""
        if not self.clock.by_log:  # they may be recorded, or stamped, in bursts
            at = np.unique(np.floor(poses.stamp_s / BURST_S), return_index=True)[1]
            with damaged(self.bag.path, "poses of a drone"):
                check_units(np.column_stack([poses.stamp_s, poses.position])[at], "s")
        T_up_world = world_axes(world)
        if T_up_world[2, 2] < 0:
            self.headers.notes[f"z points down in {world}: the world is turned about its x axis"] = None
        return Trajectory(poses.stamp_s, T_up_world @ poses.T_world_drone @ drone_axes(body))

    def _path(self, topic: str) -> tuple[Trajectory, str, str]:
        """Poses of a Path topic: those of its longest message, and the latest of others: some grow, and others keep
        the latest poses."""
        longest = self.headers.paths.longest
        if self.clock.by_log or longest is None:
            raise InputError(
                f"{topic}: the poses of a Path have only their own stamps; expected another topic of poses"
            )
        rows, own = self.headers.paths.poses(longest)
        found = trajectory_of(f"{self.bag.path}: {topic}", rows, self.headers.skipped)
        more = f" and {len(rows) - own} of others" if len(rows) > own else ""
        world = frame_name(self.bag.decode(longest).header.frame_id)
        return found, world, f"{topic} (the longest Path of it, {own} poses{more})"

    def _imu(self, topic: str, scans: str, tree: Tree, body: str, poses: Trajectory) -> Imu | None:
        """Inertial samples in the axes of the drone, if a transform relates them; None if none is of use."""
        pair, *others = self.headers.objects(topic)
        rows, frame = self.headers.of_object(topic, pair, 6, "inertial sample"), pair[0]
        if others:
            self.headers.notes[f"{topic} has readings of several frames; those of {frame} are used"] = None
        place = tree.place(body, tree.resolve(frame, body), rows[:1, 0])
        T_drone_imu = drone_axes(frame).T if place is None else drone_axes(body).T @ place.T_target_source[0]
        found = readings_of(rows, T_drone_imu[:3, :3], topic, poses, self.headers.notes, self.headers.skipped)
        if found is not None and place is None:
            note = f"no transform from {body} to {frame or 'the IMU'}: its axes are taken from its name"
            self.headers.notes[note] = None
        try:
            if found is not None:
                self._check_clocks(scans, topic, "inertial readings")
        except InputError as fault:
            self.headers.notes[f"inertial readings of {topic} are left out: {fault}"] = None
            return None
        return found

    def _walk(
        self, topic: str, cameras: list[DepthCamera], frames: Frames, groups: list[list[int]], number: IntArray
    ) -> Iterator[Callable[[], Array]]:
        """Decoders of the scans with these increasing numbers; ``groups``: numbers of the messages of each."""
        selected = [groups[k] for k in number.tolist()]
        ends, parts = {group[-1] for group in selected}, list[Callable[[], Array]]()
        wanted, last = {k for group in selected for k in group}, max(ends, default=-1)

        def points(raw: Raw, k: int) -> Array:
            message = self.bag.decode(raw)
            if not cameras:
                return frames.convert(ros.cloud_points(message), k)
            camera = camera_at(cameras, frame_name(message.header.frame_id), self.headers.times(raw, message)[0])
            return frames.convert(ros.depth_points(message, camera), k)

        for k, raw in enumerate(self.bag.messages(topic)):
            if k in wanted:
                parts.append(partial(points, raw, k))
            if k in ends:
                yield partial(joined_parts, parts)
                parts = []
            if k >= last:
                return
