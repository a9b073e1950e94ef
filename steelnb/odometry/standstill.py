"""Rest before take-off, as the readings of an IMU tell it: gyroscope bias and tilt, before anything moves.

A drone on the ground reads the bias of its gyroscope, and gravity with the bias of its accelerometer. Readings at rest
differ from each other by white noise alone, whose size the data sheet states (Skog, Händel, Nilsson, Rantakokko,
"Zero-velocity detection", IEEE T-BME 57, 2010). A flight at constant speed in calm air reads the same, so the drifting
prior must rest, too.
"""

from typing import NamedTuple

import numpy as np

from steelnb.core.geometry import cross_matrix
from steelnb.core.types import GRAVITY, Array, Imu, Trajectory
from steelnb.fusion.adjustment.factors import drift_variance
from steelnb.fusion.adjustment.imu_factors import FORCE, GYRO, ROTATION, VELOCITY
from steelnb.settings import ImuSettings

REST_MIN_S = 1.0
"""A shorter rest is not used: it could be the beginning of a slow motion."""
REST_MAX_S = 30.0
"""Only the last readings of a longer rest are used, since biases drift."""
WINDOW_S = 0.2
SIGMAS = 5.0
"""Bound on the difference between the mean of a window and that of the first `REST_MIN_S`, and on the prior's motion,
in standard deviations."""
SPREAD_MAX = 1.5
"""Bound on the variance of the readings, as a multiple of that of the data sheet's noise."""
SPEED_SIGMA_M_S = 0.005
"""Standard deviation of the velocity at rest: a motion that one window cannot exclude."""


class Rest(NamedTuple):
    """Means over a rest of ``seconds``: specific force ``(3,)``, m/s², and angular rate ``(3,)``, rad/s, in the drone
    frame."""

    seconds: float
    force: Array
    rate: Array


def find_rest(imu: Imu, noise: ImuSettings, begin_s: float, end_s: float) -> Rest | None:
    """The rest from ``begin_s`` to ``end_s``; None if it is shorter than `REST_MIN_S`, or if the readings show a motion
    in its last `REST_MAX_S`."""
    begin_s = max(begin_s, end_s - REST_MAX_S)
    first, last = np.searchsorted(imu.stamp_s, [begin_s, end_s], side="right")
    count = int(last - first)
    step_s = (end_s - begin_s) / max(count, 1)
    if end_s - begin_s < REST_MIN_S - 1e-6 or step_s > WINDOW_S / 4:
        return None
    force, rate = imu.specific_force[first:last], imu.angular_rate[first:last]
    length, reference = round(WINDOW_S / step_s), round(REST_MIN_S / step_s)
    for readings, density in ((rate, noise.gyro_noise), (force, noise.accelerometer_noise)):
        sigma = density / np.sqrt(step_s)
        windows = readings[count % length :].reshape(-1, length, 3)
        mean = windows.mean(axis=1)
        apart = np.abs(mean - readings[:reference].mean(axis=0)).max()
        spread = ((windows - mean[:, None]) ** 2).mean() * length / (length - 1)
        if apart > SIGMAS * sigma * np.sqrt(1 / length + 1 / reference) or spread > SPREAD_MAX * sigma**2:
            return None
    return Rest(end_s - begin_s, force.mean(axis=0), rate.mean(axis=0))


def prior_rests(first: Array, now: Array, seconds: float) -> bool:
    """Whether the position of the drifting prior ``(4, 4)`` moved no more in that time than its drift explains."""
    sigma_m = np.sqrt(drift_variance(seconds)[1:])
    return bool((np.abs(now[:3, 3] - first[:3, 3]) <= SIGMAS * sigma_m).all())


def rest_duration_s(imu: Imu, noise: ImuSettings, prior: Trajectory) -> float:
    """Seconds from the first scan to the last one before the drone moved, 0 if it never rested."""
    begin_s, found_s = float(prior.stamp_s[0]), 0.0
    for stamp_s, T in zip(prior.stamp_s, prior.T_world_drone, strict=True):
        if stamp_s - begin_s < REST_MIN_S - 1e-6:
            continue
        rest = find_rest(imu, noise, begin_s, float(stamp_s))
        passed_s = float(stamp_s) - begin_s
        if rest is None or not prior_rests(prior.T_world_drone[0], T, passed_s):
            break
        found_s = passed_s
    return found_s


def after_rest(rest: Rest, noise: ImuSettings, R_world_drone: Array, covariance: Array) -> tuple[Array, Array]:
    """The step ``(N,)`` of a state whose attitude was ``R_world_drone (3, 3)`` and whose biases were zero, and the new
    ``covariance (N, N)``; the order is that of `imu_factors`, with anything behind it.

    The mean rate is the bias of the gyroscope. The mean force is gravity in a tilted frame, plus the bias of the
    accelerometer: the two cannot be told apart, and stay correlated.
    """
    P = covariance.copy()
    P[VELOCITY, VELOCITY] = SPEED_SIGMA_M_S**2 * np.eye(3)
    H = np.zeros((6, len(P)))
    H[:3, GYRO] = H[3:, FORCE] = np.eye(3)
    H[3:, ROTATION] = GRAVITY * R_world_drone.T @ cross_matrix(np.array([0.0, 0.0, 1.0]))
    error = np.append(rest.rate, rest.force - GRAVITY * R_world_drone[2])
    variance = np.repeat([noise.gyro_noise, noise.accelerometer_noise], 3) ** 2 / rest.seconds
    gain = np.linalg.solve(H @ P @ H.T + np.diag(variance), H @ P).T
    P = P - gain @ H @ P
    return gain @ error, 0.5 * (P + P.T)
