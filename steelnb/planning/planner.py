"""A pilot that follows a reference along a structure, and keeps the structure in view.

At each command it knows the map so far, an estimate of the pose, and its camera. A reference wishes for a velocity and
a turn; barriers (`steelnb.planning.barriers`) change them as little as keeps the drone off the structure, the structure
in view, and the information of the coming scan from falling far below what is usual.
"""

from dataclasses import dataclass, field

import numpy as np

from steelnb.errors import InputError
from steelnb.fusion.poses import yaw_of
from steelnb.planning.barriers import Barrier, nearest_command
from steelnb.planning.bearings import distance_ahead, middle_of, towards_nearest, turn_to
from steelnb.planning.coverage import Coverage
from steelnb.planning.outlook import ARM_M, STEP, Camera, Outlook, around, outlook
from steelnb.points import VoxelMap, voxel_grid
from steelnb.points.covariances import normals
from steelnb.settings import FlightSettings
from steelnb.types import Array, Segments

VOXEL_M = 0.1
AREA_M2 = VOXEL_M**2 / 3
"""Steel in a voxel, until scans have told: bars are narrower than voxels and lie across several."""
AREA_GAIN = 0.2
"""Share of what a scan tells about that area."""
VOXELS_MAX = 600
"""Voxels of an outlook; of more, every second, third, … is taken."""
CLEARANCE_M = 0.45
"""Least distance of the drone's middle from steel: half its diagonal is 0.18 m, and it swings in gusts."""
HIDDEN_M = 0.5
"""A mapped bar may go on behind the edge of the map by this much."""
BEARING_SHARE = 0.5
"""Largest bearing of the middle of the structure in sight, as a share of half the field of view."""
SIGHT_MIN = 60
"""Voxels of a scan below which sight is lost."""
SHARE_MIN = 0.5
"""Expected returns, and the inverse of the coming pose's standard deviation, stay above this share of their medians so
far."""
USUAL_MIN = 10
"""Decisions before there is a median."""
WEIGHT = {"structure": 1e4, "height": 1e3, "sight": 30.0, "information": 30.0}
"""Of not keeping a barrier, beside 1 of a velocity that differs by 1 m/s from the wish."""
GAIN_1_S = {"turn": 1.5, "distance": 0.8, "height": 0.5}
"""From an error to the wished rate."""
COST = {goal: np.array([1.0, 1.0, 1.0, turn]) for goal, turn in (("around", 0.3), ("whole", 0.3), ("face", 30.0))}
"""Of changing the wished velocity and yaw rate: up a face the heading stays."""
TURN_MAX_RAD_S = 1.0
BRAKE_M = 0.5
"""Way around the structure that is left to a viewpoint below which the drone slows down."""
SEARCH_RAD_S = 0.5
SEARCH_STOP_S, SEARCH_TURN_S = 1.0, 4.0
"""After sight is lost: stop, then turn to where the map is, then go back along the path."""


@dataclass(frozen=True)
class Decision:
    """``velocity (3,)`` along the axes of the level drone, m/s, and ``yaw_rate``, rad/s; ``state`` is "wait", "follow",
    "stop", "turn", "return", "search" or "end", ``reason`` why; ``returns`` and ``sigma`` are the outlook's from here.
    """

    velocity: Array
    yaw_rate: float
    state: str
    reason: str = ""
    returns: float = np.nan
    sigma: float = np.nan


@dataclass
class Planner:
    """Decides ten times a second; `see` adds a scan to its map.

    ``flight``: what to fly, with a table ``planner``; raises `InputError` for one that none steers. ``camera``: what
    its sensor sees. All poses are estimates, in the world frame of the map.
    """

    flight: FlightSettings
    camera: Camera
    map: VoxelMap = field(default_factory=lambda: VoxelMap(VOXEL_M))
    bars: Segments = field(default_factory=Segments.empty)

    def __post_init__(self) -> None:
        if self.flight.planner is None:
            raise InputError(f"trajectory {self.flight.trajectory!r}: expected 'planned'")
        self.task = self.flight.planner
        self._near = np.zeros((0, 3))  # the last scan, world frame
        self._in_sight, self._area_m2 = 0, AREA_M2
        self._scans = 0
        self._lost_s: float | None = None
        self._begun: tuple[float, float] | None = None  # time and heading of the first decision
        self._turned = 0.0
        self._last_s = 0.0
        self._sigmas: list[float] = []
        self._returns: list[float] = []
        self._path: list[Array] = []  # poses from which the structure was seen well
        self._side, self._blocked_s, self._climb_to = 1.0, 0.0, self.flight.height_min_m
        f = self.flight
        self.coverage = Coverage(self.camera, f.standoff_m, f.speed_m_s, (f.height_min_m, f.height_max_m))

    def see(self, points: Array, T_world_drone: Array, bars: Segments, returns: int) -> None:
        """Add the preprocessed points ``(N, 3)`` of a scan, drone frame, at its corrected pose; ``bars`` are those
        mapped so far, world frame; ``returns`` counts the scan's returns before they were thinned."""
        self._scans += 1
        world = points @ T_world_drone[:3, :3].T + T_world_drone[:3, 3]
        self._near = voxel_grid(world, VOXEL_M) if len(world) else world
        self._in_sight, self.bars = len(self._near), bars
        if self._in_sight >= SIGHT_MIN:
            slots = self.map.insert(world)
            self.map.update_shapes(slots)
            self.coverage.add(self.map, slots, T_world_drone[:3, 3])
            foretold = outlook(*self._around(T_world_drone[:3, 3]), T_world_drone[None], self.camera).returns[0]
            if foretold > 0 and returns > 0:
                self._area_m2 *= float(np.clip(returns / foretold, 0.2, 5.0)) ** AREA_GAIN
            if not self._path or np.linalg.norm(self._path[-1][:3, 3] - T_world_drone[:3, 3]) > 0.2:
                self._path.append(T_world_drone.copy())

    def decide(self, stamp_s: float, T_world_drone: Array) -> Decision:
        """The command for the next tenth of a second from an estimate ``(4, 4)`` of the pose."""
        yaw = float(yaw_of(T_world_drone[:3, :3]))
        self._begun = self._begun or (stamp_s, yaw)
        passed_s, self._last_s = stamp_s - self._last_s, stamp_s
        if not self._scans:
            return Decision(np.zeros(3), 0.0, "wait", "no scan yet")
        if not len(self.map):
            self._turned += SEARCH_RAD_S * passed_s
            if self._turned > 2 * np.pi:
                return Decision(np.zeros(3), 0.0, "end", "no bar seen in a full turn")
            return Decision(np.zeros(3), SEARCH_RAD_S, "search", "no structure in sight")
        if self._in_sight >= SIGHT_MIN:
            self._lost_s = None
        elif self._lost_s is None:
            self._lost_s = stamp_s
        position = T_world_drone[:3, 3]
        points, normal, area_m2 = self._around(position)
        seen = outlook(points, normal, area_m2, around(T_world_drone), self.camera)
        if self.task.goal == "whole" and self._lost_s is None and not self.coverage.update(stamp_s, self.map, position):
            return Decision(np.zeros(3), 0.0, "end", self.coverage.summary())
        wished, state = self._wish(stamp_s, position, yaw, points)
        barriers = [*self._structure(position), *self._heights(position)]
        if state == "follow":
            if np.isfinite(seen.sigma[0]):
                self._sigmas.append(float(seen.sigma[0]))
                self._returns.append(float(seen.returns[0]))
            barriers += self._sight(position, yaw, points, seen)
        u = nearest_command(wished, COST[self.task.goal], barriers)
        speed = np.linalg.norm(u[:3])
        u[:3] *= min(1.0, 1.5 * self.flight.speed_m_s / max(float(speed), 1e-9))
        self._advance(u, wished, passed_s, float(position[2]))
        c, s = np.cos(yaw), np.sin(yaw)
        velocity = np.array([c * u[0] + s * u[1], -s * u[0] + c * u[1], u[2]])
        turn = float(np.clip(u[3], -TURN_MAX_RAD_S, TURN_MAX_RAD_S))
        return Decision(velocity, turn, state, "", float(seen.returns[0]), float(seen.sigma[0]))

    def _around(self, position: Array) -> tuple[Array, Array, float]:
        """Voxels of the map within the camera's range, thinned, and their normals, ``(M, 3)`` each; and the area that
        each stands for."""
        chosen = self.map.near(position, self.camera.range_max_m)
        every = 1 + len(chosen) // VOXELS_MAX
        chosen = chosen[::every]
        return self.map.means(chosen), normals(self.map.shapes(chosen)), every * self._area_m2

    def _wish(self, stamp_s: float, position: Array, yaw: float, points: Array) -> tuple[Array, str]:
        """Velocity (world axes) and yaw rate of the reference, and what it is doing."""
        if self._lost_s is not None:
            return self._recover(stamp_s - self._lost_s, position, yaw, points)
        assert self._begun is not None
        flight, (begun_s, first_yaw) = self.flight, self._begun
        target = self.coverage.target
        if self.task.goal == "face":
            facing = np.array([np.cos(first_yaw), np.sin(first_yaw)])
            along = self._side * np.array([facing[1], -facing[0]])
            up, rate = GAIN_1_S["height"] * (self._climb_to - position[2]), GAIN_1_S["turn"] * turn_to(first_yaw - yaw)
        else:
            climb = (flight.height_max_m - flight.height_min_m) / flight.duration_s
            round_by, height = 1.0, flight.height_min_m + climb * (stamp_s - begun_s)
            if target:
                left_m = target.turn(position) * float(np.hypot(*(position[:2] - target.middle)))
                round_by, climb, height = float(np.clip(left_m / BRAKE_M, -1, 1)), 0.0, target.position[2]
            facing, middle = towards_nearest(points, position), middle_of(points, position)
            along = round_by * np.array([facing[1], -facing[0]])
            rate = GAIN_1_S["turn"] * turn_to(np.arctan2(middle[1], middle[0]) - yaw)
            up = climb + GAIN_1_S["height"] * (height - position[2])
        up = float(np.clip(up, -flight.speed_m_s, flight.speed_m_s))
        distance = distance_ahead(points, position, facing)
        inward = float(np.clip(GAIN_1_S["distance"] * (distance - flight.standoff_m), -0.5, 0.5))
        level = flight.speed_m_s * along + inward * facing
        return np.array([*level, up, rate]), "follow"

    def _recover(self, lost_s: float, position: Array, yaw: float, points: Array) -> tuple[Array, str]:
        if lost_s < SEARCH_STOP_S or not self._path:
            return np.zeros(4), "stop"
        if lost_s < SEARCH_STOP_S + SEARCH_TURN_S and len(points):
            middle = middle_of(points, position)
            return np.array([0, 0, 0, GAIN_1_S["turn"] * turn_to(np.arctan2(middle[1], middle[0]) - yaw)]), "turn"
        while len(self._path) > 1 and np.linalg.norm(self._path[-1][:3, 3] - position) < 0.2:
            self._path.pop()
        back = self._path[-1]
        way = back[:3, 3] - position
        way *= min(1.0, 0.5 * self.flight.speed_m_s / max(float(np.linalg.norm(way)), 1e-9) + 0.2)
        return np.array([*way, GAIN_1_S["turn"] * turn_to(float(yaw_of(back[:3, :3])) - yaw)]), "return"

    def _structure(self, position: Array) -> list[Barrier]:
        """The nearest obstacle in each of 26 directions: voxels of the map, returns of the last scan, and what bars may
        be beyond their mapped ends."""
        beyond = HIDDEN_M * self.bars.direction
        obstacles = np.concatenate([
            self.map.means(self.map.near(position, 2.0)), self._near, self.bars.start - beyond, self.bars.end + beyond,
        ])  # fmt: skip
        away = position - obstacles
        distance = np.linalg.norm(away, axis=1)
        near = np.flatnonzero(distance < 2.0)
        near = near[np.argsort(distance[near])]
        sector = (np.round(away[near] / distance[near, None] * 1.2).astype(int) + 1) @ [9, 3, 1]
        first = near[np.unique(sector, return_index=True)[1]]
        return [
            Barrier(np.append(away[k] / distance[k], 0.0), distance[k] - CLEARANCE_M, 1.0, WEIGHT["structure"])
            for k in first
        ]

    def _heights(self, position: Array) -> list[Barrier]:
        up = np.array([0.0, 0.0, 1.0, 0.0])
        low, high = position[2] - self.flight.height_min_m + 0.2, self.flight.height_max_m + 0.2 - position[2]
        return [Barrier(up, low, 1.0, WEIGHT["height"]), Barrier(-up, high, 1.0, WEIGHT["height"])]

    def _sight(self, position: Array, yaw: float, points: Array, seen: Outlook) -> list[Barrier]:
        """Bearing of the structure, expected returns, and the information of the coming scan."""
        found = []
        if self.task.keep_view:
            middle = middle_of(points, position)
            level = max(float(np.hypot(*middle[:2])), 0.3)
            bearing = turn_to(np.arctan2(middle[1], middle[0]) - yaw)
            # By a step (dx, dy) of the drone the azimuth of the middle turns by (m_y dx − m_x dy) / |m|².
            rate = np.array([middle[1] / level**2, -middle[0] / level**2, 0.0, -1.0])
            most = BEARING_SHARE * np.arctan(self.camera.tan_horizontal)
            found = [
                Barrier(rate, bearing + most, 1.0, WEIGHT["sight"]),
                Barrier(-rate, most - bearing, 1.0, WEIGHT["sight"]),
            ]
        if len(self._sigmas) < USUAL_MIN:
            return found
        if self.task.keep_view:
            log = np.log(np.maximum(seen.returns, 1.0))
            least = np.log(max(SHARE_MIN * float(np.median(self._returns)), 1.0))
            found.append(Barrier(_slope(log), log[0] - least, 1.0, WEIGHT["sight"]))
        if self.task.keep_information and np.isfinite(seen.sigma).all():
            log = -np.log(seen.sigma)
            least = np.log(SHARE_MIN / np.median(self._sigmas))
            found.append(Barrier(_slope(log), log[0] - least, 1.0, WEIGHT["information"]))
        return found

    def _advance(self, u: Array, wished: Array, passed_s: float, height_m: float) -> None:
        """Of a flight up a face: at the edge of the structure go up a level, and back."""
        if self.task.goal != "face" or not np.hypot(*wished[:2]) > 0:
            return
        share = float(u[:2] @ wished[:2] / (wished[:2] @ wished[:2]))
        self._blocked_s = self._blocked_s + passed_s if share < 0.3 else 0.0
        if self._blocked_s > 1.0 and height_m > self._climb_to - 0.2:
            rise = (self.flight.height_max_m - self.flight.height_min_m) / (self.flight.levels - 1)
            self._climb_to = min(self._climb_to + rise, self.flight.height_max_m)
            self._side, self._blocked_s = -self._side, 0.0


def _slope(value: Array) -> Array:
    """Derivatives by velocity and yaw rate of what `around` was evaluated at."""
    by = (value[1:] - value[0]) / STEP
    by[3] *= ARM_M
    return np.asarray(by)
