"""Odometries of others behind the interface of ours."""

import numpy as np
import pytest

from steelnb import experiment
from steelnb.metrics import position_error_m
from steelnb.odometry import PeerOdometry, make_odometry, run
from steelnb.settings import ExperimentSettings, OdometrySettings

PEERS = {"kiss-icp": "kiss_icp", "small-gicp": "small_gicp"}


@pytest.fixture(scope="module")
def world():
    settings = ExperimentSettings.preset("zigzag", "constant-drift:0.0004+random-walk", seed=3, duration_s=8.0)
    return experiment.simulate(settings)


@pytest.fixture(params=PEERS)
def method(request):
    pytest.importorskip(PEERS[request.param])
    return request.param


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


def test_a_scan_without_returns_follows_the_motion_of_the_prior(world, method):
    flight = world[0]
    odometry, T = make_odometry(OdometrySettings.preset(method), flight.T_drone_sensor), flight.prior.T_world_drone
    before = [odometry.update(flight.scans[k], T[k]).T_world_drone for k in range(4)][-1]
    step = odometry.update(np.full((5, 5, 3), np.nan), T[4])
    assert step.reason == "too few points"
    np.testing.assert_allclose(step.T_world_drone, before @ np.linalg.inv(T[3]) @ T[4], atol=1e-12)
    assert odometry.update(flight.scans[5], T[5]).used


def test_a_flight_without_returns_at_first_starts_with_its_first_returns(world, method):
    flight = world[0]
    odometry = make_odometry(OdometrySettings.preset(method), flight.T_drone_sensor)
    T = flight.prior.T_world_drone
    assert odometry.update(np.zeros((0, 3)), T[0]).reason == "too few points"
    first = odometry.update(flight.scans[1], T[1])
    np.testing.assert_allclose(first.T_world_drone, T[1], atol=1e-9)
    assert first.reason == "first scan"
    assert odometry.update(flight.scans[2], T[2]).used
