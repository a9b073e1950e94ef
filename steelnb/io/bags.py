"""Flights recorded in bags: which topics, clocks and frames, and the scans one by one."""

from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.files import damaged
from steelnb.core.types import Array, Imu, IntArray, Trajectory
from steelnb.io import messages as ros
from steelnb.io.cameras import DepthCamera, camera_at, cameras_of
from steelnb.io.clocks import OF_BAG, Clock, taken_together
from steelnb.io.containers import Container, LostIndexError
from steelnb.io.frame_names import check_order, is_body_name, is_world_name
from steelnb.io.frames import Frames, drone_axes, sensor_frames, world_axes
from steelnb.io.headers import Headers, Pair
from steelnb.io.inertial import readings_of
from steelnb.io.opened import Opened
from steelnb.io.pose_sources import drone_on_tf, pose_source, settled
from steelnb.io.scanning import Raw
from steelnb.io.topics import imu_topics, scan_topic
from steelnb.io.trajectories import check_units, read_trajectory, trajectory_of
from steelnb.io.transforms import Tree, frame_name

BURST_S = 0.1
"""Of the poses within this time, the first tells the unit."""


def open_bag(
    path: Path, scans: str | None, poses: str | None, imu: str | None, mount: Array | None, clock: Clock
) -> Opened:
    """Open a bag. ``mount``: ``T_drone_sensor`` if the user gives one. Raises `InputError`."""
    try:
        container = Container(path)
        while True:
            try:
                return _Bag(container, clock, scans, poses).open(imu, mount)
            except LostIndexError:  # a file fails in the middle, and is scanned from now on
                continue
    except InputError as fault:
        text = str(fault)
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None


class _Bag:
    """What follows from the headers of a bag: of the ``topic`` of the scans, in the frame ``sensor``, and of the
    ``source`` of the poses."""

    def __init__(self, container: Container, clock: Clock, scans: str | None, poses: str | None) -> None:
        self.bag, self.clock, self.headers = container, clock, Headers(container, clock)
        self.topic, self.tree, self.sensor = scan_topic(self.bag, scans), Tree(), ""
        self.source = pose_source(self.bag, poses, self.topic)
        self.note = self.headers.note

    def open(self, imu: str | None, mount: Array | None) -> Opened:
        bag, headers, topic, source = self.bag, self.headers, self.topic, self.source
        is_depth, imus = bag.types[topic] == ros.IMAGE, imu_topics(bag, imu, topic, *source.topics)
        headers.read(topic, *source.topics, *source.tf, *imus, *(bag.of_type(ros.CAMERA) if is_depth else ()))
        cameras = cameras_of(bag, headers, topic) if is_depth else []
        self.tree = tree = headers.tree()
        stamp_s, log_s = headers.scan_stamps(topic)
        for frame, text in headers.unstamped.items():
            if any(each == frame or tree.between(frame, each) for each in set(headers.scan_frames)):
                raise InputError(f"{text}; expected the time of each (--clock bag: of recording)")
        used = [name for name, stamp in zip(headers.scan_frames, stamp_s.tolist(), strict=True) if stamp == stamp]
        self.sensor = tree.resolve(Counter(used).most_common(1)[0][0])
        self.source = source = settled(source, headers, tree, self.sensor)
        prior, world, body, said = self._poses()
        frames = sensor_frames(tree, world, body, headers.scan_frames, stamp_s, is_depth, mount)
        if mount is None:
            self._check_placed(world, body, frames, stamp_s)
        unplaced = np.isnan(frames.stamp_s) & ~np.isnan(stamp_s)
        headers.skipped["scan without a transform to the drone"] += int(unplaced.sum())
        facts = {"scans": f"{topic} ({bag.types[topic].rpartition('/')[2]})", "poses": said}
        facts |= {"mount": frames.source, "frames": frames.chain}
        tried, readings = list[str](), None
        for name in imus:
            if readings is None and name in headers.frames_of:
                tried, readings = [*tried, name], self._imu(name, body, prior)
        if left := [name for name in bag.of_type(ros.IMU) if name not in tried and not imu]:
            self.note(f"inertial readings of {', '.join(left)} are left out (--imu TOPIC names an IMU)")
        facts |= {"imu": tried[-1]} if readings is not None else {}
        groups = taken_together(frames.stamp_s, log_s, headers.scan_frames, headers.repeated)
        count = sum(map(len, groups))
        headers.skipped["scan message that repeats another one"] += len(stamp_s) - count
        if len(groups) < count:
            self.note(f"{count} messages are {len(groups)} scans: those of one stamp are one")
        self.note(*source.notes)
        lost = ["what is whole is read"] if bag.notes else []
        notes = [*bag.notes, *lost, *bag.left_out, *headers.notes, *frames.notes]
        facts |= {"notes": "; ".join(notes)} if notes else {}
        walk, first = partial(self._walk, cameras, frames, groups), [group[0] for group in groups]
        return Opened(frames.stamp_s[first], walk, prior, frames.T_drone_sensor, facts, readings, headers.skipped)

    def _check_placed(self, world: str, body: str, frames: Frames, stamp_s: Array) -> None:
        """Raise `InputError` if no scan has a place on the drone, or if the clock of a transform to it differs."""
        times, of_poses = {"scans": stamp_s[~np.isnan(stamp_s)]}, self.tree.keys_between(world, body)
        for key in self.tree.keys_between(body, self.sensor):
            edge = self.tree.edges[key]
            if key not in of_poses and edge.moves:
                times[name := f"transforms {key[0]} → {key[1]}"] = edge.path.stamp_s
                self.headers.check_clocks(self.topic, key, name)
        if np.isnan(frames.stamp_s).all() and len(times) > 1:
            spans = ", ".join(f"{name} from {each.min():.3f} to {each.max():.3f} s" for name, each in times.items())
            remedy = f"expected transforms around each scan, by one clock{OF_BAG}, or --mount"
            raise InputError(f"no scan has a place on the drone at its time: {spans}; {remedy}")

    def _poses(self) -> tuple[Trajectory, str, str, str]:
        """Poses of the drone, names of the world and of the drone's frame, and the source in words."""
        source, tree, sensor = self.source, self.tree, self.sensor
        world, body, topic = "", "", source.topics[0] if source.topics else ""
        if source.uses_tf:
            try:
                world, body = map(tree.resolve, source.pair or drone_on_tf(tree, sensor, self.note))
                found = tree.poses(world, body)
            except InputError:
                named = [each for each in source.topics if source.pair in (None, *self.headers.objects(each))]
                if not named:
                    raise
                topic = named[0]
            else:
                for key in tree.keys_between(world, body):
                    self.headers.check_clocks(self.topic, key)
                return self._turned(found, world, body), world, body, f"tf {world} → {body}"
        if source.file:
            found, said = read_trajectory(source.file, self.headers.skipped), source.file
        elif self.bag.types[topic] == ros.PATH:
            found, world, said = self._path(topic)
        else:
            found, (world, body), said = self._of_topic(topic)
            self.headers.check_clocks(self.topic, topic)
        child, body = body, tree.resolve(body or tree.body_of(sensor), sensor)
        if child != body and (child or not is_body_name(body)) and tree.between(body, sensor):
            self.note(f"poses{child and f' of {child}'} are taken for those of {body}, which carries {sensor}")
        world = world or (sensor if is_world_name(sensor) and sensor not in tree.frames else "")
        if (world := tree.resolve(world)) and world != body and tree.between(world, body) is None:
            tree.add(world, body, found)
            tree.move_still([(world, body)])
        return self._turned(found, world, body), world, body, said

    def _of_topic(self, topic: str) -> tuple[Trajectory, Pair, str]:
        """Poses of the drone on a topic, its world and its frame, and the source in words. Of several objects, the one
        that the user names is the drone, or it is chosen as among the frames of tf."""
        objects, pair = [*self.headers.objects(topic)], self.source.pair
        if not objects:
            raise self.headers.fault_of(topic)
        if len(objects) == 1:
            return self._object(topic, objects[0]), check_order(*objects[0]), topic
        if pair:
            found = self._object(topic, pair)
        else:
            body, known = self.tree.body_of(self.sensor), self.tree.fixed()
            poses = {(frame, child or body): self._object(topic, (frame, child)) for frame, child in objects}
            for names, path in poses.items():
                known.add(*names, path)
            pair = drone_on_tf(known, self.sensor, self.note)
            found = poses[pair] if pair in poses else known.poses(*pair)
        world, body = pair
        self.note(f"{topic} has poses of several frames; those of {body} in {world} are used")
        return found, pair, f"{topic} {world} → {body}"

    def _object(self, topic: str, pair: Pair) -> Trajectory:
        rows = self.headers.of_object(topic, pair, 7, "pose")
        self.headers.note_jumps(rows, topic)
        return trajectory_of(f"{self.bag.path}: {topic}", rows, self.headers.skipped)

    def _turned(self, poses: Trajectory, world: str, body: str) -> Trajectory:
        """Poses of the drone's axes, z up, from those of a frame in a frame of the world."""
        if not self.clock.by_log:  # they may be recorded, or stamped, in bursts
            at = np.unique(np.floor(poses.stamp_s / BURST_S), return_index=True)[1]
            with damaged(self.bag.path, "poses of a drone"):
                check_units(np.column_stack([poses.stamp_s, poses.position])[at], "s")
        T_up_world = world_axes(world)
        if T_up_world[2, 2] < 0:
            self.note(f"z points down in {world}: the world is turned about its x axis")
        return Trajectory(poses.stamp_s, T_up_world @ poses.T_world_drone @ drone_axes(body))

    def _path(self, topic: str) -> tuple[Trajectory, str, str]:
        """Poses of a Path topic: those of its longest message, and the latest of others: some grow, and others keep
        the latest poses."""
        longest = self.headers.paths.longest
        if self.clock.by_log or longest is None:
            own_stamps = "the poses of a Path have only their own stamps"
            raise InputError(f"{topic}: {own_stamps}; expected another topic of poses")
        rows, own = self.headers.paths.poses(longest)
        found = trajectory_of(f"{self.bag.path}: {topic}", rows, self.headers.skipped)
        more = f" and {len(rows) - own} of others" if len(rows) > own else ""
        world = frame_name(self.bag.decode(longest).header.frame_id)
        return found, world, f"{topic} (the longest Path of it, {own} poses{more})"

    def _imu(self, topic: str, body: str, poses: Trajectory) -> Imu | None:
        """Inertial samples in the axes of the drone, if a transform relates them; None if none is of use."""
        pair, *others = self.headers.objects(topic)
        rows, frame = self.headers.of_object(topic, pair, 6, "inertial sample"), pair[0]
        if others:
            self.note(f"{topic} has readings of several frames; those of {frame} are used")
        place = self.tree.place(body, self.tree.resolve(frame, body), rows[:1, 0])
        T_drone_imu = drone_axes(frame).T if place is None else drone_axes(body).T @ place.T_target_source[0]
        found = readings_of(rows, T_drone_imu[:3, :3], topic, poses, self.note, self.headers.skipped)
        if found is not None and place is None:
            self.note(f"no transform from {body} to {frame or 'the IMU'}: its axes are taken from its name")
        try:
            if found is not None:
                self.headers.check_clocks(self.topic, topic, "inertial readings")
        except InputError as fault:
            self.note(f"inertial readings of {topic} are left out: {fault}")
            return None
        return found

    def _walk(
        self, cameras: list[DepthCamera], frames: Frames, groups: list[list[int]], number: IntArray
    ) -> Iterator[Callable[[], Array]]:
        """Decoders of the scans with these increasing numbers; ``groups``: numbers of the messages of each."""
        scan_of = {k: each for each in number.tolist() for k in groups[each]}
        last = max(scan_of, default=-1)

        def points(raw: Raw, k: int) -> Array:
            message = self.bag.decode(raw)
            if not cameras:
                return frames.convert(ros.cloud_points(message), k)
            camera = camera_at(cameras, frame_name(message.header.frame_id), self.headers.times(raw, message)[0])
            return frames.convert(ros.depth_points(message, camera), k)

        parts = list[Callable[[], Array]]()
        for k, raw in enumerate(self.bag.messages(self.topic)):
            if k in scan_of:
                parts.append(partial(points, raw, k))
                if k == groups[scan_of[k]][-1]:
                    yield partial(joined_parts, parts)
                    parts = []
            if k >= last:
                return


def joined_parts(parts: list[Callable[[], Array]]) -> Array:
    """The points of all parts of a scan that can be read. Raises `InputError` if there are none."""
    if len(parts) == 1:
        return parts[0]()
    found, faults = list[Array](), list[InputError]()
    for part in parts:
        try:
            found.append(part().reshape(-1, 3))
        except InputError as fault:
            faults.append(fault)
    if not found:
        raise faults[0]
    return np.concatenate(found)
