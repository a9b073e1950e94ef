import functools

import numpy as np
import pytest
from scipy.spatial import cKDTree

from steelnb import experiment
from steelnb.core.types import Trajectory
from steelnb.metrics import position_error_m, score_gaps
from steelnb.odometry import CloudOdometry, LoamOdometry, clouds, drift_filter
from steelnb.points import VoxelMap, preprocess_scan
from steelnb.settings import METHODS, ExperimentSettings, OdometrySettings

NOISE = "constant-drift:0.0004+random-walk"


@pytest.fixture(scope="module")
def world():
    settings = ExperimentSettings.preset("zigzag", NOISE, sensor="starling2", seed=3, duration_s=12.0, method="best")
    return settings, *experiment.simulate(settings)


@pytest.fixture(scope="module")
def run(world):
    """A method's odometry after the flight, its steps and its errors; the tests share the runs and change nothing."""
    _, flight, truth = world

    @functools.cache
    def fly(method, **changes):
        kind = LoamOdometry if method.startswith("loam") else CloudOdometry
        odometry = kind(OdometrySettings.preset(method, overrides=changes), flight.T_drone_sensor)
        steps = [odometry.update(s, T) for s, T in zip(flight.scans, flight.prior.T_world_drone, strict=True)]
        corrected = Trajectory(flight.prior.stamp_s, np.array([step.T_world_drone for step in steps]))
        return odometry, steps, position_error_m(corrected, truth.trajectory)

    return fly


CLOUDS_ALONE = [method for method in METHODS if OdometrySettings.preset(method).family in ("clouds", "loam")]


@pytest.mark.parametrize("method", CLOUDS_ALONE)
def test_every_method_takes_most_of_the_drift_out(world, run, method):
    _, flight, truth = world
    raw = position_error_m(flight.prior, truth.trajectory)
    odometry, steps, error = run(method)
    assert raw[-1] > 0.5
    assert error[-1] < 0.3 * raw[-1]
    assert steps[0].reason == "first scan"
    assert np.mean([step.used for step in steps[1:]]) > 0.95
    assert len(odometry.map_points()) > 500
    assert len(odometry.map_segments()) == 0


def test_best_is_within_two_centimetres_and_beats_the_report_s(run):
    error = {method: run(method)[2].mean() for method in ("best", "gicp", "icp")}
    assert error["best"] < 0.02
    assert error["best"] < min(error["gicp"], error["icp"])


def test_restricted_methods_leave_the_other_angles_alone(world, run):
    _, flight, _ = world
    roll_and_pitch, all_three = np.s_[2, :3], np.s_[:3, :3]
    kept = {"icp-3dof": all_three, "icp-4dof": roll_and_pitch, "best": roll_and_pitch}
    for method, part in kept.items():
        for step, T in zip(run(method)[1], flight.prior.T_world_drone, strict=True):
            np.testing.assert_allclose(step.T_world_drone[part], T[part], atol=1e-9)


def test_scans_are_mapped_at_the_poses_put_out(world, run):
    settings, flight, _ = world
    odometry, steps, _ = run("icp-3dof")
    again = VoxelMap(odometry.settings.map_voxel_m, odometry.settings.map != "re-voxelised")
    for scan, step, T in zip(flight.scans, steps, flight.prior.T_world_drone, strict=True):
        # The floor is cut at the predicted pose: that of the previous step, moved by the prior's increment.
        points = preprocess_scan(scan, T, flight.T_drone_sensor, settings.odometry.preprocess.replace(floor_m=0.6))
        again.insert(points @ step.T_world_drone[:3, :3].T + step.T_world_drone[:3, 3])
    high = [points[points[:, 2] > 1.5] for points in (odometry.map_points(), again.means())]
    apart = cKDTree(high[0]).query(high[1])[0]
    assert np.quantile(apart, 0.9) < 1e-9


def test_a_scan_that_cannot_be_registered_keeps_the_prior_and_stays_out_of_the_map(world):
    _, flight, _ = world
    odometry = CloudOdometry(OdometrySettings.preset("best"), flight.T_drone_sensor)
    for k in range(5):
        odometry.update(flight.scans[k], flight.prior.T_world_drone[k])
    before, offset = len(odometry.map), odometry.prediction.offset.copy()
    T = flight.prior.T_world_drone[5]
    far = flight.prior.T_world_drone[5].copy()
    far[0, 3] += 40
    nothing = np.full((4, 4, 3), np.nan)
    ball = np.random.default_rng(0).normal((4.0, 0.0, 2.0), 0.6, (2000, 3))
    for scan, prior, reason in (
        (nothing, T, "too few points"),
        (flight.scans[5], far, "no map in sight"),
        (ball, T, "too little overlap"),
    ):
        step = odometry.update(scan, prior)
        assert not step.used
        assert reason in step.reason
        # At first with one frame of the drift's rate, then as it was.
        np.testing.assert_allclose(
            step.T_world_drone[:3, 3], prior[:3, 3] + offset, atol=5e-3 if scan is nothing else 0
        )
        assert len(odometry.map) == before
    assert odometry.update(flight.scans[6], flight.prior.T_world_drone[6]).used


def test_a_constant_drift_is_followed_by_its_rate(world, run, monkeypatch):
    # Without prediction, every frame starts and ends slightly behind, and the map accumulates that.
    _, flight, truth = world
    hasty = clouds.MEASURED._replace(iterations_max={"xyz_yaw": 3})
    monkeypatch.setitem(clouds.MAPS, "measured", hasty)
    odometry, _, error = run.__wrapped__("best")
    monkeypatch.setattr(drift_filter, "DRIFT_GAIN", 0.0)
    behind = run.__wrapped__("best")[2]
    drift = flight.prior.position - truth.trajectory.at(flight.prior.stamp_s).position
    rate = -(drift[-1] - drift[0]) / (len(drift) - 1)
    np.testing.assert_allclose(odometry.prediction.offset_rate, rate, atol=0.25 * np.linalg.norm(rate))
    assert error[-10:].mean() < 0.8 * behind[-10:].mean()


def test_it_recovers_after_a_gap():
    settings = ExperimentSettings.preset(
        "zigzag", "random-walk", sensor="starling2", seed=4, duration_s=14.0, method="best",
        overrides={"tof.blind_s": [[5.0, 9.0]]},
    )  # fmt: skip
    result = experiment.run(settings)
    stamp = result.corrected.stamp_s
    blind = (stamp >= 5) & (stamp < 9)
    assert (result.matches[blind] == 0).all()
    error = position_error_m(result.corrected, result.truth.trajectory)
    assert error[stamp > 11].max() < 0.04
    assert result.metrics["ate_outside_gaps_rmse_m"] < 0.03
    assert result.metrics["error_after_gaps_max_m"] == pytest.approx(error[(stamp >= 11) & (stamp < 12)].max())


def test_the_sigma_filter_halves_the_error_with_twice_the_range_noise():
    def chosen(half):
        more = {"tof.sigma_relative": 0.02, "sigma_filter_px": half}
        return ExperimentSettings.preset("loops", "random-walk", "best", "starling2", 12, 12.0, more)

    flight, truth = experiment.simulate(chosen(0))
    plain, filtered = (experiment.estimate(chosen(k), flight, truth).metrics["ate_rmse_m"] for k in (0, 1))
    assert filtered < min(0.5 * plain, 0.02)


def test_gaps_are_left_out_of_the_error():
    T = np.tile(np.eye(4), (50, 1, 1))
    truth = Trajectory(np.arange(50) * 0.2, T)
    drifted = T.copy()
    drifted[10:30, 0, 3] = 1.0  # wrong from 2 s to 6 s
    score = score_gaps(Trajectory(truth.stamp_s, drifted), truth, [(2.0, 4.0)])
    assert score["ate_outside_gaps_rmse_m"] == 0.0
    assert score["error_after_gaps_max_m"] == 0.0
    assert score_gaps(Trajectory(truth.stamp_s, drifted), truth, [(2.0, 3.0)])["ate_outside_gaps_rmse_m"] > 0.1


def test_the_defaults_of_all_entrances_agree():
    assert CloudOdometry().settings == OdometrySettings.preset("best", "starling2")
    assert CloudOdometry().settings == ExperimentSettings.preset(method="best").odometry
