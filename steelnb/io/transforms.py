"""Frames of a recording: the tree of tf_static and tf, and the place of each scan on the drone (REP 103, REP 105)."""

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.core.geometry import transform_points
from steelnb.core.types import Array, Trajectory
from steelnb.io.trajectories import interpolate

T_OPTICAL_SENSOR = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
"""Rotation from x forward, y left, z up to optical axes: z forward, x right, y down (REP 103)."""
T_UP_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
"""Rotation between axes with z down (north, east, down; forward, right, down) and those with z up (REP 103)."""
OPTICAL = ("_optical", "_optical_frame")
"""Endings of the names of frames with optical axes; the first is that of REP 103."""
AXES = {True: "z ahead, x right (optical)", False: "x ahead, z up"}
NED = "_ned"
"""Ending of the names of frames with z down (REP 103)."""


class Edge(NamedTuple):
    """A transform from child to parent: its ``path``, whether it ``moves`` along it, else its last pose holds, and
    whether it ``is_static``, of tf_static."""

    path: Trajectory
    moves: bool
    is_static: bool


class Tree:
    """Transforms between frames. A frame may have several parents, such as odom and map."""

    def __init__(self) -> None:
        self._edges: dict[tuple[str, str], Edge] = {}
        self._parents: dict[str, list[str]] = defaultdict(list)
        self._near: dict[str, list[str]] = defaultdict(list)

    def add(self, parent: str, child: str, path: Trajectory, is_static: bool = False) -> None:
        """Add a transform. One that stays, as ROS 1 repeats static ones on tf, does not replace one that moves."""
        moves = not is_static and bool((path.T_world_drone != path.T_world_drone[0]).any())
        if (parent, child) not in self._edges:
            self._parents[child].append(parent)
            self._near[parent].append(child)
            self._near[child].append(parent)
        elif not moves:
            return
        self._edges[parent, child] = Edge(path, moves, is_static)

    @property
    def frames(self) -> set[str]:
        """Names of all frames."""
        return {frame for edge in self._edges for frame in edge}

    def between(self, target: str, source: str) -> list[str]:
        """Frames of the shortest way from ``target`` to ``source``; empty if nothing relates them."""
        return _ways(target, self._near).get(source, [])

    def place(self, target: str, source: str, stamp_s: Array) -> tuple[Array, NDArray[np.bool_]]:
        """``T_target_source (N, 4, 4)`` at some stamps ``(N,)``, and whether the recording covers each ``(N,)``."""
        T, known = np.tile(np.eye(4), (len(stamp_s), 1, 1)), np.ones(len(stamp_s), bool)
        for edge, is_down in self._steps(self.between(target, source)):
            step, covered = interpolate(edge.path, stamp_s) if edge.moves else (edge.path.T_world_drone[-1:], known)
            T, known = T @ (step if is_down else np.linalg.inv(step)), known & covered
        return T, known

    def poses(self, world: str, body: str) -> Trajectory:
        """Poses of ``body`` in ``world`` at the stamps of the fastest transform between them. Raises `InputError`."""
        edges = [edge for edge, _ in self._steps(self.between(world, body))]
        stamps = [edge.path.stamp_s for edge in edges if edge.moves] or [edge.path.stamp_s for edge in edges]
        if not stamps:
            listed = ", ".join(sorted(self.frames)) or "none"
            raise InputError(f"no transforms from {world!r} to {body!r}; expected two frames of tf (--poses): {listed}")
        stamp_s = max(stamps, key=len)
        T, known = self.place(world, body, stamp_s)
        if not known.any():
            raise InputError(f"the transforms from {world} to {body} are never known at the same time")
        return Trajectory(stamp_s[known], T[known])

    def moving_pairs(self, sensor: str) -> list[tuple[str, str]]:
        """World and body of all poses that tf may mean: of frames above ``sensor`` those that a transform moves, each
        in all above it; of all frames if nothing above the sensor moves."""
        pairs = []
        for body in (*_ways(sensor, self._parents), *sorted(self.frames - {sensor})):
            if any(self._edges[parent, body].moves for parent in self._parents[body]):
                pairs += [(world, body) for world in _ways(body, self._parents) if world != body]
        above = {*_ways(sensor, self._parents)}
        pairs = [*dict.fromkeys(pairs)]
        return [pair for pair in pairs if pair[1] in above] or pairs

    def fixed_above(self, sensor: str) -> str:
        """The topmost frame that carries ``sensor`` without moving against it."""
        ways = _ways(sensor, self._parents)
        fixed = [frame for frame, way in ways.items() if not any(edge.moves for edge, _ in self._steps(way))]
        return max(fixed, key=lambda frame: len(ways[frame]))

    def moves(self, frames: Sequence[str]) -> bool:
        """Whether a transform along a way between frames moves."""
        return any(edge.moves for edge, _ in self._steps(frames))

    def is_static(self, frames: Sequence[str]) -> bool:
        """Whether all transforms along a way between frames are from tf_static."""
        return all(edge.is_static for edge, _ in self._steps(frames))

    def _steps(self, frames: Sequence[str]) -> list[tuple[Edge, bool]]:
        """The transforms along a way between frames, and whether the way goes down to the child."""
        pairs = pairwise(frames)
        return [(self._edges[a, b], True) if (a, b) in self._edges else (self._edges[b, a], False) for a, b in pairs]


def _ways(start: str, near: Mapping[str, list[str]]) -> dict[str, list[str]]:
    """Each frame that steps to ``near`` ones of each reach, with the shortest way to it."""
    ways, reached = {start: [start]}, [start]
    for frame in reached:
        new = [each for each in dict.fromkeys(near.get(frame, ())) if each not in ways]
        ways |= {each: [*ways[frame], each] for each in new}
        reached += new
    return ways


class ScanFrames(NamedTuple):
    """Where the scans of a bag are on the drone.

    ``T_drone_sensor (4, 4)``: the mount; ``known (N,)``: whether the transforms cover each scan. A scan is brought to
    the frame of the mount: its optical axes are turned if ``optical (N,)``, then `T_sensor_scan` ``(N, 4, 4)`` is
    applied where it is not the identity, ``moved (N,)``. ``mount`` and ``chain``: source and frames in words.
    """

    T_drone_sensor: Array
    known: NDArray[np.bool_]
    optical: NDArray[np.bool_]
    T_sensor_scan: Array
    moved: NDArray[np.bool_]
    mount: str
    chain: str

    def convert(self, points: Array, number: int) -> Array:
        """Points ``(..., 3)`` of a scan in the frame of the mount."""
        if self.optical[number]:
            points = points @ T_OPTICAL_SENSOR[:3, :3]
        return transform_points(self.T_sensor_scan[number], points) if self.moved[number] else points


def scan_frames(
    tree: Tree, world: str, body: str, frames: Sequence[str], stamp_s: Array, mount: Array | None, is_depth: bool,
    optical: bool | None, T_body_drone: Array,
) -> ScanFrames:  # fmt: skip
    """Where scans in ``frames (N,)`` at ``stamp_s (N,)`` are on the drone's frame ``body``.

    ``mount``: ``T_drone_sensor`` if the user states it, else it comes from tf. ``is_depth``: depth images, whose points
    are in optical axes by the definition of their message, as is their frame. Other frames are optical by their names
    (REP 103). ``optical``: what the user states of the points' axes, of a depth image of those of its frame.
    ``T_body_drone (4, 4)``: of `up_axes`, for points that the poses bring back. Raises `InputError` if nothing relates
    a frame to the drone.
    """
    named, names = np.array(frames, dtype=object), [name for name, _ in Counter(frames).most_common()]
    if mount is not None and len(names) > 1:
        raise InputError(f"scans in frames {', '.join(names)}: one --mount does not hold for all; expected tf_static")
    T_drone_scan, known = np.tile(np.eye(4), (len(frames), 1, 1)), np.ones(len(frames), bool)
    of_frame = {name: (is_depth and optical is not False) or name.endswith(OPTICAL) for name in names}
    of_points = {name: is_depth or (of_frame[name] if optical is None else optical) for name in names}
    for name in names if mount is None else ():
        if not tree.between(body, name) and body != name:
            both = f"poses are of {body or 'a frame without a name'}, scans in {name or 'a frame without a name'}"
            raise InputError(f"{both}, and nothing in tf relates them; expected --mount X,Y,Z,ROLL,PITCH,YAW")
        at = np.flatnonzero(named == name)
        T, known[at] = tree.place(body, name, stamp_s[at])
        if world != body and world in tree.between(body, name):
            T = np.linalg.inv(T_body_drone) @ T
        T_drone_scan[at] = T @ T_OPTICAL_SENSOR if of_frame[name] else T
    way = tree.between(body, names[0]) or [body]
    first = np.flatnonzero((named == names[0]) & known)[:1]
    if mount is not None:
        T_drone_sensor, said = mount, "as stated"
        T_drone_scan[:] = mount
    elif world in way and world != body:
        T_drone_sensor, said = np.eye(4), f"points are in {names[0]}, brought back to {body} by the poses"
    else:
        T_drone_sensor = T_drone_scan[first[0]] if len(first) else np.eye(4)
        said = f"{'tf_static' if tree.is_static(way) else 'tf'} {body} → {names[0]}"
        if tree.moves(way):
            said += ", which moves: that of the first scan"
        elif len(way) == 1:
            said = f"scans are in the frame of the poses, {body}"
    chain = " → ".join([*filter(None, tree.between(world, body)[:-1] or [world]), *way])
    axes = AXES[of_frame[names[0]] if is_depth else of_points[names[0]]]
    others = f"; also in {', '.join(names[1:])}, brought to the first" if names[1:] else ""
    stated = ", as stated" if optical is not None else ", by its message" if is_depth else ", by its name"
    moved = (T_drone_scan != T_drone_sensor).any(axis=(1, 2))
    return ScanFrames(
        T_drone_sensor, known, np.array([of_points[name] for name in frames], bool),
        np.linalg.inv(T_drone_sensor) @ T_drone_scan, moved, said,
        f"{chain}{others}; {'the camera has' if is_depth else 'points have'} {axes}{stated}",
    )  # fmt: skip


def check_mounts(T_stated: Array, T_tf: Array, sigma: tuple[float, float]) -> None:
    """Raise `InputError` if the mount that the user states and that of tf differ by more than ten of the standard
    deviations ``sigma``, degrees and metres; what has 0 is known, whatever tf says."""
    between = np.linalg.inv(T_tf) @ T_stated
    off = math.degrees(Rotation.from_matrix(between[:3, :3]).magnitude()), float(np.linalg.norm(between[:3, 3]))
    if any(0 < 10 * each < difference for each, difference in zip(sigma, off, strict=True)):
        raise InputError(
            f"--mount is {off[0]:.1f}° and {off[1]:.3f} m from that of tf, more than ten times --mount-sigma"
            f" {sigma[0]:g},{sigma[1]:g}; expected no --mount, or a larger --mount-sigma"
        )


def turned_up(poses: Trajectory, world: str, is_stated: bool) -> Trajectory:
    """Poses in a world with z up."""
    T_up_world, T_body_drone = up_axes(world, is_stated)
    return Trajectory(poses.stamp_s, T_up_world @ poses.T_world_drone @ T_body_drone)


def up_axes(world: str, is_stated: bool) -> tuple[Array, Array]:
    """``T_up_world`` and ``T_body_drone``: axes with z up of a world and of its drone. By its name, ``…_ned`` (REP
    103), only the world has z down; if the user states it, the drone's axes are forward, right, down, too."""
    is_named, still = world.endswith(NED), np.eye(4)
    return T_UP_DOWN if is_named or is_stated else still, T_UP_DOWN if is_stated and not is_named else still
