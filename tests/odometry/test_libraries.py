"""Third-party odometries behind our interface."""

import numpy as np
import pytest

from steelnb import experiment
from steelnb.metrics import position_error_m
from steelnb.odometry import PeerOdometry, make_odometry, run
from steelnb.settings import ExperimentSettings, OdometrySettings


@pytest.fixture(scope="module")
def world():
    noise, coarse = "constant-drift:0.0008+random-walk", {"tof.columns": 90, "tof.rows": 120}
    return experiment.simulate(ExperimentSettings.preset("zigzag", noise, seed=3, duration_s=4.0, overrides=coarse))


METHODS = pytest.mark.parametrize("method", ["kiss-icp", "small-gicp"])


@METHODS
def test_it_removes_most_of_the_drift_and_has_a_map(world, method):
    flight, truth = world
    odometry = make_odometry(OdometrySettings.preset(method), flight.T_drone_sensor)
    found = run(flight, odometry)
    assert isinstance(odometry, PeerOdometry)
    assert found.reason[0] == "first scan"
    assert not any(found.reason[1:])
    assert found.matches.min() > 100
    raw, error = (position_error_m(path, truth.trajectory) for path in (flight.prior, found.corrected))
    assert raw[-1] > 0.3
    assert error[-1] < 0.2 * raw[-1]
    tower = truth.tower.axes.reshape(-1, 3)
    assert len(found.points) > 300
    assert (found.points[:, 2] < tower[:, 2].max()).all()
    assert not len(found.segments)


@METHODS
def test_a_flight_starts_with_its_first_returns_and_a_scan_without_any_follows_the_prior(world, method):
    flight, nothing = world[0], np.full((5, 5, 3), np.nan)
    odometry, T = make_odometry(OdometrySettings.preset(method), flight.T_drone_sensor), flight.prior.T_world_drone
    scans = [nothing, *flight.scans[1:4], nothing, flight.scans[5]]
    steps = [odometry.update(scan, prior) for scan, prior in zip(scans, T[:6], strict=True)]
    assert [step.reason for step in steps] == ["too few points", "first scan", "", "", "too few points", ""]
    np.testing.assert_allclose(steps[1].T_world_drone, T[1], atol=1e-9)
    np.testing.assert_allclose(steps[4].T_world_drone, steps[3].T_world_drone @ np.linalg.inv(T[3]) @ T[4], atol=1e-12)
