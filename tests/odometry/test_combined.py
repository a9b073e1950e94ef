import numpy as np
import pytest

from steelnb import experiment
from steelnb.metrics import score_trajectory
from steelnb.odometry import (
    CloudOdometry,
    CombinedOdometry,
    LoamOdometry,
    SegmentOdometry,
    combined,
    make_odometry,
    run,
)
from steelnb.settings import ExperimentSettings, OdometrySettings

NOISE = "constant-drift:0.0004+random-walk+yaw-random-walk"


@pytest.fixture(scope="module")
def world():
    settings = ExperimentSettings.preset("zigzag", NOISE, seed=3, duration_s=12.0, method="combined")
    return settings, *experiment.simulate(settings)


def test_the_settings_choose_the_odometry():
    kinds = {
        "combined": CombinedOdometry, "best": CloudOdometry, "least_squares_yaw": SegmentOdometry,
        "loam": LoamOdometry,
    }  # fmt: skip
    for method, kind in kinds.items():
        assert type(make_odometry(OdometrySettings.preset(method), np.eye(4))) is kind


def test_it_maps_points_and_bars_and_takes_the_drift_out(world):
    settings, flight, truth = world
    found = run(flight, make_odometry(settings.odometry, flight.T_drone_sensor))
    assert score_trajectory(flight.prior, truth.trajectory)["ate_rmse_m"] > 0.3
    assert score_trajectory(found.corrected, truth.trajectory)["ate_rmse_m"] < 0.02
    assert not any(found.reason[1:])
    assert len(found.points) > 1000
    assert len(found.segments) > 20


def test_bars_of_no_weight_leave_the_cloud_s_answer(world):
    settings, flight, _ = world
    light = make_odometry(settings.odometry.override({"clouds.bars_weight": 1e-12}), flight.T_drone_sensor)
    best = CloudOdometry(OdometrySettings.preset("best"), flight.T_drone_sensor)
    for _, scan, prior in zip(range(15), flight.scans, flight.prior.T_world_drone, strict=False):
        ours, cloud = (odometry.update(scan, prior).T_world_drone for odometry in (light, best))
        np.testing.assert_allclose(ours, cloud, atol=1e-6)


def test_heavy_bars_give_the_answer_of_bars(world):
    settings, flight = world[0], world[1].first(35)
    heavy = settings.odometry.override({"clouds.bars_weight": 1e4})
    ours, bars, cloud = (
        np.array([T[:3, 3] for T in run(flight, make_odometry(chosen, flight.T_drone_sensor)).corrected.T_world_drone])
        for chosen in (heavy, OdometrySettings.preset("least_squares_yaw"), OdometrySettings.preset("best"))
    )
    assert np.linalg.norm(ours - bars, axis=1).mean() < 0.5 * np.linalg.norm(cloud - bars, axis=1).mean()


def test_segments_are_found_once_a_scan(world, monkeypatch):
    settings, flight, _ = world
    calls = []
    find = combined.segments_in
    monkeypatch.setattr(combined, "segments_in", lambda *given: calls.append(1) or find(*given))
    odometry = make_odometry(settings.odometry, flight.T_drone_sensor)
    for k in range(4):
        odometry.update(flight.scans[k], flight.prior.T_world_drone[k])
    assert len(calls) == 4


def test_the_defaults_run():
    odometry = CombinedOdometry()
    assert odometry.settings == OdometrySettings.preset("combined", "starling2")
    assert odometry.settings.robust_scale_m == 0.03
    step = odometry.update(np.full((4, 4, 3), np.nan), np.eye(4))
    assert not step.used


def test_bars_do_not_turn_the_map_of_a_coarse_sensor():
    settings = ExperimentSettings.preset("loops", "random-walk", "combined", "report-4cm", seed=11, duration_s=25.0)
    flight, truth = experiment.simulate(settings)
    as_points = {"clouds.bars_weight": 1.0, "clouds.sigma_filter_px": 0, "prior_sigma": (0.05, 0.02)}
    preset, heavy = (
        run(flight, make_odometry(settings.odometry.override(changes), flight.T_drone_sensor))
        for changes in ({}, as_points)
    )
    ours, others = (score_trajectory(each.corrected, truth.trajectory)["ate_rmse_m"] for each in (preset, heavy))
    assert ours < 0.7 * others  # 0.47 to 0.74 over seeds 11 to 14
    assert ours < 0.5 * score_trajectory(flight.prior, truth.trajectory)["ate_rmse_m"]
