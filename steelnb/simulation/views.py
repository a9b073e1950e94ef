"""Single scans of a tower from poses on a flight's path, without simulating the flight; for comparing segmentations."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.settings import FlightSettings
from steelnb.simulation.exposure import MOMENTS
from steelnb.simulation.paths import heading, minimum_jerk, path
from steelnb.simulation.sections import GROUND
from steelnb.simulation.tof import TofCamera
from steelnb.simulation.tower import Tower
from steelnb.types import Array, IntArray

FLOOR_M = 0.3


@dataclass(frozen=True)
class View:
    """Returns of one scan in the world frame: ``points (N, 3)`` as measured, ``surface (N, 3)``, their true positions,
    and ``member (N,)``, the member that each lies on, or `PLATE`. ``across (3,)``: horizontal unit vector to the
    right."""

    points: Array
    surface: Array
    member: IntArray
    across: Array


def take_view(camera: TofCamera, T_world_sensor: Array, noise: np.random.Generator) -> View:
    """One scan from a pose ``(4, 4)`` at rest, without the ground and all points measured below `FLOOR_M`."""
    measured, exposure = camera.measure(np.tile(T_world_sensor, (len(MOMENTS), 1, 1)), noise, noise)
    returned = np.isfinite(measured) & np.isfinite(exposure.exact_m)
    member = exposure.member[returned]
    rotation, position = T_world_sensor[:3, :3], T_world_sensor[:3, 3]
    direction = camera.ray[returned] @ rotation.T
    points = measured[returned][:, None].astype(np.float64) * direction + position
    surface = exposure.exact_m[returned][:, None].astype(np.float64) * direction + position
    kept = (member != GROUND) & (points[:, 2] >= FLOOR_M)
    level = np.array([-rotation[0, 1], -rotation[1, 1], 0.0])
    return View(points[kept], surface[kept], member[kept], level / np.linalg.norm(level))


def pose_on_path(tower: Tower, flight: FlightSettings, share: float, lean: Array | None = None) -> Array:
    """Pose ``T_world_sensor (4, 4)``, with the flight's heading, at a ``share`` from 0 to 1 of the length of its path
    or, if it has waypoints, of its duration. ``lean (3,)`` adds yaw, pitch and roll, radians."""
    if flight.waypoints:
        *position, yaw = minimum_jerk(flight, np.array([share * flight.duration_s]))[0][0]
    else:
        corner, arc_m = path(flight, tower.settings)
        position = [np.interp(share * arc_m[-1], arc_m, corner[:, axis]) for axis in range(3)]
        yaw = heading(flight, *position[:2])
    yaw, pitch, roll = np.array([yaw, 0.0, 0.0]) + (0.0 if lean is None else lean)
    T_world_sensor = np.eye(4)
    T_world_sensor[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    T_world_sensor[:3, 3] = position
    return T_world_sensor
