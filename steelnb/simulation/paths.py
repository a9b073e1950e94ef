"""Flight paths with headings: through waypoints, or polylines along the tower."""

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from steelnb.core.types import Array
from steelnb.settings import FlightSettings, TowerSettings
from steelnb.simulation.tower import Tower, half_width


def path(flight: FlightSettings, tower: TowerSettings) -> tuple[Array, Array]:
    """Corners ``(N, 3)`` of the path of a flight without waypoints, world frame, and the path length ``(N,)`` at each
    corner, metres.

    ``zigzag`` climbs in zigzags before the face y < 0; ``loops`` flies rectangular loops around the body. Both keep
    ``standoff_m`` from the body at every height. For a ``planned`` flight, only the starting point is returned.
    """
    heights = np.linspace(flight.height_min_m, flight.height_max_m, flight.levels)
    points: list[tuple[float, float, float]] = []
    for level, z in enumerate(heights):
        half = half_width(tower, z)
        reach = half + flight.standoff_m
        if flight.trajectory == "planned":
            return np.array([(0.0, -reach, z)]), np.zeros(1)
        if flight.trajectory == "zigzag":
            side = 0.8 * half * (-1) ** level
            points += [(-side, -reach, z), (side, -reach, z)]
        else:
            points += [(0, -reach, z), (reach, -reach, z), (reach, reach, z), (-reach, reach, z), (-reach, -reach, z)]
            points += [(0, -reach, z)]
    corner = np.array(points)
    return corner, np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corner, axis=0), axis=1)))


def heading(flight: FlightSettings, x: float, y: float) -> float:
    """Heading (radians, 0 along x) at a position of a path without waypoints: along y for ``zigzag``, else towards the
    tower's axis."""
    return np.pi / 2 if flight.trajectory == "zigzag" else float(np.arctan2(-y, -x))


def setpoints(flight: FlightSettings, tower: TowerSettings, steps: int, step_s: float) -> tuple[Array, Array]:
    """Position and velocity setpoints, each ``(steps, 3)``, on a path without waypoints: after ``still_s`` along it at
    ``speed_m_s``, then hovering at its end.

    Two moving averages over one second round the corners, so the drone need not brake there.
    """
    corner, arc_m = path(flight, tower)
    travelled = np.maximum(np.arange(steps) * step_s - flight.still_s, 0.0) * flight.speed_m_s
    position = np.stack([np.interp(travelled, arc_m, axis) for axis in corner.T], axis=1)
    for _ in range(2):
        position = uniform_filter1d(position, max(1, round(1.0 / step_s)), axis=0, mode="nearest")
    return position, np.gradient(position, step_s, axis=0)


def pose_on_path(tower: Tower, flight: FlightSettings, share: float, lean: Array | None = None) -> Array:
    """Pose ``T_world_sensor (4, 4)``, with the flight's heading, at a ``share`` (0 to 1) of the path's length, or of
    its duration if it has waypoints. ``lean (3,)`` adds yaw, pitch and roll, radians."""
    if flight.waypoints:
        *position, yaw = minimum_jerk(flight, np.array([share * flight.duration_s]))[0][0]
    else:
        corner, arc_m = path(flight, tower.settings)
        position = [np.interp(share * arc_m[-1], arc_m, axis) for axis in corner.T]
        yaw = heading(flight, *position[:2])
    T_world_sensor = np.eye(4)
    turn = np.array([yaw, 0.0, 0.0]) + (0.0 if lean is None else lean)
    T_world_sensor[:3, :3] = Rotation.from_euler("ZYX", turn).as_matrix()
    T_world_sensor[:3, 3] = position
    return T_world_sensor


def minimum_jerk(flight: FlightSettings, time_s: Array) -> tuple[Array, Array, Array]:
    """Pose x, y, z, heading (metres, radians) and its first two derivatives, each ``(N, 4)``, at ``time_s (N,)``, of a
    flight that begins through waypoints after ``still_s``.

    Between waypoints, the drone moves with minimum jerk from rest to rest: after a share τ of the time, it has done a
    share 10τ³ − 15τ⁴ + 6τ⁵ of the distance (Flash, Hogan, J. Neuroscience 5, 1985). The heading turns the shorter way;
    half turns are anticlockwise.
    """
    point = np.array(flight.waypoints)
    seconds, end_s = point[1:, 4], flight.still_s + np.cumsum(point[:, 4])
    corner = np.column_stack([point[:, :3], np.radians(point[:, 3])])
    step = np.diff(corner, axis=0)
    step[:, 3] = np.pi - (np.pi - step[:, 3]) % (2 * np.pi)
    corner[1:, 3] = corner[0, 3] + np.cumsum(step[:, 3])
    k = np.clip(np.searchsorted(end_s, time_s, side="right") - 1, 0, len(step) - 1)
    share = np.clip((time_s - end_s[k]) / seconds[k], 0.0, 1.0)[:, None]
    pose = corner[k] + step[k] * share**3 * (10 - 15 * share + 6 * share**2)
    rate = step[k] / seconds[k, None] * 30 * share**2 * (1 - share) ** 2
    return pose, rate, step[k] / seconds[k, None] ** 2 * 60 * share * (1 - share) * (1 - 2 * share)
