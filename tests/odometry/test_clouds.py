import functools

import numpy as np
import pytest
from scipy.spatial import cKDTree

from steelnb import experiment, odometry
from steelnb.metrics import position_error_m
from steelnb.odometry import CloudOdometry, clouds, prediction
from steelnb.points import VoxelMap, preprocess_scan
from steelnb.settings import METHODS, ExperimentSettings, OdometrySettings

NOISE = "constant-drift:0.0005+random-walk"


@pytest.fixture(scope="module")
def world():
    settings = ExperimentSettings.preset("zigzag", NOISE, sensor="starling2", seed=3, duration_s=10.0, method="best")
    return settings, *experiment.simulate(settings)


@pytest.fixture(scope="module")
def run(world):
    """A method's odometry after the flight, its estimate and errors; the tests share the runs and change nothing."""
    _, flight, truth = world

    @functools.cache
    def fly(method):
        estimator = odometry.make_odometry(OdometrySettings.preset(method), flight.T_drone_sensor)
        estimate = odometry.run(flight, estimator)
        return estimator, estimate, position_error_m(estimate.corrected, truth.trajectory)

    return fly


CLOUDS_ALONE = [method for method in METHODS if OdometrySettings.preset(method).family in ("clouds", "loam")]


@pytest.mark.parametrize("method", CLOUDS_ALONE)
def test_every_method_takes_most_of_the_drift_out(world, run, method):
    _, flight, truth = world
    raw = position_error_m(flight.prior, truth.trajectory)
    _, estimate, error = run(method)
    assert raw[-1] > 0.5
    assert error[-1] < 0.3 * raw[-1]
    assert estimate.reason[0] == "first scan"
    assert np.mean([not reason for reason in estimate.reason[1:]]) > 0.95
    assert len(estimate.points) > 500
    assert len(estimate.segments) == 0


def test_best_is_within_two_centimetres_and_beats_the_report_s(run):
    error = {method: run(method)[2].mean() for method in ("best", "gicp", "icp")}
    assert error["best"] < 0.02
    assert error["best"] < min(error["gicp"], error["icp"])


def test_restricted_methods_leave_the_other_angles_alone(world, run):
    prior, roll_and_pitch, all_three = world[1].prior.T_world_drone, np.s_[:, 2, :3], np.s_[:, :3, :3]
    for method, part in {"icp-3dof": all_three, "icp-4dof": roll_and_pitch, "best": roll_and_pitch}.items():
        np.testing.assert_allclose(run(method)[1].corrected.T_world_drone[part], prior[part], atol=1e-9)


def test_scans_are_mapped_at_the_poses_put_out(world, run):
    settings, flight, _ = world
    estimator, estimate, _ = run("icp-3dof")
    again = VoxelMap(estimator.settings.map_voxel_m, estimator.settings.map != "re-voxelised")
    corrected = estimate.corrected.T_world_drone
    for scan, found, T in zip(flight.scans, corrected, flight.prior.T_world_drone, strict=True):
        # The floor is cut at the predicted pose: that of the previous step, moved by the prior's increment.
        points = preprocess_scan(scan, T, flight.T_drone_sensor, settings.odometry.preprocess.replace(floor_m=0.6))
        again.insert(points @ found[:3, :3].T + found[:3, 3])
    high = [points[points[:, 2] > 1.5] for points in (estimate.points, again.means())]
    apart = cKDTree(high[0]).query(high[1])[0]
    assert np.quantile(apart, 0.9) < 1e-9


def test_a_scan_that_cannot_be_registered_keeps_the_prior_and_stays_out_of_the_map(world):
    _, flight, _ = world
    estimator = CloudOdometry(OdometrySettings.preset("best"), flight.T_drone_sensor)
    for k in range(5):
        estimator.update(flight.scans[k], flight.prior.T_world_drone[k])
    before, offset = len(estimator.map), estimator.prediction.offset.copy()
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
        step = estimator.update(scan, prior)
        assert not step.used
        assert reason in step.reason
        # At first with one frame of the drift's rate, then as it was.
        np.testing.assert_allclose(
            step.T_world_drone[:3, 3], prior[:3, 3] + offset, atol=5e-3 if scan is nothing else 0
        )
        assert len(estimator.map) == before
    assert estimator.update(flight.scans[6], flight.prior.T_world_drone[6]).used


def test_a_constant_drift_is_followed_by_its_rate(world, run, monkeypatch):
    # Without prediction, every frame starts and ends slightly behind, and the map accumulates that.
    _, flight, truth = world
    hasty = clouds.MEASURED._replace(iterations_max={"xyz_yaw": 3})
    monkeypatch.setitem(clouds.MAPS, "measured", hasty)
    estimator, _, error = run.__wrapped__("best")
    monkeypatch.setattr(prediction, "DRIFT_GAIN", 0.0)
    behind = run.__wrapped__("best")[2]
    drift = flight.prior.position - truth.trajectory.at(flight.prior.stamp_s).position
    rate = -(drift[-1] - drift[0]) / (len(drift) - 1)
    np.testing.assert_allclose(estimator.prediction.offset_rate, rate, atol=0.25 * np.linalg.norm(rate))
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
    outside = error[(stamp < 5) | (stamp >= 11)]  # two seconds after a gap do not count
    assert result.metrics["ate_outside_gaps_rmse_m"] == pytest.approx(np.sqrt((outside**2).mean()))
    assert result.metrics["ate_outside_gaps_rmse_m"] < 0.03
    assert result.metrics["error_after_gaps_max_m"] == pytest.approx(error[(stamp >= 11) & (stamp < 12)].max())


def test_the_sigma_filter_halves_the_error_with_twice_the_range_noise():
    def chosen(half):
        more = {"tof.sigma_relative": 0.02, "sigma_filter_px": half}
        return ExperimentSettings.preset("loops", "random-walk", "best", "starling2", 12, 8.0, more)

    flight, truth = experiment.simulate(chosen(0))
    plain, filtered = (experiment.estimate(chosen(k), flight, truth).metrics["ate_rmse_m"] for k in (0, 1))
    assert filtered < min(0.5 * plain, 0.02)


def test_the_defaults_of_all_entrances_agree():
    assert CloudOdometry().settings == OdometrySettings.preset("best", "starling2")
    assert CloudOdometry().settings == ExperimentSettings.preset(method="best").odometry
