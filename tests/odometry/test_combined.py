import numpy as np
import pytest

from steelnb import experiment
from steelnb.config import CloudSettings, ExperimentSettings, OdometrySettings
from steelnb.datatypes import Trajectory
from steelnb.metrics import score_trajectory
from steelnb.odometry import CloudOdometry, CombinedOdometry, SegmentOdometry, combined, make_odometry

NOISE = "constant-drift:0.0004+random-walk+yaw-random-walk"


@pytest.fixture(scope="module")
def world():
    settings = ExperimentSettings.preset("vertical", NOISE, seed=3, duration_s=12.0, method="combined")
    return settings, *experiment.simulate(settings)


def steps_of(odometry, flight):
    return [odometry.update(*frame) for frame in zip(flight.scans, flight.prior.T_world_drone, strict=True)]


def ate_m(steps, flight, truth):
    corrected = Trajectory(flight.prior.stamp_s, np.array([step.T_world_drone for step in steps]))
    return score_trajectory(corrected, truth.trajectory)["ate_rmse_m"]


def test_the_settings_choose_the_odometry(world):
    _, flight, _ = world
    kinds = {"combined": CombinedOdometry, "best": CloudOdometry, "least_squares_yaw": SegmentOdometry}
    for method, kind in kinds.items():
        case = ExperimentSettings.preset("vertical", NOISE, seed=3, duration_s=12.0, method=method)
        assert type(make_odometry(case, flight.T_drone_sensor)) is kind


def test_it_maps_points_and_bars_and_takes_the_drift_out(world):
    settings, flight, truth = world
    odometry = make_odometry(settings, flight.T_drone_sensor)
    steps = steps_of(odometry, flight)
    assert score_trajectory(flight.prior, truth.trajectory)["ate_rmse_m"] > 0.3
    assert ate_m(steps, flight, truth) < 0.02
    assert all(step.used for step in steps[1:])
    assert len(odometry.map_points()) > 1000
    assert len(odometry.map_segments()) > 20


def test_bars_of_no_weight_leave_the_cloud_s_answer(world):
    settings, flight, _ = world
    light = make_odometry(settings.override({"odometry.bars_weight": 1e-12}), flight.T_drone_sensor)
    best = CloudOdometry(CloudSettings.preset("best"), settings.preprocess, flight.T_drone_sensor)
    for _, scan, prior in zip(range(15), flight.scans, flight.prior.T_world_drone, strict=False):
        ours, cloud = (odometry.update(scan, prior).T_world_drone for odometry in (light, best))
        np.testing.assert_allclose(ours, cloud, atol=1e-6)


def test_heavy_bars_give_the_answer_of_bars(world):
    settings, flight, _ = world
    heavy = make_odometry(settings.override({"odometry.bars_weight": 1e4}), flight.T_drone_sensor)
    by_bars = ExperimentSettings.preset("vertical", NOISE, seed=3, duration_s=12.0, method="least_squares_yaw")
    ours, bars = (
        np.array([step.T_world_drone[:3, 3] for step in steps_of(odometry, flight)])
        for odometry in (heavy, make_odometry(by_bars, flight.T_drone_sensor))
    )
    best = steps_of(CloudOdometry(CloudSettings.preset("best"), settings.preprocess, flight.T_drone_sensor), flight)
    cloud = np.array([step.T_world_drone[:3, 3] for step in best])
    assert np.linalg.norm(ours - bars, axis=1).mean() < 0.5 * np.linalg.norm(cloud - bars, axis=1).mean()


def test_segments_are_found_once_a_scan(world, monkeypatch):
    settings, flight, _ = world
    calls = []
    find = combined.segments_in
    monkeypatch.setattr(combined, "segments_in", lambda *given: calls.append(1) or find(*given))
    odometry = make_odometry(settings, flight.T_drone_sensor)
    for k in range(4):
        odometry.update(flight.scans[k], flight.prior.T_world_drone[k])
    assert len(calls) == 4


def test_the_defaults_run():
    odometry = CombinedOdometry()
    assert odometry.settings.bars_weight > 0
    assert odometry.bars == OdometrySettings()
    step = odometry.update(np.full((4, 4, 3), np.nan), np.eye(4))
    assert not step.used
