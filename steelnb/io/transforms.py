"""The tree of frames that a bag's tf messages hold: extrinsics from fixed transforms, poses from moving ones."""

import itertools
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order

from steelnb.io.calibration import T_OPTICAL_SENSOR
from steelnb.io.clouds import FARTHEST_M
from steelnb.io.trajectories import matrices
from steelnb.types import Array, Trajectory

MOVED = 1e-6
"""A transform that changes by more, in any of its numbers, moves."""
WORLDS = ("odom", "world", "map")
BODIES = ("base_link", "base_footprint", "body", "base", "drone")
"""Usual names, the likelier first (REP 105). In odom poses drift but do not jump, as a prior should."""
GAP_MAX_S = 0.5, 2.0
"""Poses further apart than this are not interpolated between: a drone turns and stops within it. The second number is
for poses that come slowly."""


def interpolate(
    trajectory: Trajectory, stamp_s: Array, gap_max_s: float | None = None
) -> tuple[Array, NDArray[np.bool_]]:
    """Poses ``(K, 4, 4)`` at ``stamp_s (K,)``, and where ``(K,)`` they are known: in gaps up to ``gap_max_s``, by
    default two usual intervals, within the limits of `GAP_MAX_S`.

    Positions linearly, rotations by slerp; exactly the recorded pose at its own stamp.
    """
    own = trajectory.stamp_s
    result = np.tile(np.eye(4), (len(stamp_s), 1, 1))
    if not len(own) or not len(stamp_s):
        return result, np.zeros(len(stamp_s), dtype=bool)
    if gap_max_s is None:
        gap_max_s = float(np.clip(2 * np.median(np.diff(own)), *GAP_MAX_S)) if len(own) > 1 else GAP_MAX_S[0]
    # Stamps that went through text or integers may miss by rounding.
    after = np.clip(np.searchsorted(own, stamp_s - 1e-6), 0, len(own) - 1)
    exact = np.abs(own[after] - stamp_s) < 1e-6
    before = np.where(exact, after, np.maximum(after - 1, 0))
    covered = exact | ((own[before] <= stamp_s) & (stamp_s <= own[after]) & (own[after] - own[before] <= gap_max_s))
    if len(own) > 1:
        result = trajectory.between(stamp_s)
    result[exact] = trajectory.T_world_drone[after[exact]]
    return result, covered


class Transforms:
    """Transforms between frames as they arrive. Of each the first is kept, and all where ``series`` is asked for."""

    def __init__(self, series: bool = False) -> None:
        self._series = series
        self._first: dict[tuple[str, str], Array] = {}
        self._moving: set[tuple[str, str]] = set()
        self._all: dict[tuple[str, str], array[float]] = {}

    def add(self, parent: str, child: str, stamp_s: float, pose: Sequence[float]) -> bool:
        """Take ``T_parent_child`` as x, y, z and a quaternion xyzw; False where it is no transform."""
        parent, child = plain(parent), plain(child)
        numbers = np.array([stamp_s, *pose])
        with np.errstate(over="ignore"):
            length = np.linalg.norm(numbers[4:])
        if not (np.isfinite([*numbers, length]).all() and length > 1e-6 and np.abs(numbers[1:4]).max() <= FARTHEST_M):
            return False
        if not parent or not child or parent == child:
            return False
        numbers[4:] /= length
        edge = (parent, child)
        if _moved(self._first.setdefault(edge, numbers), numbers):
            self._moving.add(edge)
        if self._series:
            self._all.setdefault(edge, array("d")).extend(numbers.tolist())
        return True

    def fixed(self, target: str, source: str) -> Array | None:
        """``T_target_source (4, 4)`` by transforms that never moved; None where they do not join the two."""
        path = self._path(plain(target), plain(source), moving=False)
        return None if path is None else reduce(np.matmul, (self._fixed(*each) for each in path), np.eye(4))

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
                T_world_body = T_world_body @ (T if forward else np.linalg.inv(T))
            else:
                T_world_body = T_world_body @ self._fixed(edge, forward)
        return Trajectory(stamp_s[covered], T_world_body[covered])

    def _samples(self, edge: tuple[str, str]) -> Trajectory:
        rows = np.frombuffer(self._all[edge]).reshape(-1, 8)
        _, order = np.unique(rows[:, 0], return_index=True)
        return Trajectory(rows[order, 0], matrices(rows[order, 1:4], rows[order, 4:]))

    def _fixed(self, edge: tuple[str, str], forward: bool) -> Array:
        """``T_parent_child (4, 4)`` as it was first, or its inverse."""
        first = self._first[edge][None]
        T_parent_child = matrices(first[:, 1:4], first[:, 4:])[0]
        return T_parent_child if forward else np.linalg.inv(T_parent_child)

    def _path(self, start: str, goal: str, moving: bool) -> list[tuple[tuple[str, str], bool]] | None:
        """Shortest way from a frame to another: transforms, and whether each is passed from parent to child."""
        usable = [edge for edge in self._first if moving or self._edge(*edge)[0] not in self._moving]
        names = list(dict.fromkeys((start, goal, *itertools.chain.from_iterable(usable))))
        ends = np.array([[names.index(name) for name in edge] for edge in usable], dtype=np.int64).reshape(-1, 2)
        links = coo_array((np.ones(len(ends)), ends.T), shape=(len(names), len(names)))
        before = breadth_first_order(links.tocsr(), 0, directed=False)[1]
        way = [names.index(goal)]
        while way[-1] != 0:
            if before[way[-1]] < 0:
                return None
            way.append(int(before[way[-1]]))
        return [self._edge(names[here], names[there]) for here, there in itertools.pairwise(way[::-1])]

    def _edge(self, here: str, there: str) -> tuple[tuple[str, str], bool]:
        """The transform between two neighbours, and whether it is passed from parent to child."""
        return ((here, there), True) if (here, there) in self._first else ((there, here), False)


def plain(frame: str) -> str:
    """A frame's name without the slash that ROS 1 allowed in front."""
    return frame.lstrip("/")


def _moved(first: Array, now: Array) -> bool:
    same = np.abs(now[1:] - first[1:]).max() <= MOVED
    turned_over = np.abs(np.r_[now[1:4] - first[1:4], now[4:] + first[4:]]).max() <= MOVED  # q and −q are one
    return not (same or turned_over)


def is_optical(frame: str) -> bool:
    """Whether a frame has a camera's axes, z forward, x right, y down, by its name (REP 103)."""
    return plain(frame).endswith(("_optical_frame", "_optical"))


def T_body_drone(body: str | None) -> Array:
    """From the drone's axes to those of the frame that poses are of: a camera's, or the same."""
    return T_OPTICAL_SENSOR if body is not None and is_optical(body) else np.eye(4)


def poses_of_transforms(transforms: Transforms, sensor: str) -> tuple[Trajectory, str, str] | None:
    """Poses from tf: of the first known name of a body, or of the sensor itself, that moves in a known world.

    The poses, the frame that they are of, and both frames in words; None where there are none.
    """
    for body in (*BODIES, plain(sensor)):
        for world in WORLDS:
            poses = transforms.trajectory(world, body)
            if poses is not None and len(poses):
                return poses, body, f"tf {world} → {body}"
    return None


@dataclass(frozen=True)
class Frames:
    """``body``: frame of the poses, None where nothing says; ``sensor``: frame of the scans, whose points are turned
    from a camera's axes where it is ``optical``."""

    transforms: Transforms
    body: str | None
    sensor: str
    optical: bool

    def extrinsics(self, named: Array | None, settings: Path | str | None) -> tuple[Array, str]:
        """``T_drone_sensor`` and its source in words: settings, tf, or none (the identity)."""
        if named is not None:
            return named, f"settings {settings}"
        turn = T_OPTICAL_SENSOR if self.optical else np.eye(4)
        if self.body is not None and plain(self.body) == plain(self.sensor):
            return np.linalg.inv(T_body_drone(self.body)) @ turn, f"the poses are of the sensor's frame {self.sensor}"
        for body in (self.body, *BODIES):
            T = self.transforms.fixed(body, self.sensor) if body else None
            if T is not None and body is not None:
                words = f"tf {plain(body)} → {plain(self.sensor)}"
                if self.body and plain(body) != plain(self.body):
                    words += f", since the poses' frame {self.body} is not in tf"
                drone = T_body_drone(body) if body == self.body else np.eye(4)
                return np.linalg.inv(drone) @ T @ turn, words
        return np.eye(4), f"none from {self.body or 'the body'} to {self.sensor or 'the sensor'}: taken as the same"

    def R_drone(self, frame: str) -> Array:
        """Rotation ``(3, 3)`` from a frame's axes to the drone's, by tf; identity where it is not known."""
        T = self.transforms.fixed(self.body, frame) if self.body and frame else None
        return np.eye(3) if T is None else (np.linalg.inv(T_body_drone(self.body)) @ T)[:3, :3]
