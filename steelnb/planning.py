"""A pilot that never sees the truth: it follows a reference along a structure and keeps the structure in view.

At each command it knows the map so far, an estimate of the pose, and how far and wide its camera sees. The goal
``around`` goes round the structure and up, with the camera on its middle; ``face`` to and fro before it with one
heading, a level up at each edge. The part of a velocity that would bring the drone too close to the known structure is
removed. Where sight is lost, it stops, turns to where the map is, and goes back along its path.
"""

from dataclasses import dataclass, field

import numpy as np

from steelnb.errors import InputError
from steelnb.fusion.poses import yaw_of
from steelnb.points import VoxelMap, voxel_grid
from steelnb.settings import FlightSettings
from steelnb.types import Array, Segments

VOXEL_M = 0.1
CLEARANCE_M = 0.45
"""Least distance of the drone's middle from steel: half its diagonal is 0.18 m, and it swings in gusts."""
HIDDEN_M = 0.5
"""A mapped bar may go on behind the edge of the map by this much."""
BEARING_SHARE = 0.5
"""Up a face the drone turns back where the structure's middle is this share of half the field of view aside."""
SIGHT_MIN = 60
"""Voxels of a scan below which sight is lost."""
GAIN_1_S = {"turn": 1.5, "distance": 0.8, "height": 0.5}
"""From an error to the wished rate."""
TURN_MAX_RAD_S, SEARCH_RAD_S = 1.0, 0.5
SEARCH_STOP_S, SEARCH_TURN_S = 1.0, 4.0
"""After sight is lost: stop, then turn to where the map is, then go back along the path."""
BLOCKED_S, BLOCKED_SHARE = 1.0, 0.3
"""A way aside is blocked if for so long less than this share of the wished velocity is left."""
ROUNDS = 20
"""Rounds over the obstacles in which a velocity is taken back."""
NEAR_M = 0.35
"""Steel that is so much further away than the nearest counts e times less for where the nearest is."""


@dataclass(frozen=True)
class Decision:
    """``velocity (3,)`` along the axes of the level drone, m/s, and ``yaw_rate``, rad/s; ``state`` is "wait", "follow",
    "stop", "turn", "return", "search" or "end", ``reason`` why."""

    velocity: Array
    yaw_rate: float
    state: str
    reason: str = ""


@dataclass
class Planner:
    """Decides ten times a second; `see` adds a scan to its map.

    ``flight``: what to fly; raises `InputError` for another than a ``planned`` one. Its camera sees
    ``fov_rad`` wide, ``range_max_m`` far. All poses are estimates, in the world frame of the map.
    """

    flight: FlightSettings
    fov_rad: float
    range_max_m: float
    map: VoxelMap = field(default_factory=lambda: VoxelMap(VOXEL_M))
    bars: Segments = field(default_factory=Segments.empty)

    def __post_init__(self) -> None:
        if self.flight.trajectory != "planned":
            raise InputError(f"trajectory {self.flight.trajectory!r}: expected 'planned'")
        self._scans, self._near = 0, np.zeros((0, 3))  # the last scan, world frame
        self._lost_s: float | None = None
        self._begun: tuple[float, float] | None = None  # time and heading of the first decision
        self._turned = self._last_s = 0.0
        self._path: list[Array] = []  # poses from which the structure was seen well
        self._side, self._blocked_s, self._climb_to = 1.0, 0.0, self.flight.height_min_m

    def see(self, points: Array, T_world_drone: Array, bars: Segments) -> None:
        """Add the preprocessed points ``(N, 3)`` of a scan, drone frame, at its corrected pose; ``bars`` are those
        mapped so far, world frame."""
        self._scans += 1
        world = points @ T_world_drone[:3, :3].T + T_world_drone[:3, 3]
        self._near, self.bars = voxel_grid(world, VOXEL_M) if len(world) else world, bars
        if len(self._near) >= SIGHT_MIN:
            self.map.insert(world)
            if not self._path or np.linalg.norm(self._path[-1][:3, 3] - T_world_drone[:3, 3]) > 0.2:
                self._path.append(T_world_drone.copy())

    def decide(self, stamp_s: float, T_world_drone: Array) -> Decision:
        """The command for the next tenth of a second from an estimate ``(4, 4)`` of the pose."""
        position, yaw = T_world_drone[:3, 3], float(yaw_of(T_world_drone[:3, :3]))
        self._begun = self._begun or (stamp_s, yaw)
        passed_s, self._last_s = stamp_s - self._last_s, stamp_s
        if not self._scans:
            return Decision(np.zeros(3), 0.0, "wait", "no scan yet")
        if not len(self.map):
            self._turned += SEARCH_RAD_S * passed_s
            if self._turned > 2 * np.pi:
                return Decision(np.zeros(3), 0.0, "end", "no bar seen in a full turn")
            return Decision(np.zeros(3), SEARCH_RAD_S, "search", "no structure in sight")
        if len(self._near) >= SIGHT_MIN:
            self._lost_s = None
        elif self._lost_s is None:
            self._lost_s = stamp_s
        points = self.map.means(self.map.near(position, self.range_max_m))
        if self._lost_s is not None:
            wished, turn, state = self._recover(stamp_s - self._lost_s, position, yaw, points)
        else:
            follow = self._face if self.flight.goal == "face" else self._around
            (wished, turn), state = follow(stamp_s - self._begun[0], position, yaw, points), "follow"
        u = self._kept_off(wished, position)
        u = u * min(1.0, 1.5 * self.flight.speed_m_s / max(float(np.linalg.norm(u)), 1e-9))
        blocked = u[:2] @ wished[:2] < BLOCKED_SHARE * (wished[:2] @ wished[:2])
        self._blocked_s = self._blocked_s + passed_s if blocked else 0.0
        c, s = np.cos(yaw), np.sin(yaw)
        velocity = np.array([c * u[0] + s * u[1], -s * u[0] + c * u[1], u[2]])
        return Decision(velocity, float(np.clip(turn, -TURN_MAX_RAD_S, TURN_MAX_RAD_S)), state)

    def _around(self, flown_s: float, position: Array, yaw: float, points: Array) -> tuple[Array, float]:
        """Velocity (world axes) and yaw rate along the tangent of the nearest steel, rising slowly."""
        flight, facing = self.flight, towards_nearest(points, position)
        climb = (flight.height_max_m - flight.height_min_m) / flight.duration_s
        up = climb + GAIN_1_S["height"] * (flight.height_min_m + climb * flown_s - position[2])
        along = flight.speed_m_s * np.array([facing[1], -facing[0]])
        return self._at_distance(along, facing, up, position, points), self._turn_to_middle(position, yaw, points)

    def _face(self, flown_s: float, position: Array, yaw: float, points: Array) -> tuple[Array, float]:
        """Velocity (world axes) and yaw rate to and fro with the first heading, a level up at each edge."""
        assert self._begun is not None
        flight, first = self.flight, self._begun[1]
        middle = middle_of(points, position)
        bearing = turn_to(float(np.arctan2(middle[1], middle[0])) - first)
        at_edge = self._side * bearing > BEARING_SHARE * self.fov_rad / 2 or self._blocked_s > BLOCKED_S
        if at_edge and position[2] > self._climb_to - 0.2:
            rise = (flight.height_max_m - flight.height_min_m) / (flight.levels - 1)
            self._climb_to = min(self._climb_to + rise, flight.height_max_m)
            self._side, self._blocked_s, at_edge = -self._side, 0.0, False
        facing = np.array([np.cos(first), np.sin(first)])
        along = (0.0 if at_edge else flight.speed_m_s) * self._side * np.array([facing[1], -facing[0]])
        up = GAIN_1_S["height"] * (self._climb_to - position[2])
        return self._at_distance(along, facing, up, position, points), GAIN_1_S["turn"] * turn_to(first - yaw)

    def _at_distance(self, along: Array, facing: Array, up: float, position: Array, points: Array) -> Array:
        """A velocity ``along (2,)`` and up that also leads to the standoff from what is ahead."""
        distance, speed = distance_ahead(points, position, facing), self.flight.speed_m_s
        inward = float(np.clip(GAIN_1_S["distance"] * (distance - self.flight.standoff_m), -0.5, 0.5))
        return np.append(along + inward * facing, np.clip(up, -speed, speed))

    def _turn_to_middle(self, position: Array, yaw: float, points: Array) -> float:
        middle = middle_of(points, position)
        return GAIN_1_S["turn"] * turn_to(float(np.arctan2(middle[1], middle[0])) - yaw)

    def _recover(self, lost_s: float, position: Array, yaw: float, points: Array) -> tuple[Array, float, str]:
        """Velocity, yaw rate and state so long after sight was lost."""
        if lost_s < SEARCH_STOP_S or not self._path:
            return np.zeros(3), 0.0, "stop"
        if lost_s < SEARCH_STOP_S + SEARCH_TURN_S and len(points):
            return np.zeros(3), self._turn_to_middle(position, yaw, points), "turn"
        while len(self._path) > 1 and np.linalg.norm(self._path[-1][:3, 3] - position) < 0.2:
            self._path.pop()
        back = self._path[-1]
        way = back[:3, 3] - position
        way *= min(1.0, 0.5 * self.flight.speed_m_s / max(float(np.linalg.norm(way)), 1e-9) + 0.2)
        return way, GAIN_1_S["turn"] * turn_to(float(yaw_of(back[:3, :3])) - yaw), "return"

    def _kept_off(self, wished: Array, position: Array) -> Array:
        """The wished velocity without what leads to the nearest obstacle in each of 26 directions faster than 1/s times
        its distance beyond the clearance, or so out of the heights of the flight.

        Obstacles are voxels of the map, returns of the last scan, and what bars may be beyond their mapped ends. The
        velocity is projected on one half-space after the other, the nearest obstacle's last, until it is in all.
        """
        beyond = HIDDEN_M * self.bars.direction
        obstacles = np.concatenate([
            self.map.means(self.map.near(position, 2.0)), self._near, self.bars.start - beyond, self.bars.end + beyond,
        ])  # fmt: skip
        away = position - obstacles
        distance = np.linalg.norm(away, axis=1)
        near = np.flatnonzero((distance < 2.0) & (distance > 1e-6))
        near = near[np.argsort(distance[near])]
        sector = (np.round(away[near] / distance[near, None] * 1.2).astype(int) + 1) @ [9, 3, 1]
        chosen = near[np.sort(np.unique(sector, return_index=True)[1])][::-1]
        low, high = self.flight.height_min_m - 0.2, self.flight.height_max_m + 0.2
        normal = np.concatenate([[[0, 0, 1], [0, 0, -1]], away[chosen] / distance[chosen, None]])
        least = np.concatenate([[low - position[2], position[2] - high], CLEARANCE_M - distance[chosen]])
        u = wished
        for _ in range(ROUNDS):
            for n, slowest in zip(normal, least, strict=True):
                u = u + max(float(slowest - n @ u), 0.0) * n
            if (normal @ u >= least - 1e-6).all():
                break
        return u


def turn_to(angle: float) -> float:
    """An angle, radians, as the turn from −π to π that leads to it."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def middle_of(points: Array, position: Array) -> Array:
    """From a position ``(3,)`` to the middle of the ``points (N, 3)`` around it, metres; those at its height and near
    it weigh more."""
    arm = points - position
    weight = np.exp(-0.5 * (arm[:, 2] / 1.0) ** 2) / (0.25 + (arm[:, :2] ** 2).sum(axis=1))
    return np.asarray((weight @ arm) / max(float(weight.sum()), 1e-12))


def towards_nearest(points: Array, position: Array) -> Array:
    """Horizontal unit vector ``(2,)`` towards the nearest structure at about the same height."""
    arm = points - position
    arm = arm[np.abs(arm[:, 2]) < 1.0, :2] if (np.abs(arm[:, 2]) < 1.0).any() else arm[:, :2]
    distance = np.maximum(np.hypot(*arm.T), 1e-6)
    weight = np.exp(-(distance - np.percentile(distance, 5)) / NEAR_M) / distance
    towards = weight @ arm
    return np.asarray(towards / max(float(np.hypot(*towards)), 1e-9))


def distance_ahead(points: Array, position: Array, facing: Array) -> float:
    """Horizontal distance to the nearest structure ahead, at about the same height."""
    arm = points - position
    ahead, aside = arm[:, :2] @ facing, arm[:, :2] @ np.array([-facing[1], facing[0]])
    near = (np.abs(arm[:, 2]) < 0.7) & (ahead > 0) & (np.abs(aside) < np.maximum(ahead, 0.7))
    if near.sum() < 5:
        return float(np.hypot(*middle_of(points, position)[:2]))
    return float(np.percentile(np.hypot(ahead[near], aside[near]), 5))
