import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb import experiment
from steelnb.core.types import Imu, Trajectory
from steelnb.settings import ExperimentSettings, ImuSettings
from steelnb.simulation import filtered_attitude, measured_imu

STEP_S = 0.008
STARLING2 = ImuSettings.preset("starling2-honest")


def at_rest(seconds):
    stamp = np.arange(round(seconds / STEP_S) + 1) * STEP_S
    return Imu(stamp, np.tile([0.0, 0.0, 9.81], (len(stamp), 1)), np.zeros((len(stamp), 3)))


def still(stamp, rotation=None):
    T = np.tile(np.eye(4), (len(stamp), 1, 1))
    if rotation is not None:
        T[:, :3, :3] = rotation.as_matrix()
    return Trajectory(stamp, T)


def allan_variance(readings, count):
    """Allan variance of means over ``count`` readings, without overlap, and its number of pairs."""
    means = readings[: len(readings) // count * count].reshape(-1, count, 3).mean(axis=1)
    steps = np.diff(means, axis=0)
    return 0.5 * (steps**2).mean(), steps.size


@pytest.mark.parametrize(
    "settings",
    [STARLING2, STARLING2.replace(gyro_walk=1e-5, accelerometer_walk=5e-4)],
    ids=["data sheet", "walks that show"],
)
def test_the_allan_deviation_is_that_of_the_settings(settings):
    """σ² = N²/τ + K²·τ/3 (IEEE Std 952-1997). The mean of M squared differences of white noise scatters by √(3/M)."""
    imu = measured_imu(at_rest(4000), settings, 1)
    for readings, noise, walk in (
        (imu.angular_rate, settings.gyro_noise, settings.gyro_walk),
        (imu.specific_force, settings.accelerometer_noise, settings.accelerometer_walk),
    ):
        for tau_s in (STEP_S, 0.08, 0.8, 8.0, 80.0):
            found, pairs = allan_variance(readings[1:], round(tau_s / STEP_S))
            assert found == pytest.approx(noise**2 / tau_s + walk**2 * tau_s / 3, rel=4 * np.sqrt(3 / pairs) + 1e-3)


def test_initial_biases_have_their_standard_deviation_and_each_noise_has_its_own_stream():
    """A sum contains its parts, and without errors readings are exact."""
    bias = ImuSettings(gyro_bias=1e-3, accelerometer_bias=0.02)
    found = [measured_imu(at_rest(0.016), bias, seed) for seed in range(300)]
    force = np.array([imu.specific_force - [0, 0, 9.81] for imu in found])
    np.testing.assert_array_equal(force, np.tile(force[:, :1], (1, 3, 1)))
    assert force[:, 0].std() == pytest.approx(0.02, rel=0.1)
    assert np.array([imu.angular_rate[0] for imu in found]).std() == pytest.approx(1e-3, rel=0.1)
    np.testing.assert_array_equal(measured_imu(at_rest(1), ImuSettings(), 1).specific_force, at_rest(1).specific_force)
    both = measured_imu(at_rest(1), bias.replace(gyro_noise=1e-3), 7)
    alone = measured_imu(at_rest(1), ImuSettings(gyro_noise=1e-3), 7)
    np.testing.assert_allclose(
        both.angular_rate - alone.angular_rate, found[7].angular_rate[:1].repeat(126, 0), atol=1e-15
    )


def lean(truth, filtered):
    """Angles in degrees between the true vertical and the filter's."""
    up = np.einsum("ni,ni->n", truth.T_world_drone[:, 2, :3], filtered.T_world_drone[:, 2, :3])
    return np.degrees(np.arccos(np.clip(up, -1, 1)))


def test_the_filter_converges_to_the_vertical_of_a_biased_accelerometer():
    """At rest, the filter turns with its gain from the true to the apparent vertical, about a horizontal axis."""
    imu = at_rest(40)
    imu = Imu(imu.stamp_s, imu.specific_force + np.array([0.2, 0.0, 0.0]), imu.angular_rate)
    truth = still(imu.stamp_s, Rotation.from_euler("z", 1.0))
    found = filtered_attitude(truth, imu)
    np.testing.assert_allclose(found.T_world_drone[0], truth.T_world_drone[0], atol=1e-12)
    np.testing.assert_array_equal(found.position, truth.position)
    wrong = lean(truth, found)
    assert wrong[-1] == pytest.approx(np.degrees(np.arctan(0.2 / 9.81)), rel=0.02)
    assert np.all(np.diff(wrong) > -1e-3)
    turn = Rotation.from_matrix(found.T_world_drone[:, :3, :3] @ truth.T_world_drone[:, :3, :3].transpose(0, 2, 1))
    np.testing.assert_allclose(turn.as_rotvec()[:, 2], 0, atol=1e-9)
    # A force along the drone's x axis looks like its nose held up: the filter believes in a pitch that is not there.
    assert found.T_world_drone[-1, 2, 0] == pytest.approx(np.sin(np.arctan(0.2 / 9.81)), rel=0.02)


def test_the_filter_follows_a_turn_of_the_drone():
    stamp = np.arange(1001) * STEP_S
    rotation = Rotation.from_euler("ZYX", np.column_stack([0.3 * stamp, 0.2 * np.sin(stamp), 0.1 * np.sin(2 * stamp)]))
    rate = np.zeros((len(stamp), 3))
    rate[1:] = (rotation[:-1].inv() * rotation[1:]).as_rotvec() / STEP_S
    truth = still(stamp, rotation)
    exact = Imu(stamp, rotation.inv().apply([0, 0, 9.81]), rate)
    assert lean(truth, filtered_attitude(truth, exact)).max() < 0.1


def test_an_experiment_with_an_imu_has_its_readings_and_the_filter_s_attitude():
    plain = ExperimentSettings.preset("loops", "random-walk", sensor="report-4cm", duration_s=2.0)
    honest = plain.override({"imu": STARLING2.model_dump()})
    ideal, truth = experiment.simulate(plain)
    flight, same = experiment.simulate(honest)
    np.testing.assert_array_equal(truth.trajectory.T_world_drone, same.trajectory.T_world_drone)
    np.testing.assert_array_equal(flight.prior.position, ideal.prior.position)
    assert 1e-4 < np.abs(flight.prior.T_world_drone - ideal.prior.T_world_drone).max() < 0.1
    assert np.abs(flight.imu.specific_force - ideal.imu.specific_force).max() > 0.05
    np.testing.assert_array_equal(
        experiment.redrift(honest, flight, same).prior.T_world_drone, flight.prior.T_world_drone
    )
