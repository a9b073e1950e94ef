"""Rest before take-off: found by the readings and the prior alone, and what the filter learns from it."""

import numpy as np
import pytest

from steelnb.core.types import Imu, Trajectory
from steelnb.odometry.inertial import InertialPrediction
from steelnb.odometry.standstill import REST_MAX_S, REST_MIN_S, find_rest, prior_rests, rest_duration_s
from steelnb.settings import ImuSettings
from steelnb.simulation import measured_imu

SHEET = ImuSettings.preset("starling2-honest")
STEP_S, SECONDS, REST_S = 0.008, 6.0, 3.0


def readings(seed, rest_s=REST_S, force=0.3):
    """Readings of a drone that rests, then accelerates along x, and the exact biases."""
    stamp_s = np.arange(round(SECONDS / STEP_S) + 1) * STEP_S
    exact = np.tile([0.0, 0.0, 9.81], (len(stamp_s), 1))
    exact[stamp_s > rest_s, 0] += force
    imu = measured_imu(Imu(stamp_s, exact, np.zeros_like(exact)), SHEET, seed)
    return imu, np.append((imu.angular_rate).mean(axis=0), (imu.specific_force - exact).mean(axis=0))


def still(count=30):
    return Trajectory(np.arange(count) * 0.2, np.tile(np.eye(4), (count, 1, 1)))


@pytest.mark.parametrize("seed", range(5))
def test_a_rest_is_found_until_the_drone_moves(seed):
    imu, bias = readings(seed)
    rest = find_rest(imu, SHEET, 0.0, 2.8)
    np.testing.assert_allclose(rest.rate, bias[:3], atol=4e-4)
    np.testing.assert_allclose(rest.force - [0, 0, 9.81], bias[3:], atol=0.01)
    assert find_rest(imu, SHEET, 0.0, 3.4) is None
    assert find_rest(imu, SHEET, 0.0, 0.8 * REST_MIN_S) is None
    assert rest_duration_s(imu, SHEET, still()) == pytest.approx(3.0)


def test_no_rest_is_found_in_the_air_nor_without_readings_nor_in_noise_above_the_data_sheets():
    moving, _ = readings(1, rest_s=0.3)
    assert rest_duration_s(moving, SHEET, still()) == 0
    shaking = SHEET.replace(gyro_noise=2 * SHEET.gyro_noise)
    imu = measured_imu(Imu(moving.stamp_s, np.tile([0.0, 0.0, 9.81], (len(moving.stamp_s), 1)),
                           np.zeros((len(moving.stamp_s), 3))), shaking, 2)  # fmt: skip
    assert find_rest(imu, SHEET, 0.0, 2.0) is None
    assert find_rest(imu, shaking, 0.0, 2.0) is not None
    few = Imu(imu.stamp_s[::40], imu.specific_force[::40], imu.angular_rate[::40])
    assert find_rest(few, shaking, 0.0, 2.0) is None


def test_of_a_long_rest_the_last_readings_count():
    stamp_s = np.arange(round(40 / STEP_S)) * STEP_S
    exact = np.tile([0.0, 0.0, 9.81], (len(stamp_s), 1))
    rate = np.where(stamp_s[:, None] < 2.0, 0.1, 0.0) * np.ones(3)  # another bias, before the last half minute
    imu = measured_imu(Imu(stamp_s, exact, rate), SHEET, 4)
    assert find_rest(imu, SHEET, 0.0, 10.0) is None
    rest = find_rest(imu, SHEET, 0.0, 39.0)
    assert rest.seconds == REST_MAX_S
    assert np.abs(rest.rate).max() < 0.05


def test_calm_air_at_constant_speed_is_no_rest_since_the_prior_moves():
    imu, _ = readings(3, rest_s=SECONDS)
    cruise = still().T_world_drone.copy()
    cruise[:, 0, 3] = 0.18 * 0.2 * np.arange(len(cruise))
    assert rest_duration_s(imu, SHEET, Trajectory(still().stamp_s, cruise)) == 0
    assert prior_rests(cruise[0], cruise[0], 1.0)
    assert not prior_rests(cruise[0], cruise[10], 2.0)


@pytest.mark.parametrize("seed", range(5))
def test_after_a_rest_the_gyroscopes_bias_and_the_vertical_are_known_as_well_as_stated(seed):
    imu, bias = readings(seed)
    prior, found = still(), InertialPrediction(imu, SHEET)
    for k in range(15):
        found.pose(prior.T_world_drone[k], prior.stamp_s[k])
        found.lose()
    sigma = np.sqrt(np.diag(found.state.covariance))
    assert (np.abs(found.state.bias[:3] - bias[:3]) < 4 * sigma[9:12]).all()
    assert sigma[9:12].max() < 0.2 * SHEET.gyro_bias
    assert sigma[:2].max() < 1.1 * SHEET.accelerometer_bias / 9.81 < 0.002
    lean = found.state.T_world_drone[:2, 2]  # a lean by the bias of the accelerometer, which nothing tells
    assert np.abs(lean).max() < 4 * SHEET.accelerometer_bias / 9.81
    np.testing.assert_array_equal(found.state.velocity, 0.0)


def test_a_flight_that_begins_in_the_air_is_corrected_as_if_there_were_no_rest(monkeypatch):
    imu, _ = readings(1, rest_s=0.3)
    prior, poses = still(), []
    for switch in (True, False):
        found = InertialPrediction(imu, SHEET)
        if not switch:
            monkeypatch.setattr(found, "_rested", lambda *_: None)
        poses.append([found.pose(T, t) for T, t in zip(prior.T_world_drone, prior.stamp_s, strict=True)
                      if found.lose() is None or True])  # fmt: skip
    np.testing.assert_array_equal(*poses)
