"""What a Time-of-Flight camera would see of the map from a pose: returns, and their information about that pose.

Of a mapped voxel with the unit normal n at the distance r along the unit ray d, a pinhole camera whose pixel is ω wide
on its image plane sees ``a |n · d| / (r² cos³θ ω²)`` pixels, a being the voxel's area and θ the angle from the optical
axis. Each holds the information of a range (`steelnb.metrics.limit`, after Censi, "On achievable accuracy for
range-finder localization", ICRA 2007). Voxels fade out towards the borders of the image and of the range, so that both
numbers have derivatives by the pose; what hides what is not reckoned with, since one sees through a lattice.
"""

from typing import NamedTuple

import numpy as np

from steelnb.types import Array

POSE = 4
"""x, y, z and yaw in the axes of the world; metres, and radians times `ARM_M`."""
ARM_M = 1.0
"""A turn counts as much as the shift that it makes at this distance."""
SLOPE_MIN = 0.17
"""Cosine of the incidence on surfaces seen at 80°: more slanted ones hold no more information (their spots are no
points)."""
FADE = 0.1
"""Share of the image and of the range over which voxels fade out."""
STEP = np.array([0.1, 0.1, 0.1, 0.1])
"""For derivatives: a voxel's edge."""


class Camera(NamedTuple):
    """What a planner knows of its camera, whose optical axis is the sensor's x axis: tangents of half its fields of
    view, number of pixels, largest range (m), standard deviation of a range, the larger of one in metres and one in
    proportion to it, and mount ``(4, 4)``."""

    tan_horizontal: float
    tan_vertical: float
    pixels: int
    range_max_m: float
    sigma_floor_m: float
    sigma_relative: float
    T_drone_sensor: Array


class Outlook(NamedTuple):
    """Of K poses: expected returns ``(K,)`` and the information ``(K, 4, 4)`` of the scan about each."""

    returns: Array
    information: Array

    @property
    def sigma(self) -> Array:
        """Standard deviation ``(K,)`` of the pose along the direction least seen; infinite where one is not seen."""
        least = np.maximum(np.linalg.eigvalsh(self.information)[:, 0], 0.0)
        with np.errstate(divide="ignore"):
            return np.asarray(1 / np.sqrt(least))


class View(NamedTuple):
    """M points from K poses: ``arm (K, M, 3)`` from the camera, world axes; depth ``ahead`` and ``distance``, metres;
    and how far each is in view, ``inside``, from 0 to 1, ``(K, M)``."""

    arm: Array
    ahead: Array
    distance: Array
    inside: Array


def into_view(points: Array, T_world_sensor: Array, camera: Camera) -> View:
    """Where ``points (M, 3)`` are for a camera at ``T_world_sensor (K, 4, 4)``, whatever hides them."""
    arm = points[None] - T_world_sensor[:, None, :3, 3]
    x, y, z = np.einsum("kmi,kij->jkm", arm, T_world_sensor[:, :3, :3])
    distance = np.sqrt(x * x + y * y + z * z)
    ahead = np.maximum(x, 1e-3)
    inside = (
        _fade(1 - np.abs(y) / (ahead * camera.tan_horizontal))
        * _fade(1 - np.abs(z) / (ahead * camera.tan_vertical))
        * _fade(1 - distance / camera.range_max_m)
        * (x > 0.1)
    )
    return View(arm, ahead, distance, inside)


def outlook(points: Array, normal: Array, area_m2: float, T_world_drone: Array, camera: Camera) -> Outlook:
    """Outlook from poses ``(K, 4, 4)`` on voxels ``points (M, 3)`` with unit ``normal (M, 3)``, each of one area."""
    T = T_world_drone @ camera.T_drone_sensor
    arm, ahead, distance, inside = into_view(points, T, camera)
    slope = np.maximum(np.abs(np.einsum("kmi,mi->km", arm, normal)) / np.maximum(distance, 1e-9), SLOPE_MIN)
    plane = 4 * camera.tan_horizontal * camera.tan_vertical / camera.pixels
    returns = inside * np.minimum(area_m2 * slope * distance / (ahead**3 * plane), 1e4)
    # From the drone, about whose place the heading turns.
    from_drone = points[None] - T_world_drone[:, None, :3, 3]
    turn = from_drone[..., 0] * normal[:, 1] - from_drone[..., 1] * normal[:, 0]
    gradient = np.concatenate([np.broadcast_to(normal, arm.shape), turn[..., None] / ARM_M], axis=2)
    sigma_m = np.maximum(camera.sigma_floor_m, camera.sigma_relative * distance)
    weight = returns / (slope * sigma_m) ** 2
    return Outlook(returns.sum(axis=1), np.einsum("km,kmi,kmj->kij", weight, gradient, gradient))


def around(T_world_drone: Array) -> Array:
    """A pose ``(4, 4)`` and those one `STEP` along x, y, z and yaw from it, ``(5, 4, 4)``."""
    poses = np.tile(T_world_drone, (1 + POSE, 1, 1))
    poses[[1, 2, 3], [0, 1, 2], 3] += STEP[:3]
    c, s = np.cos(STEP[3] / ARM_M), np.sin(STEP[3] / ARM_M)
    poses[4, :3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ T_world_drone[:3, :3]
    return poses


def _fade(margin: Array) -> Array:
    """0 below 0, 1 above `FADE`, smooth between."""
    share = np.clip(margin / FADE, 0, 1)
    return np.asarray(share * share * (3 - 2 * share))
