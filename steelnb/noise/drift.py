"""Drift of a pose estimate: the report's Algorithm 1, its constant drift, and its yaw random walk."""

import math

import numpy as np

from steelnb import rng
from steelnb.config import NoiseSettings
from steelnb.datatypes import Array, Trajectory


def drifting(truth: Trajectory, settings: NoiseSettings, seed: int) -> Trajectory:
    """The trajectory as a drifting estimator would give it; zero drift at the first stamp.

    Position errors are sums over the steps of the trajectory (125 Hz in simulation) in the world frame; yaw noise
    turns the heading about the world's z axis and leaves the position alone. Each noise has a stream of its own
    (``random-walk``, ``constant-drift``, ``yaw-random-walk``), so that a sum contains its parts unchanged.
    """
    steps = len(truth) - 1
    walk = settings.random_walk_m * rng.stream(seed, "random-walk").standard_normal((steps, 3))
    step = settings.constant_drift_m * random_direction(rng.stream(seed, "constant-drift"))
    if settings.constant_drift_per_axis:
        step = step * math.sqrt(3)
    yaw = settings.yaw_random_walk_rad * rng.stream(seed, "yaw-random-walk").standard_normal(steps)

    T_world_drone = truth.T_world_drone.copy()
    T_world_drone[1:, :3, 3] += np.cumsum(walk + step, axis=0)
    heading = np.append(0.0, np.cumsum(yaw))
    turn = np.zeros((len(truth), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(heading)
    turn[:, 1, 0] = np.sin(heading)
    turn[:, 0, 1] = -turn[:, 1, 0]
    turn[:, 2, 2] = 1.0
    T_world_drone[:, :3, :3] = turn @ T_world_drone[:, :3, :3]
    return Trajectory(truth.stamp_s, T_world_drone)


def random_direction(stream: np.random.Generator) -> Array:
    """Unit vector ``(3,)``, uniform on the sphere."""
    vector = stream.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def random_walk_rms_m(settings: NoiseSettings, stamp_s: Array, rate_hz: float = 125.0) -> Array:
    """Root mean square length ``(N,)`` of the 3D random walk after ``stamp_s``: σ·√(3·rate·t)."""
    return np.asarray(settings.random_walk_m * np.sqrt(3 * rate_hz * stamp_s))
