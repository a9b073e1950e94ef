"""A reactive planner that flies along a structure and keeps it in view.

It knows the map so far, an estimate of the pose, and the camera's field of view and range, but never the true state.
With the goal ``around``, it circles the structure and climbs, facing its middle. With the goal ``face``, it flies to
and fro in front of a face with a fixed heading and climbs one level at each edge. Speed towards obstacles is limited.
When it loses sight of the structure, or no point of the map is in the camera's range, it stops, turns towards the map,
and then flies back along its path.
"""

from dataclasses import dataclass

import numpy as np

from steelnb.core.checks import checked_kind, checked_number, checked_points, checked_pose
from steelnb.core.errors import InputError
from steelnb.core.geometry import transform_points, yaw_of
from steelnb.core.types import Array, Segments
from steelnb.points import VoxelMap, voxel_grid
from steelnb.settings import FlightSettings

VOXEL_M = 0.1
CLEARANCE_M = 0.45
"""Minimum distance of the drone's centre from steel: half of its diagonal (0.18 m) and a margin for gusts."""
HIDDEN_M = 0.5
"""A bar may extend beyond its mapped ends by this much."""
BEARING_SHARE = 0.5
"""In front of a face, the drone turns back when the bearing of the structure's middle exceeds this share of half the
field of view."""
SIGHT_MIN = 60
"""Minimum number of voxels in a scan; with fewer, the structure is out of sight."""
GAIN_1_S = {"turn": 1.5, "distance": 0.8, "height": 0.5}
"""Proportional gains from an error to a rate."""
TURN_MAX_RAD_S, SEARCH_RAD_S = 1.0, 0.5
SEARCH_STOP_S, SEARCH_TURN_S = 1.0, 4.0
"""Durations of the first two stages after loss of sight: stop, then turn towards the map."""
BLOCKED_S, BLOCKED_SHARE = 1.0, 0.3
"""The way is blocked if less than this share of the desired velocity remains for this long."""
ROUNDS = 20
"""Maximum number of projection rounds over the obstacles."""
NEAR_M = 0.35
"""Decay length of the weights in the average direction to the nearest steel."""


@dataclass(frozen=True)
class Decision:
    """``velocity (3,)`` along the axes of the levelled drone, m/s; ``yaw_rate``, rad/s; ``state``: "wait" for the first
    scan, "search" for a structure, "end" if none was found in a full turn, "follow" it, and when it is out of sight
    "stop", "turn" and "return"."""

    velocity: Array
    yaw_rate: float
    state: str


class Planner:
    """Makes ten decisions per second; `see` adds a scan to its map.

    ``flight``: a ``planned`` flight, else `InputError`; ``fov_rad`` and ``range_max_m``: horizontal field of view and
    range of the camera. All poses are estimates, in the world frame of the map.
    """

    def __init__(self, flight: FlightSettings, fov_rad: float, range_max_m: float) -> None:
        if checked_kind(flight, "flight", FlightSettings, "FlightSettings.preset").trajectory != "planned":
            raise InputError(f"trajectory {flight.trajectory!r}: expected 'planned'")
        self.flight, self.fov_rad = flight, checked_number(fov_rad, "fov_rad", above=0, high=2 * np.pi)
        self.range_max_m = checked_number(range_max_m, "range_max_m", above=0)
        self.map, self.bars = VoxelMap(VOXEL_M), Segments.empty()
        self._scans, self._last_scan = 0, np.zeros((0, 3))  # world frame
        self._lost_s: float | None = None
        self._start: tuple[float, float] | None = None  # time and heading of the first decision
        self._searched_rad = self._last_s = 0.0
        self._path: list[Array] = []  # poses with the structure in sight
        self._side, self._blocked_s, self._target_height = 1.0, 0.0, flight.height_min_m

    def see(self, points: Array, T_world_drone: Array, bars: Segments) -> None:
        """Add a scan: preprocessed points ``(N, 3)`` in the drone frame, the corrected pose, and the ``bars`` mapped so
        far, world frame. Raises `InputError`."""
        points, T_world_drone = checked_points(points), checked_pose(T_world_drone, "T_world_drone")
        checked_kind(bars, "bars", Segments)
        self._scans += 1
        world = transform_points(T_world_drone, points)
        self._last_scan, self.bars = voxel_grid(world, VOXEL_M) if len(world) else world, bars
        if len(self._last_scan) >= SIGHT_MIN:
            self.map.insert(world)
            if not self._path or np.linalg.norm(self._path[-1][:3, 3] - T_world_drone[:3, 3]) > 0.2:
                self._path.append(T_world_drone.copy())

    def decide(self, stamp_s: float, T_world_drone: Array) -> Decision:
        """The command for the next tenth of a second, from an estimate of the pose ``(4, 4)``. Raises `InputError`."""
        stamp_s = checked_number(stamp_s, "stamp_s")
        T_world_drone = checked_pose(T_world_drone, "T_world_drone")
        position, yaw = T_world_drone[:3, 3], float(yaw_of(T_world_drone[:3, :3]))
        self._start = self._start or (stamp_s, yaw)
        elapsed_s, self._last_s = stamp_s - self._last_s, stamp_s
        if not self._scans:
            return Decision(np.zeros(3), 0.0, "wait")
        if not len(self.map):
            self._searched_rad += SEARCH_RAD_S * elapsed_s
            if self._searched_rad > 2 * np.pi:
                return Decision(np.zeros(3), 0.0, "end")
            return Decision(np.zeros(3), SEARCH_RAD_S, "search")
        points = self.map.means(self.map.near(position, self.range_max_m))
        if len(self._last_scan) >= SIGHT_MIN and len(points):
            self._lost_s = None
        elif self._lost_s is None:
            self._lost_s = stamp_s
        if self._lost_s is not None:
            desired, yaw_rate, state = self._recover(stamp_s - self._lost_s, position, yaw, points)
        else:
            follow = self._face if self.flight.goal == "face" else self._around
            (desired, yaw_rate), state = follow(stamp_s - self._start[0], position, yaw, points), "follow"
        u = self._without_collision(desired, position)
        u = u * min(1.0, 1.5 * self.flight.speed_m_s / max(float(np.linalg.norm(u)), 1e-9))
        blocked = u[:2] @ desired[:2] < BLOCKED_SHARE * (desired[:2] @ desired[:2])
        self._blocked_s = self._blocked_s + elapsed_s if blocked else 0.0
        c, s = np.cos(yaw), np.sin(yaw)
        velocity = np.array([c * u[0] + s * u[1], -s * u[0] + c * u[1], u[2]])
        return Decision(velocity, float(np.clip(yaw_rate, -TURN_MAX_RAD_S, TURN_MAX_RAD_S)), state)

    def _around(self, flown_s: float, position: Array, yaw: float, points: Array) -> tuple[Array, float]:
        """Velocity (world axes) tangential to the nearest steel, with a slow climb, and yaw rate."""
        flight, ahead = self.flight, towards_nearest(points, position)
        climb = (flight.height_max_m - flight.height_min_m) / flight.duration_s
        up = climb + GAIN_1_S["height"] * (flight.height_min_m + climb * flown_s - position[2])
        along = flight.speed_m_s * np.array([ahead[1], -ahead[0]])
        yaw_rate = GAIN_1_S["turn"] * wrap_angle(bearing_of_middle(points, position) - yaw)
        return self._at_standoff(along, ahead, up, position, points), yaw_rate

    def _face(self, flown_s: float, position: Array, yaw: float, points: Array) -> tuple[Array, float]:
        """Velocity (world axes) to and fro at the initial heading, one level higher after each edge, and yaw rate."""
        assert self._start is not None
        flight, initial_yaw = self.flight, self._start[1]
        bearing = wrap_angle(bearing_of_middle(points, position) - initial_yaw)
        at_edge = self._side * bearing > BEARING_SHARE * self.fov_rad / 2 or self._blocked_s > BLOCKED_S
        if at_edge and position[2] > self._target_height - 0.2:
            rise = (flight.height_max_m - flight.height_min_m) / (flight.levels - 1)
            self._target_height = min(self._target_height + rise, flight.height_max_m)
            self._side, self._blocked_s, at_edge = -self._side, 0.0, False
        ahead = np.array([np.cos(initial_yaw), np.sin(initial_yaw)])
        along = (0.0 if at_edge else flight.speed_m_s) * self._side * np.array([ahead[1], -ahead[0]])
        up = GAIN_1_S["height"] * (self._target_height - position[2])
        yaw_rate = GAIN_1_S["turn"] * wrap_angle(initial_yaw - yaw)
        return self._at_standoff(along, ahead, up, position, points), yaw_rate

    def _at_standoff(self, along: Array, ahead: Array, up: float, position: Array, points: Array) -> Array:
        """The velocity ``along (2,)`` and ``up``, plus a component that corrects the distance to the structure."""
        distance, speed = distance_ahead(points, position, ahead), self.flight.speed_m_s
        inward = float(np.clip(GAIN_1_S["distance"] * (distance - self.flight.standoff_m), -0.5, 0.5))
        return np.append(along + inward * ahead, np.clip(up, -speed, speed))

    def _recover(self, lost_s: float, position: Array, yaw: float, points: Array) -> tuple[Array, float, str]:
        """Velocity, yaw rate and state ``lost_s`` seconds after sight was lost."""
        if lost_s < SEARCH_STOP_S or not self._path:
            return np.zeros(3), 0.0, "stop"
        if lost_s < SEARCH_STOP_S + SEARCH_TURN_S and len(points):
            return np.zeros(3), GAIN_1_S["turn"] * wrap_angle(bearing_of_middle(points, position) - yaw), "turn"
        while len(self._path) > 1 and np.linalg.norm(self._path[-1][:3, 3] - position) < 0.2:
            self._path.pop()
        target = self._path[-1]
        velocity = target[:3, 3] - position
        velocity *= min(1.0, 0.5 * self.flight.speed_m_s / max(float(np.linalg.norm(velocity)), 1e-9) + 0.2)
        return velocity, GAIN_1_S["turn"] * wrap_angle(float(yaw_of(target[:3, :3])) - yaw), "return"

    def _without_collision(self, desired: Array, position: Array) -> Array:
        """Limit the desired velocity towards obstacles and out of the flight's range of heights.

        The speed (m/s) towards the nearest obstacle in each of 26 directions is at most its distance minus the
        clearance (m). Obstacles are voxels of the map, the last scan, and possible extensions of mapped bars. The
        velocity is projected onto these half-spaces in turn, nearest last, at most `ROUNDS` times, until all hold.
        """
        extension = HIDDEN_M * self.bars.direction
        obstacles = np.concatenate([
            self.map.means(self.map.near(position, 2.0)), self._last_scan,
            self.bars.start - extension, self.bars.end + extension,
        ])  # fmt: skip
        away = position - obstacles
        distance = np.linalg.norm(away, axis=1)
        near = np.flatnonzero((distance < 2.0) & (distance > 1e-6))
        near = near[np.argsort(distance[near])]
        sector = (np.round(away[near] / distance[near, None] * 1.2).astype(int) + 1) @ [9, 3, 1]
        chosen = near[np.sort(np.unique(sector, return_index=True)[1])][::-1]
        low, high = self.flight.height_min_m - 0.2, self.flight.height_max_m + 0.2
        normal = np.concatenate([[[0, 0, 1], [0, 0, -1]], away[chosen] / distance[chosen, None]])
        bound = np.concatenate([[low - position[2], position[2] - high], CLEARANCE_M - distance[chosen]])
        u = desired
        for _ in range(ROUNDS):
            for n, lower_bound in zip(normal, bound, strict=True):
                u = u + max(float(lower_bound - n @ u), 0.0) * n
            if (normal @ u >= bound - 1e-6).all():
                break
        return u


def wrap_angle(angle: float) -> float:
    """An angle, radians, wrapped to −π … π."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def vector_to_middle(points: Array, position: Array) -> Array:
    """Vector ``(3,)``, metres, from a position to the weighted mean of the ``points (N, 3)`` around it; near points and
    points at the same height weigh more."""
    arm = points - position
    weight = np.exp(-0.5 * (arm[:, 2] / 1.0) ** 2) / (0.25 + (arm[:, :2] ** 2).sum(axis=1))
    return np.asarray((weight @ arm) / max(float(weight.sum()), 1e-12))


def bearing_of_middle(points: Array, position: Array) -> float:
    """Heading, radians, from a position to the middle of the structure around it."""
    x, y, _ = vector_to_middle(points, position)
    return float(np.arctan2(y, x))


def towards_nearest(points: Array, position: Array) -> Array:
    """Horizontal unit vector ``(2,)`` towards the nearest structure at about the same height."""
    arm = points - position
    arm = arm[np.abs(arm[:, 2]) < 1.0, :2] if (np.abs(arm[:, 2]) < 1.0).any() else arm[:, :2]
    distance = np.maximum(np.hypot(*arm.T), 1e-6)
    weight = np.exp(-(distance - np.percentile(distance, 5)) / NEAR_M) / distance
    direction = weight @ arm
    return np.asarray(direction / max(float(np.hypot(*direction)), 1e-9))


def distance_ahead(points: Array, position: Array, ahead: Array) -> float:
    """Horizontal distance to the nearest structure in the direction ``ahead (2,)``, at about the same height."""
    arm = points - position
    x, y = arm[:, :2] @ ahead, arm[:, :2] @ np.array([-ahead[1], ahead[0]])
    near = (np.abs(arm[:, 2]) < 0.7) & (x > 0) & (np.abs(y) < np.maximum(x, 0.7))
    if near.sum() < 5:
        return float(np.hypot(*vector_to_middle(points, position)[:2]))
    return float(np.percentile(np.hypot(x[near], y[near]), 5))
