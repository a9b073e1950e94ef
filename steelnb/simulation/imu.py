"""Readings of a real IMU, and the attitude that a filter makes of them."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb import rng
from steelnb.errors import needs
from steelnb.settings import ImuSettings
from steelnb.types import GRAVITY, Array, Imu, Trajectory

FILTER_GAIN = 0.5
"""Rate, 1/s, at which the filter turns towards the accelerometer's vertical: the library's default."""


def measured_imu(exact: Imu, settings: ImuSettings, seed: int) -> Imu:
    """Readings with white noise and with biases that start as calibration left them and walk.

    ``exact`` has even steps of time, over which its values are means. The streams of the seed are
    ``(sensor, part)`` with sensor ``gyro`` or ``accelerometer`` and part ``noise``, ``walk`` or ``bias``. Densities are
    those that an Allan deviation shows (IEEE Std 952-1997): N/√τ for white noise N, K·√(τ/3) for a walk K.
    """

    def read(true: Array, sensor: str, noise: float, walk: float, bias: float) -> Array:
        step_s = float(exact.stamp_s[1] - exact.stamp_s[0])
        white = noise / math.sqrt(step_s) * rng.stream(seed, sensor, "noise").standard_normal(true.shape)
        steps = walk * math.sqrt(step_s) * rng.stream(seed, sensor, "walk").standard_normal(true.shape)
        start = bias * rng.stream(seed, sensor, "bias").standard_normal(3)
        return np.asarray(true + white + start + np.cumsum(steps, axis=0))

    s = settings
    force = read(
        exact.specific_force, "accelerometer", s.accelerometer_noise, s.accelerometer_walk, s.accelerometer_bias
    )
    return Imu(exact.stamp_s, force, read(exact.angular_rate, "gyro", s.gyro_noise, s.gyro_walk, s.gyro_bias))


def filtered_attitude(truth: Trajectory, imu: Imu) -> Trajectory:
    """The true trajectory with the roll and pitch that a filter makes of the readings, at the same stamps.

    Madgwick's revised filter (S. O. H. Madgwick, thesis, Bristol 2014, chapter 7; library imufusion), begun with the
    true attitude. Position and heading stay: the error is a turn about a level axis. Raises `MissingExtraError`.
    """
    with needs("sim"):
        import imufusion
    step_s = float(imu.stamp_s[1] - imu.stamp_s[0])
    attitude = imufusion.Ahrs()
    attitude.set_settings(imufusion.AhrsSettings(sample_rate=1 / step_s, gain=FILTER_GAIN, gyroscope_range=0.0))
    attitude.skip_startup()
    attitude.set_quaternion(np.roll(Rotation.from_matrix(truth.T_world_drone[0, :3, :3]).as_quat(), 1))
    up = np.empty((len(imu.stamp_s), 3))
    up[0] = truth.T_world_drone[0, 2, :3]
    for k, (rate, force) in enumerate(
        zip(np.degrees(imu.angular_rate[1:]), imu.specific_force[1:] / GRAVITY, strict=True)
    ):
        attitude.update_no_magnetometer(rate, force)
        up[k + 1] = attitude.get_gravity()
    T_world_drone = truth.T_world_drone.copy()
    seen = np.einsum("nij,nj->ni", T_world_drone[:, :3, :3], up)  # the filter's vertical, in the world
    lean = np.hypot(seen[:, 0], seen[:, 1])
    angle = np.arctan2(lean, seen[:, 2]) / np.maximum(lean, 1e-12)
    back = Rotation.from_rotvec(angle[:, None] * np.column_stack([seen[:, 1], -seen[:, 0], np.zeros(len(seen))]))
    T_world_drone[:, :3, :3] = back.as_matrix() @ T_world_drone[:, :3, :3]
    return Trajectory(truth.stamp_s, T_world_drone)
