"""Flight paths: polylines along the tower, with the heading at each point."""

import numpy as np
from scipy.ndimage import uniform_filter1d

from steelnb.settings import FlightSettings, TowerSettings
from steelnb.simulation.tower import half_width
from steelnb.types import Array


def waypoints(flight: FlightSettings, tower: TowerSettings) -> Array:
    """Corner points of the flight's path, ``(N, 3)`` metres in the world frame.

    ``zigzag`` zigzags up in front of the face y < 0; ``loops`` flies rectangular loops around the body. Both keep
    ``standoff_m`` from the body at every height. Of a ``planned`` flight it is the place of the start.
    """
    heights = np.linspace(flight.height_min_m, flight.height_max_m, flight.levels)
    points: list[tuple[float, float, float]] = []
    for level, z in enumerate(heights):
        half = half_width(tower, z)
        away = half + flight.standoff_m
        if flight.trajectory == "planned":
            return np.array([(0.0, -away, z)])
        if flight.trajectory == "zigzag":
            side = 0.8 * half * (-1) ** level
            points += [(-side, -away, z), (side, -away, z)]
        else:
            points += [(0, -away, z), (away, -away, z), (away, away, z), (-away, away, z), (-away, -away, z)]
            points += [(0, -away, z)]
    return np.array(points)


def heading(flight: FlightSettings, x: float, y: float) -> float:
    """Heading (radians, 0 along x) that the drone holds at a position: along y, or to the tower's axis."""
    return np.pi / 2 if flight.trajectory == "zigzag" else float(np.arctan2(-y, -x))


def setpoints(flight: FlightSettings, tower: TowerSettings, steps: int, step_s: float) -> tuple[Array, Array]:
    """Position and velocity to follow at each step, each ``(steps, 3)``: the path at ``speed_m_s``, then a hover.

    Two moving averages of a second round the corners, so that the drone leans into them instead of braking.
    """
    corner = waypoints(flight, tower)
    arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corner, axis=0), axis=1)))
    travelled = np.arange(steps) * step_s * flight.speed_m_s
    position = np.stack([np.interp(travelled, arc, corner[:, axis]) for axis in range(3)], axis=1)
    for _ in range(2):
        position = uniform_filter1d(position, max(1, round(1.0 / step_s)), axis=0, mode="nearest")
    return position, np.gradient(position, step_s, axis=0)
