"""Readings of a real IMU, and the attitude that a filter estimates from them."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core import rng
from steelnb.core.types import GRAVITY, Array, Imu, Trajectory
from steelnb.settings import ImuSettings

FILTER_GAIN = 0.5
"""Gain of the filter towards the accelerometer's vertical, 1/s: the library's default."""


def measured_imu(exact: Imu, settings: ImuSettings, seed: rng.Seed) -> Imu:
    """Readings with white noise, an initial bias, and a random walk of the bias.

    ``exact`` has equal time steps; its values are means over them. The streams of the seed are ``(sensor, part)`` with
    sensor ``gyro`` or ``accelerometer`` and part ``noise``, ``walk`` or ``bias``. Noise densities are those of an Allan
    deviation (IEEE Std 952-1997): N/√τ for white noise N, K·√(τ/3) for a random walk K.
    """
    return ImuErrors(exact.stamp_s, settings, seed).read(exact)


class ImuErrors:
    """The errors of `measured_imu`, drawn for a whole flight at ``stamp_s (N,)`` and applied piece by piece."""

    def __init__(self, stamp_s: Array, settings: ImuSettings, seed: rng.Seed) -> None:
        step_s, shape = float(stamp_s[1] - stamp_s[0]), (len(stamp_s), 3)
        self._errors = []  # white noise, initial bias, bias walk: of the specific force, then of the angular rate
        for sensor in ("accelerometer", "gyro"):
            noise, walk, bias = (getattr(settings, f"{sensor}_{each}") for each in ("noise", "walk", "bias"))
            white = noise / math.sqrt(step_s) * rng.stream(seed, sensor, "noise").standard_normal(shape)
            steps = walk * math.sqrt(step_s) * rng.stream(seed, sensor, "walk").standard_normal(shape)
            start = bias * rng.stream(seed, sensor, "bias").standard_normal(3)
            self._errors.append((white, start, np.cumsum(steps, axis=0)))

    def read(self, exact: Imu, first: int = 0) -> Imu:
        """Readings of a piece of the flight that begins at sample ``first``."""
        piece, true = slice(first, first + len(exact.stamp_s)), (exact.specific_force, exact.angular_rate)
        force, rate = (
            each + white[piece] + start + walk[piece]
            for each, (white, start, walk) in zip(true, self._errors, strict=True)
        )
        return Imu(exact.stamp_s, force, rate)


def filtered_attitude(truth: Trajectory, imu: Imu) -> Trajectory:
    """The true trajectory with roll and pitch as a filter estimates them from the readings, at the same stamps.

    Madgwick's revised filter (S. O. H. Madgwick, thesis, Bristol 2014, chapter 7; library imufusion), initialised with
    the true attitude. Position and heading stay true: the attitude error is a rotation about a horizontal axis.
    """
    step_s = float(imu.stamp_s[1] - imu.stamp_s[0])
    return AttitudeFilter(truth.T_world_drone[0], step_s).update(truth, imu)


class AttitudeFilter:
    """`filtered_attitude` piece by piece, during a flight.

    ``T_world_drone (4, 4)``: true pose at the start; ``step_s``: interval between readings.
    """

    def __init__(self, T_world_drone: Array, step_s: float) -> None:
        import imufusion

        self._filter = imufusion.Ahrs()
        self._filter.set_settings(imufusion.AhrsSettings(sample_rate=1 / step_s, gain=FILTER_GAIN, gyroscope_range=0.0))
        self._filter.skip_startup()
        self._filter.set_quaternion(np.roll(Rotation.from_matrix(T_world_drone[:3, :3]).as_quat(), 1))
        self._up = T_world_drone[2, :3]

    def update(self, truth: Trajectory, imu: Imu) -> Trajectory:
        """The poses of a piece with the filter's roll and pitch. Its first pose and reading repeat the last ones of the
        previous piece; the filter skips them."""
        up = np.empty((len(imu.stamp_s), 3))
        up[0] = self._up
        for k, (rate, force) in enumerate(
            zip(np.degrees(imu.angular_rate[1:]), imu.specific_force[1:] / GRAVITY, strict=True)
        ):
            self._filter.update_no_magnetometer(rate, force)
            up[k + 1] = self._filter.get_gravity()
        self._up = up[-1]
        T_world_drone = truth.T_world_drone.copy()
        estimated = np.einsum("nij,nj->ni", T_world_drone[:, :3, :3], up)  # the filter's vertical, world frame
        x, y, z = estimated.T
        sine = np.hypot(x, y)
        angle = np.arctan2(sine, z) / np.maximum(sine, 1e-12)
        tilt = Rotation.from_rotvec(angle[:, None] * np.column_stack([y, -x, np.zeros(len(z))]))
        T_world_drone[:, :3, :3] = tilt.as_matrix() @ T_world_drone[:, :3, :3]
        return Trajectory(truth.stamp_s, T_world_drone)
