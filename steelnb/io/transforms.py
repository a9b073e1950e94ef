"""The tree of frames of a recording, from tf_static and tf: relations of frames over time, and the drone's frames."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steelnb.core.errors import InputError
from steelnb.core.files import printable
from steelnb.core.types import Array, Trajectory
from steelnb.io import frame_names as naming
from steelnb.io.trajectories import interpolate

STILL = 1e-6
"""A transform on tf that varies by less is static: ROS 1 repeats static ones there, some in single precision."""

AGREED = 0.01
"""Two ways between frames agree if their transforms differ by less, in metres and radians."""


class Link(NamedTuple):
    """A transform: of tf_static if ``is_static``, else of tf."""

    parent: str
    child: str
    is_static: bool


class Edge(NamedTuple):
    """A transform from child to parent: its ``path``, whether it ``moves`` along it, else its last pose holds, and
    whether it ``is_static``, of tf_static."""

    path: Trajectory
    moves: bool
    is_static: bool


class Placement(NamedTuple):
    """``T_target_source (N, 4, 4)`` at some stamps, and whether the recording covers each ``(N,)``; ``frames`` from
    target to source; ``moves``: whether a transform between them does."""

    T_target_source: Array
    known: NDArray[np.bool_]
    frames: tuple[str, ...]
    moves: bool


class Tree:
    """Transforms between frames. A frame may have several parents, such as odom and map."""

    def __init__(self, edges: Mapping[tuple[str, str], Edge] | None = None) -> None:
        self.edges: dict[tuple[str, str], Edge] = {}
        self._parents: dict[str, list[str]] = defaultdict(list)
        self._near: dict[str, list[str]] = defaultdict(list)
        for key, edge in (edges or {}).items():
            self._set(key, edge)

    def add(self, parent: str, child: str, path: Trajectory, is_static: bool = False) -> None:
        """Add a transform at some stamps, the last of which counts if it is static."""
        moves = not is_static and bool(np.ptp(path.T_world_drone, axis=0).max() > STILL)
        if moves or (parent, child) not in self.edges:
            self._set((parent, child), Edge(path, moves, is_static))

    def _set(self, key: tuple[str, str], edge: Edge) -> None:
        if key not in self.edges:
            parent, child = key
            self._parents[child].append(parent)
            self._near[parent].append(child)
            self._near[child].append(parent)
        self.edges[key] = edge

    def fixed(self) -> "Tree":
        """A tree of those of tf_static."""
        return Tree({key: edge for key, edge in self.edges.items() if edge.is_static})

    @property
    def frames(self) -> set[str]:
        """Names of all frames."""
        return {frame for edge in self.edges for frame in edge}

    def resolve(self, frame: str, beside: str = "") -> str:
        """The frame of this name or, if there is none, the only one of this name in a namespace or without one; of
        several the one in the namespace of ``beside``."""
        same = [each for each in self.frames if naming.own_name(each) == naming.own_name(frame)]
        near = [each for each in same if beside and naming.namespace(each) == naming.namespace(beside)] or same
        return near[0] if frame not in self.frames and len(near) == 1 and frame else frame

    def between(self, target: str, source: str) -> list[str] | None:
        """Frames of the shortest way from ``target`` to ``source``, or None if nothing relates them."""
        return _ways(target, self._near).get(source)

    def moves(self, frames: Sequence[str]) -> bool:
        """Whether a transform along a way between frames moves."""
        return any(self.edges[key].moves for key, _ in self._steps(frames))

    def is_static(self, frames: Sequence[str]) -> bool:
        """Whether all transforms along a way between frames are from tf_static."""
        return all(self.edges[key].is_static for key, _ in self._steps(frames))

    def contradictions(self, target: str, source: str) -> Iterator[tuple[tuple[str, ...], Array]]:
        """Other static ways from ``target`` to ``source``, without one transform of the shortest, that lead to another
        place, and ``T_shortest_other (4, 4)``."""
        fixed = self.fixed()
        found = fixed.place(target, source, np.zeros(1))
        for key, _ in self._steps(found.frames if found else ()):
            rest = Tree({each: edge for each, edge in fixed.edges.items() if each != key})
            other = rest.place(target, source, np.zeros(1))
            if found is not None and other is not None:
                T = (np.linalg.inv(found.T_target_source) @ other.T_target_source)[0]
                if np.abs(T - np.eye(4)).max() > AGREED:
                    yield other.frames, T

    def place(self, target: str, source: str, stamp_s: Array) -> Placement | None:
        """Where ``source`` is in ``target`` at some stamps ``(N,)``, or None if nothing relates them."""
        frames = self.between(target, source)
        if frames is None:
            return None
        T, known = np.tile(np.eye(4), (len(stamp_s), 1, 1)), np.ones(len(stamp_s), bool)
        for key, is_down in self._steps(frames):
            edge = self.edges[key]
            step, covered = interpolate(edge.path, stamp_s) if edge.moves else (edge.path.T_world_drone[-1:], known)
            T, known = T @ (step if is_down else np.linalg.inv(step)), known & covered
        return Placement(T, known, tuple(frames), self.moves(frames))

    def poses(self, world: str, body: str) -> Trajectory:
        """Poses of ``body`` in ``world`` at the stamps of the fastest transform between them that moves."""
        keys = self.keys_between(world, body)
        self.move_still(keys)
        moving = [edge.path.stamp_s for key in keys if (edge := self.edges[key]).moves]
        if not moving:
            listed = ", ".join(sorted(self.frames)) or "none"
            raise InputError(f"no poses of {body!r} in {world!r} on tf; expected two of its frames: {listed}")
        found = self.place(world, body, max(moving, key=len))
        assert found is not None
        if not found.known.any():
            raise InputError(f"the transforms from {world} to {body} are never known at the same time")
        return Trajectory(max(moving, key=len)[found.known], found.T_target_source[found.known])

    def drone(self, sensor: str) -> tuple[str, str]:
        """Names of the world and of the drone's frame that carries ``sensor``. Raises `InputError` with the choices."""
        self.move_still([key for key in self.edges if naming.is_world_name(key[0])])
        bodies = self._moving(self.above(sensor)) or self._moving(self.frames)
        if not bodies:
            raise InputError("no transform on tf moves; expected one from the world to the drone")
        if names := [name for name in naming.BODIES if name in {*map(naming.own_name, bodies)}]:
            bodies = [body for body in bodies if naming.own_name(body) == names[0]]
        else:  # a frame that moves itself, not one fixed to it, and no odom below a map
            bodies = [body for body in bodies if any(self.edges[each, body].moves for each in self._parents[body])]
            bodies = [body for body in bodies if not naming.is_world_name(body)] or bodies
        beside = [body for body in bodies if naming.namespace(body) == naming.namespace(sensor)]
        bodies = beside or bodies
        choices = [naming.check_order(world, body) for body in bodies for world in self._worlds(self.above(body))]
        if all(naming.is_inverted(*pair) for pair in choices):
            choices = self._inverted(sensor) or choices
        if len(choices) == 1:
            return choices[0]
        listed = [f"{world}>{body}" for world, body in sorted(choices)]
        several = f"several frames may be the drone's: {', '.join(listed)}"
        raise InputError(f"{several}; expected one (--poses '{listed[0]}')")

    def _moving(self, frames: Iterable[str]) -> list[str]:
        """Those of some frames that move in one above them."""
        return [frame for frame in frames if any(self.moves(way) for way in self.above(frame).values())]

    def _inverted(self, sensor: str) -> list[tuple[str, str]]:
        """World and drone of each moving transform that leads down to a world, away from the sensor: of worlds with a
        usual name or, if there is none, of all below a drone with a usual name."""
        ways = _ways(sensor, self._near)
        moving = [(world, body) for (body, world), edge in self.edges.items() if edge.moves]
        found = [(world, body) for world, body in moving if naming.is_inverted(body, world)]
        found = [(world, body) for world, body in found if world not in ways.get(body, [world])]
        return [pair for pair in found if naming.is_world_name(pair[0])] or found

    def body_of(self, sensor: str) -> str:
        """The frame with a drone's usual name that carries ``sensor``, else the topmost one to which it is fixed; the
        first such name if it has no place."""
        above = self.above(sensor)
        if named := [frame for frame in above if naming.is_body_name(frame)]:
            return min(named, key=lambda frame: naming.BODIES.index(naming.own_name(frame)))
        fixed = [frame for frame, way in above.items() if not naming.is_world_name(frame) and not self.moves(way)]
        return max(fixed, key=lambda frame: len(above[frame])) if len(above) > 1 and fixed else naming.BODIES[0]

    def _worlds(self, above: dict[str, list[str]]) -> list[str]:
        """Of the frames above the drone, with the way to each, those that its poses may be in."""
        moving = [frame for frame, way in above.items() if self.moves(way)]
        best = min(naming.rank(naming.own_name(frame)) for frame in moving)
        if best < len(naming.WORLDS):
            named = [frame for frame in moving if naming.rank(naming.own_name(frame)) == best]
            return named[:1] if len({naming.own_name(frame) for frame in named}) == 1 else named
        return [frame for frame in moving if frame not in self._parents] or moving

    def move_still(self, keys: list[tuple[str, str]]) -> None:
        """Of a recording in which nothing moves, take transforms on tf for moving ones."""
        if not any(edge.moves for edge in self.edges.values()):
            self.edges |= {key: self.edges[key]._replace(moves=not self.edges[key].is_static) for key in keys}

    def above(self, frame: str) -> dict[str, list[str]]:
        """A frame and its ancestors, with the way up to each."""
        return _ways(frame, self._parents)

    def keys_between(self, target: str, source: str) -> list[tuple[str, str]]:
        """Parent and child of each transform on the way between two frames."""
        return [key for key, _ in self._steps(self.between(target, source) or [])]

    def _steps(self, frames: Sequence[str]) -> list[tuple[tuple[str, str], bool]]:
        """Parent and child of each transform along a way between frames, and whether the way goes down to the child."""
        pairs = pairwise(frames)
        return [((a, b), True) if (a, b) in self.edges else ((b, a), False) for a, b in pairs]


def _ways(start: str, near: Mapping[str, list[str]]) -> dict[str, list[str]]:
    """Each frame that steps to ``near`` ones of each reach, with the shortest way to it."""
    ways, reached = {start: [start]}, [start]
    for frame in reached:
        new = [each for each in dict.fromkeys(near.get(frame, ())) if each not in ways]
        ways |= {each: [*ways[frame], each] for each in new}
        reached += new
    return ways


def frame_name(name: str) -> str:
    """Name of a frame; ROS 1 allowed a slash before it."""
    return printable(name.lstrip("/"))
