"""The tree of frames that a bag's tf messages tell: extrinsics from what stands still, poses from what moves."""

from array import array
from collections import deque
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.datatypes import Array, Trajectory
from steelnb.recordings.recording import interpolate

MOVED = 1e-6
"""A transform that changes by more, in any of its numbers, moves."""


class Transforms:
    """Transforms between frames as they arrive. Of each the first is kept, and all where ``series`` is asked for."""

    def __init__(self, series: bool = False) -> None:
        self._series = series
        self._first: dict[tuple[str, str], Array] = {}
        self._moving: set[tuple[str, str]] = set()
        self._all: dict[tuple[str, str], array[float]] = {}
        self._near: dict[str, dict[str, None]] = {}

    def add(self, parent: str, child: str, stamp_s: float, pose: Sequence[float]) -> bool:
        """Take ``T_parent_child`` as x, y, z and a quaternion xyzw; False where it is no transform."""
        parent, child = plain(parent), plain(child)
        numbers = np.array([stamp_s, *pose])
        length = np.linalg.norm(numbers[4:])
        if not (np.isfinite(numbers).all() and length > 1e-6 and parent and child and parent != child):
            return False
        numbers[4:] /= length
        edge = (parent, child)
        first = self._first.setdefault(edge, numbers)
        if first is numbers:
            self._near.setdefault(parent, {})[child] = None
            self._near.setdefault(child, {})[parent] = None
        if _moved(first, numbers):
            self._moving.add(edge)
        if self._series:
            self._all.setdefault(edge, array("d")).extend(numbers.tolist())
        return True

    @property
    def frames(self) -> list[str]:
        """All frames, in the order in which they were first named."""
        return list(self._near)

    def fixed(self, target: str, source: str) -> Array | None:
        """``T_target_source (4, 4)`` by transforms that never moved; None where they do not join the two."""
        path = self._path(plain(target), plain(source), moving=False)
        if path is None:
            return None
        T_target_source = np.eye(4)
        for edge, forward in path:
            T = _matrices(self._first[edge][None, 1:])[0]
            T_target_source = T_target_source @ (T if forward else np.linalg.inv(T))
        return T_target_source

    def trajectory(self, world: str, body: str) -> Trajectory | None:
        """Poses of a frame in another over time; None where nothing joins the two, or what does never moved.

        At the stamps of the transform on the way that has most; others are interpolated to them, and stamps that one
        of them does not cover are left out. Needs ``series``.
        """
        path = self._path(plain(world), plain(body), moving=True)
        moving = [edge for edge, _ in path or () if edge in self._moving]
        if path is None or not moving:
            return None
        stamp_s = max((self._samples(edge) for edge in moving), key=len).stamp_s
        covered = np.ones(len(stamp_s), dtype=bool)
        T_world_body = np.tile(np.eye(4), (len(stamp_s), 1, 1))
        for edge, forward in path:
            if edge in self._moving:
                T, known = interpolate(self._samples(edge), stamp_s, np.inf)
                covered &= known
            else:
                T = _matrices(self._first[edge][None, 1:])
            T_world_body = T_world_body @ (T if forward else np.linalg.inv(T))
        return Trajectory(stamp_s[covered], T_world_body[covered])

    def _samples(self, edge: tuple[str, str]) -> Trajectory:
        rows = np.frombuffer(self._all[edge]).reshape(-1, 8)
        _, order = np.unique(rows[:, 0], return_index=True)
        return Trajectory(rows[order, 0], _matrices(rows[order, 1:]))

    def _path(self, start: str, goal: str, moving: bool) -> list[tuple[tuple[str, str], bool]] | None:
        """Shortest way from a frame to another: transforms, and whether each is passed from parent to child."""
        before: dict[str, str] = {start: start}
        queue = deque([start])
        while queue and goal not in before:
            here = queue.popleft()
            for there in self._near.get(here, ()):
                edge = (here, there) if (here, there) in self._first else (there, here)
                if there not in before and (moving or edge not in self._moving):
                    before[there] = here
                    queue.append(there)
        if goal not in before:
            return None
        way = [goal]
        while way[-1] != start:
            way.append(before[way[-1]])
        way.reverse()
        return [
            ((here, there), True) if (here, there) in self._first else ((there, here), False)
            for here, there in pairwise(way)
        ]


def plain(frame: str) -> str:
    """A frame's name without the slash that ROS 1 allowed in front."""
    return frame.lstrip("/")


def _moved(first: Array, now: Array) -> bool:
    same = np.abs(now[1:] - first[1:]).max() <= MOVED
    turned_over = np.abs(np.r_[now[1:4] - first[1:4], now[4:] + first[4:]]).max() <= MOVED  # q and −q are one
    return not (same or turned_over)


def _matrices(pose: Array) -> Array:
    """``(N, 7)`` as ``(N, 4, 4)``."""
    T = np.tile(np.eye(4), (len(pose), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(pose[:, 3:]).as_matrix()
    T[:, :3, 3] = pose[:, :3]
    return T
