"""Drift of a pose estimate: the report's Algorithm 1, its constant drift, its yaw random walk, and tilt."""

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core import rng
from steelnb.core.types import Array, Trajectory
from steelnb.settings import Noise

TILT_S = 30.0
"""Correlation time of the error of roll and pitch."""


def drifting(truth: Trajectory, settings: Noise, seed: rng.Seed) -> Trajectory:
    """Add the drift of a pose estimate to the N poses of ``truth``; the drift is zero at the first stamp.

    Position errors, metres in the world frame, accumulate over the steps of the trajectory (125 Hz in simulation): the
    random walk of the report's Algorithm 1, and a constant step. Yaw noise, radians, rotates the heading about the
    world's z axis and does not change the position. Tilt rotates about the world's x and y axes by a first-order
    Gauss-Markov process that starts at zero and has a correlation time of 30 s, like the error of an attitude filter
    whose accelerometer bias wanders. Each noise has its own stream of the seed (``random-walk``, ``constant-drift``,
    ``yaw-random-walk``, ``tilt``), so adding one does not change the others.

    The seed ``report`` uses the original's generator and order of draws: per step three normal numbers for the random
    walk, then one for the heading if it also walks. The constant step takes the first three numbers. Levels other than
    the report's raise `InputError`.
    """
    return drifted(truth, drift_errors(truth.stamp_s, settings, seed))


def drifted(truth: Trajectory, error: Array) -> Trajectory:
    """Apply errors ``(N, 4, 4)`` of `drift_errors` to a piece of a true trajectory with the same stamps."""
    T_world_drone = truth.T_world_drone.copy()
    T_world_drone[:, :3, 3] += error[:, :3, 3]
    T_world_drone[:, :3, :3] = error[:, :3, :3] @ T_world_drone[:, :3, :3]
    return Trajectory(truth.stamp_s, T_world_drone)


def drift_errors(stamp_s: Array, settings: Noise, seed: rng.Seed) -> Array:
    """Errors ``(N, 4, 4)`` of `drifting` at each stamp: rotation about the drone and translation, in world axes. They
    do not depend on the flight."""
    steps = len(stamp_s) - 1
    if seed == "report":
        walk, step, yaw = _steps_of_the_report(settings, steps)
    else:
        walk = settings.random_walk_m * rng.stream(seed, "random-walk").standard_normal((steps, 3))
        direction = rng.stream(seed, "constant-drift").standard_normal(3)  # normalised, it is uniform on the sphere
        step = settings.constant_drift_m * (direction / np.linalg.norm(direction))
        yaw = settings.yaw_random_walk_rad * rng.stream(seed, "yaw-random-walk").standard_normal(steps)

    heading = np.append(0.0, np.cumsum(yaw))
    turn = np.tile(np.eye(3), (len(stamp_s), 1, 1))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(heading)
    turn[:, 1, 0] = np.sin(heading)
    turn[:, 0, 1] = -turn[:, 1, 0]
    if settings.tilt_rad:
        turn = turn @ Rotation.from_rotvec(_tilt(stamp_s, settings.tilt_rad, seed)).as_matrix()
    error = np.tile(np.eye(4), (len(stamp_s), 1, 1))
    error[1:, :3, 3] = np.cumsum(walk + step, axis=0)
    error[:, :3, :3] = turn
    return error


def _steps_of_the_report(settings: Noise, steps: int) -> tuple[Array, Array, Array]:
    """Random steps of the position ``(steps, 3)``, its constant step ``(3,)``, and steps of the heading
    ``(steps,)``."""
    settings.check_report()
    constant = settings.constant_drift_m * rng.report_generator().standard_normal(3)  # the report does not normalise
    drawn = rng.report_generator().standard_normal((steps, 4 if settings.yaw_random_walk_rad else 3))
    yaw = settings.yaw_random_walk_rad * drawn[:, -1]
    return settings.random_walk_m * drawn[:, :3], constant, yaw


def _tilt(stamp_s: Array, sigma_rad: float, seed: rng.Seed) -> Array:
    """Rotation vectors ``(N, 3)`` of the tilt; the third component is 0."""
    if len(stamp_s) < 2:
        return np.zeros((len(stamp_s), 3))
    decay = np.exp(-float(np.median(np.diff(stamp_s))) / TILT_S)
    steps = rng.stream(seed, "tilt").standard_normal((len(stamp_s), 2))
    steps[0] = 0.0
    from scipy.signal import lfilter  # imported late: it takes a third of a second

    return np.pad(lfilter([sigma_rad * np.sqrt(1 - decay**2)], [1.0, -decay], steps, axis=0), ((0, 0), (0, 1)))


def drift_size(stamp_s: Array, settings: Noise, seed: rng.Seed) -> Array:
    """Length ``(N,)`` of the position drift at each stamp, metres; if only the heading drifts, its absolute error,
    radians."""
    error = drift_errors(stamp_s, settings, seed)
    if turns_only(settings):
        return np.abs(np.unwrap(np.arctan2(error[:, 1, 0], error[:, 0, 0])))
    return np.asarray(np.linalg.norm(error[:, :3, 3], axis=1))


def drift_size_rms(stamp_s: Array, settings: Noise) -> Array:
    """Root mean square ``(N,)`` of `drift_size` that the model predicts after n steps at 125 Hz: σ·√(3n) for a random
    walk, n times the step for a constant drift, σ·√n for a yaw walk alone."""
    steps = 125.0 * stamp_s
    if turns_only(settings):
        return np.asarray(settings.yaw_random_walk_rad * np.sqrt(steps))
    return np.hypot(settings.random_walk_m * np.sqrt(3 * steps), settings.constant_drift_m * steps)


def turns_only(settings: Noise) -> bool:
    """Whether the heading walks and the position does not drift."""
    return settings.yaw_random_walk_rad > 0 and not (settings.random_walk_m or settings.constant_drift_m)
