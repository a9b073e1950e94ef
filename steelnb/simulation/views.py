"""Single scans of a tower from poses along a flight's path, without the flight, for comparing segmentations."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.settings import FlightSettings, TofSettings
from steelnb.simulation.exposure import MOMENTS
from steelnb.simulation.paths import heading, minimum_jerk, waypoints
from steelnb.simulation.sections import GROUND
from steelnb.simulation.tof import TofCamera, measured_ranges
from steelnb.simulation.tower import Tower
from steelnb.types import Array, IntArray


@dataclass(frozen=True)
class View:
    """Returns of one scan in the world frame: ``points (N, 3)`` as measured, ``surface (N, 3)`` where they truly lie,
    and the ``member (N,)`` each belongs to, or `PLATE`. ``across (3,)`` is the direction to the right, level."""

    points: Array
    surface: Array
    member: IntArray
    across: Array


class Viewer:
    """Takes single scans of a tower; a sensor with faults is the one of seed 0."""

    def __init__(self, tower: Tower, tof: TofSettings) -> None:
        self.tower, self.tof = tower, tof
        self._camera = TofCamera(tower, tof, seed=0)

    def view(self, T_world_sensor: Array, noise: np.random.Generator, floor_m: float = 0.3) -> View:
        """One scan, without the ground and all that is measured below ``floor_m``."""
        seen = self._camera.expose(np.tile(T_world_sensor, (len(MOMENTS), 1, 1)), noise)  # held still
        measured = measured_ranges(seen.range_m, self.tof, noise, self._camera.faults, seen.as_far_as_m)
        returned = np.isfinite(measured) & np.isfinite(seen.exact_m)
        member = seen.member[returned]
        rotation, position = T_world_sensor[:3, :3], T_world_sensor[:3, 3]
        along = self._camera.ray[returned] @ rotation.T
        points = measured[returned][:, None].astype(np.float64) * along + position
        surface = seen.exact_m[returned][:, None].astype(np.float64) * along + position
        kept = (member != GROUND) & (points[:, 2] >= floor_m)
        level = np.array([-rotation[0, 1], -rotation[1, 1], 0.0])
        return View(points[kept], surface[kept], member[kept], level / np.linalg.norm(level))


def pose_on_path(tower: Tower, flight: FlightSettings, share: float, lean: Array | None = None) -> Array:
    """``T_world_sensor (4, 4)`` at a share, 0–1, of the path of a flight (by waypoints: of its time), with its heading.

    ``lean (3,)`` adds yaw, pitch and roll in radians.
    """
    if flight.waypoints:
        *position, ahead = minimum_jerk(flight, np.array([share * flight.duration_s]))[0][0]
    else:
        corner = waypoints(flight, tower.settings)
        arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corner, axis=0), axis=1)))
        position = [np.interp(share * arc[-1], arc, corner[:, axis]) for axis in range(3)]
        ahead = heading(flight, *position[:2])
    yaw, pitch, roll = np.array([ahead, 0.0, 0.0]) + (0.0 if lean is None else lean)
    T_world_sensor = np.eye(4)
    T_world_sensor[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    T_world_sensor[:3, 3] = position
    return T_world_sensor
