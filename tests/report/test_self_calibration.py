"""`report.self_calibration`: each fault costs what it should, and the errors drawn are those of the estimator's σ."""

import numpy as np
import pytest

from steelnb import experiment
from steelnb.report import self_calibration
from steelnb.settings import ExperimentSettings
from steelnb.types import SensorErrors


@pytest.fixture(scope="module")
def ran():
    return self_calibration.fault_runs("loops", 3, 8.0)


def test_every_fault_has_a_row_and_a_wrong_mount_is_taken_back(ran):
    runs, _ = ran
    assert list(runs["fault"]) == list(self_calibration.FAULTS)
    mm = 1e3 * runs.set_index("fault")
    assert (mm > 0).all(axis=None)
    mount = mm.loc["mount off by 1 cm and 1°"]
    assert mount["calibrated"] < 0.5 * mount["smoothed"]
    assert mount["smoothed"] > 5 * mm.loc["none", "smoothed"]
    drawn = mm.loc[self_calibration.DRAWN]
    assert (drawn[["calibrated", self_calibration.WITH_IMU]] < 0.5 * drawn["smoothed"]).all()


def test_the_errors_drawn_are_found_within_their_standard_deviations(ran):
    table = self_calibration.error_table(ran[1], 3).set_index("error")
    for method in ("", "_imu"):
        assert ((table[f"found{method}"] - table["true"]).abs() < 4 * table[f"sigma{method}"]).all()
    level = table.drop(index=["mount roll", "mount pitch"])  # without an IMU the prior's roll and pitch are exact
    assert (level["sigma_imu"] < 1.02 * level["sigma"]).all()
    assert table.loc["range scale", "sigma_imu"] < 0.7 * table.loc["range scale", "sigma"]
    assert table.loc["mount pitch", "unit"] == "°"
    assert table.loc["mount pitch", "before"] == pytest.approx(1.0, abs=0.01)
    assert table.loc["mount pitch", "sigma"] < 0.1


def test_drawn_errors_are_those_of_the_calibration_s_prior():
    drawn = np.array([self_calibration.errors_of(self_calibration.DRAWN, seed) for seed in range(400)])
    sigma = experiment.ExperimentSettings.preset(method="calibrated").odometry.calibration
    np.testing.assert_allclose(
        drawn.std(axis=0)[[0, 1, 2, 5, 8]],
        [
            sigma.range_offset_sigma_m,
            sigma.range_scale_sigma,
            sigma.mount_sigma_m,
            sigma.mount_sigma_rad,
            sigma.time_sigma_s,
        ],
        rtol=0.15,
    )


def test_a_wrongly_told_flight_differs_by_the_errors_alone():
    settings = ExperimentSettings.preset("loops", "random-walk", seed=3, duration_s=2.0, method="combined")
    flight, truth = experiment.simulate(settings)
    same = self_calibration.wrongly_told(settings, flight, truth, np.zeros(9))
    np.testing.assert_array_equal(same.scans.range_m, flight.scans.range_m)
    np.testing.assert_array_equal(same.prior.T_world_drone, flight.prior.T_world_drone)
    assert 0 < np.abs(same.imu.specific_force - flight.imu.specific_force).max() < 1.0
    errors = np.array([0.01, 0.02, 0.03, 0, 0, 0, 0, 0.1, 0.04])
    told = self_calibration.wrongly_told(settings, flight, truth, errors)
    np.testing.assert_allclose(told.scans.range_m, 1.02 * flight.scans.range_m + 0.01, rtol=1e-5)
    true = SensorErrors(errors, np.eye(9), errors).T_assumed_true
    np.testing.assert_allclose(told.T_drone_sensor @ true, flight.T_drone_sensor, atol=1e-12)
    moved_m = np.linalg.norm(told.prior.position - flight.prior.position, axis=1)
    assert 0 < moved_m[-1] < 0.2  # where the drone was 40 ms before
    np.testing.assert_allclose(told.imu.stamp_s - flight.imu.stamp_s, 0.04)
