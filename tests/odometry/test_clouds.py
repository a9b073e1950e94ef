import numpy as np
import pytest
from scipy.spatial import cKDTree

from steelnb import experiment
from steelnb.config import CLOUD_METHODS, CloudSettings, ExperimentSettings, PreprocessSettings
from steelnb.datatypes import Trajectory
from steelnb.errors import SettingsError
from steelnb.mapping import VoxelMap
from steelnb.metrics import position_error_m, score_gaps
from steelnb.odometry import CloudOdometry
from steelnb.preprocess import preprocess_scan

NOISE = "constant-drift:0.0004+random-walk"


@pytest.fixture(scope="module")
def world():
    settings = ExperimentSettings.preset("vertical", NOISE, sensor="starling2", seed=3, duration_s=12.0, method="best")
    return settings, *experiment.simulate(settings)


def run(world, method, **changes):
    settings, flight, truth = world
    odometry = CloudOdometry(CloudSettings.preset(method).but(**changes), settings.preprocess, flight.T_drone_sensor)
    steps = [odometry.update(s, T) for s, T in zip(flight.scans, flight.prior.T_world_drone, strict=True)]
    corrected = Trajectory(flight.prior.stamp_s, np.array([step.T_world_drone for step in steps]))
    return odometry, steps, position_error_m(corrected, truth.trajectory)


@pytest.mark.parametrize("method", CLOUD_METHODS)
def test_every_method_takes_most_of_the_drift_out(world, method):
    _, flight, truth = world
    raw = position_error_m(flight.prior, truth.trajectory)
    odometry, steps, error = run(world, method)
    assert raw[-1] > 0.5
    assert error[-1] < 0.3 * raw[-1]
    assert not steps[0].used
    assert steps[0].reason == "first scan"
    assert np.mean([step.used for step in steps[1:]]) > 0.95
    assert len(odometry.map_points()) > 500
    assert len(odometry.map_segments()) == 0


def test_best_is_within_two_centimetres_and_beats_the_report_s(world):
    error = {method: run(world, method)[2].mean() for method in ("best", "gicp", "icp")}
    assert error["best"] < 0.02
    assert error["best"] < min(error["gicp"], error["icp"])


def test_restricted_methods_leave_the_other_angles_alone(world):
    _, flight, _ = world
    for method in ("icp-3dof", "icp-3dof-dropped"):
        _, steps, _ = run(world, method)
        for step, T in zip(steps, flight.prior.T_world_drone, strict=True):
            np.testing.assert_allclose(step.T_world_drone[:3, :3], T[:3, :3], atol=1e-9)
    for method in ("icp-4dof", "best"):
        _, steps, _ = run(world, method)
        for step, T in zip(steps, flight.prior.T_world_drone, strict=True):
            np.testing.assert_allclose(step.T_world_drone[2, :3], T[2, :3], atol=1e-9)  # roll and pitch


@pytest.mark.parametrize(("method", "same"), [("icp-3dof", True), ("icp-3dof-dropped", False)])
def test_only_the_original_s_fault_maps_scans_elsewhere_than_it_says_they_are(world, method, same):
    settings, flight, _ = world
    odometry, steps, _ = run(world, method)
    again = VoxelMap(odometry.settings.map_voxel_m, odometry.settings.remember)
    for scan, step, T in zip(flight.scans, steps, flight.prior.T_world_drone, strict=True):
        # The floor is cut at the pose before the correction: that of the step before, moved on by the prior.
        points = preprocess_scan(scan, T, flight.T_drone_sensor, settings.preprocess.but(floor_m=0.6))
        again.insert(points @ step.T_world_drone[:3, :3].T + step.T_world_drone[:3, 3])
    high = [points[points[:, 2] > 1.5] for points in (odometry.map_points(), again.means())]
    apart = cKDTree(high[0]).query(high[1])[0]
    assert (np.quantile(apart, 0.9) < 1e-9) == same


def test_a_scan_that_cannot_be_registered_keeps_the_prior_and_stays_out_of_the_map(world):
    settings, flight, _ = world
    odometry = CloudOdometry(CloudSettings.preset("best"), settings.preprocess, flight.T_drone_sensor)
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


def test_a_constant_drift_is_followed_by_its_rate(world):
    # Without prediction every frame starts behind by the same and stops behind by a little, which the map adds up.
    _, flight, truth = world
    odometry, _, error = run(world, "best")
    behind = run(world, "best", accelerated=False, drift_gain=0.0)[2]
    drift = flight.prior.position - truth.trajectory.at(flight.prior.stamp_s).position
    rate = -(drift[-1] - drift[0]) / (len(drift) - 1)
    np.testing.assert_allclose(odometry.prediction.offset_rate, rate, atol=0.25 * np.linalg.norm(rate))
    assert error[-10:].mean() < behind[-10:].mean()


def test_it_recovers_after_a_gap():
    settings = ExperimentSettings.preset(
        "vertical", "random-walk", sensor="starling2", seed=4, duration_s=14.0, method="best",
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


def test_gaps_are_left_out_of_the_error():
    T = np.tile(np.eye(4), (50, 1, 1))
    truth = Trajectory(np.arange(50) * 0.2, T)
    drifted = T.copy()
    drifted[10:30, 0, 3] = 1.0  # wrong from 2 s to 6 s
    score = score_gaps(Trajectory(truth.stamp_s, drifted), truth, [(2.0, 4.0)])
    assert score["ate_outside_gaps_rmse_m"] == 0.0
    assert score["error_after_gaps_max_m"] == 0.0
    assert score_gaps(Trajectory(truth.stamp_s, drifted), truth, [(2.0, 3.0)])["ate_outside_gaps_rmse_m"] > 0.1


def test_the_defaults_are_best_with_the_report_s_crop():
    odometry = CloudOdometry()
    assert odometry.settings.method == "best"
    assert odometry.preprocess == PreprocessSettings(x_max_m=4.0, y_max_m=4.0, z_max_m=4.0)


def test_a_prior_that_is_no_pose_is_refused():
    with pytest.raises(SettingsError, match="T_world_drone_prior"):
        CloudOdometry().update(np.zeros((5, 3)), np.eye(3))
