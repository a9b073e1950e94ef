"""Drift of a pose estimate: the report's Algorithm 1, its constant drift, its yaw random walk, and tilt."""

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb import rng
from steelnb.settings import Noise
from steelnb.types import Array, Trajectory

TILT_S = 30.0
"""Correlation time of the error of roll and pitch."""


def drifting(truth: Trajectory, settings: Noise, seed: rng.Seed) -> Trajectory:
    """A trajectory ``T_world_drone (N, 4, 4)`` with the drift of a pose estimate; zero drift at the first stamp.

    Position errors, metres in the world frame, are sums over the steps of the trajectory (125 Hz in simulation): the
    random walk of the report's Algorithm 1 and a constant step. Yaw noise, radians, turns the heading about the world's
    z axis and leaves the position alone. Tilt turns roll and pitch, about the world's x and y axes, by a first-order
    Gauss-Markov process that begins at zero and has a correlation time of 30 s: what an attitude filter leaves when an
    accelerometer's bias wanders. Each noise has a stream of its own (``random-walk``, ``constant-drift``,
    ``yaw-random-walk``, ``tilt``) of the seed, so that a sum contains its parts unchanged.

    The seed ``report`` draws from the original's generator in its order: three normal numbers a step for the random
    walk, then one for the heading if that walks, too; the constant step is its first three numbers. Other levels than
    the report's raise `InputError`.
    """
    return drifted(truth, drift_errors(truth.stamp_s, settings, seed))


def drifted(truth: Trajectory, error: Array) -> Trajectory:
    """A piece of a true trajectory with the errors ``(N, 4, 4)`` of its stamps, as `drift_errors` gives them."""
    T_world_drone = truth.T_world_drone.copy()
    T_world_drone[:, :3, 3] += error[:, :3, 3]
    T_world_drone[:, :3, :3] = error[:, :3, :3] @ T_world_drone[:, :3, :3]
    return Trajectory(truth.stamp_s, T_world_drone)


def drift_errors(stamp_s: Array, settings: Noise, seed: rng.Seed) -> Array:
    """Turn about the drone and shift ``(N, 4, 4)``, world axes, of `drifting` at each stamp; they do not depend on the
    flight."""
    steps = len(stamp_s) - 1
    if seed == "report":
        walk, step, yaw = _steps_of_the_report(settings, steps)
    else:
        walk = settings.random_walk_m * rng.stream(seed, "random-walk").standard_normal((steps, 3))
        direction = rng.stream(seed, "constant-drift").standard_normal(3)  # normalised: uniform on the sphere
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
    """Random steps of the position ``(steps, 3)``, its constant step ``(3,)`` and steps of the heading ``(steps,)``."""
    settings.check_report()
    constant = settings.constant_drift_m * rng.report_generator().standard_normal(3)  # not of the level's length
    drawn = rng.report_generator().standard_normal((steps, 4 if settings.yaw_random_walk_rad else 3))
    yaw = settings.yaw_random_walk_rad * drawn[:, -1]
    return settings.random_walk_m * drawn[:, :3], constant, yaw


def _tilt(stamp_s: Array, sigma_rad: float, seed: rng.Seed) -> Array:
    """Rotation vectors ``(N, 3)`` of the error of roll and pitch; the third component is 0."""
    if len(stamp_s) < 2:
        return np.zeros((len(stamp_s), 3))
    stays = np.exp(-float(np.median(np.diff(stamp_s))) / TILT_S)
    steps = rng.stream(seed, "tilt").standard_normal((len(stamp_s), 2))
    steps[0] = 0.0
    from scipy.signal import lfilter  # late: it takes a third of a second to import

    return np.pad(lfilter([sigma_rad * np.sqrt(1 - stays**2)], [1.0, -stays], steps, axis=0), ((0, 0), (0, 1)))


def random_walk_rms_m(settings: Noise, stamp_s: Array, rate_hz: float = 125.0) -> Array:
    """Root mean square length ``(N,)`` of the 3D random walk after ``stamp_s``: σ·√(3·rate·t)."""
    return np.asarray(settings.random_walk_m * np.sqrt(3 * rate_hz * stamp_s))
