"""Allan deviations of known processes and of the simulated IMU."""

import numpy as np

from steelnb.metrics import allan
from steelnb.settings import ImuSettings
from steelnb.simulation import measured_imu
from steelnb.types import Imu


def test_the_allan_deviation_of_white_noise_and_of_a_walk():
    random, step_s, tau_s = np.random.default_rng(3), 0.01, np.array([0.01, 0.1, 1.0, 10.0])
    white = 0.2 / np.sqrt(step_s) * random.standard_normal((400_000, 3))
    walk = np.cumsum(0.05 * np.sqrt(step_s) * random.standard_normal((400_000, 3)), axis=0)
    np.testing.assert_allclose(allan.allan_deviation(white, step_s, tau_s), 0.2 / np.sqrt(tau_s), rtol=0.05)
    np.testing.assert_allclose(allan.allan_deviation(walk, step_s, tau_s[1:]), 0.05 * np.sqrt(tau_s[1:] / 3), rtol=0.05)


def test_the_simulated_imu_is_that_of_its_settings():
    settings = ImuSettings.preset("starling2-honest")
    assert settings is not None
    stamp_s, still, tau_s = np.arange(112_500) / 125, np.zeros((112_500, 3)), np.array([0.008, 0.08, 0.8, 4.0])
    read = measured_imu(Imu(stamp_s, still, still), settings, 1)
    for reading, noise, walk in (
        (read.angular_rate, settings.gyro_noise, settings.gyro_walk),
        (read.specific_force, settings.accelerometer_noise, settings.accelerometer_walk),
    ):
        expected = np.sqrt(noise**2 / tau_s + walk**2 * tau_s / 3)
        np.testing.assert_allclose(allan.allan_deviation(reading, 1 / 125, tau_s), expected, rtol=0.05)
