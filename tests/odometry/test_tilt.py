"""Roll and pitch errors of the prior, corrected by clouds and by faces of bars."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb import fusion
from steelnb.core.geometry import tilt_of
from steelnb.fusion.adjustment.factors import TILT_S
from steelnb.metrics import score_trajectory
from steelnb.odometry import correct, faces, methods
from steelnb.odometry.prediction import DriftPrediction, RegisteredPose
from steelnb.settings import OdometrySettings

SIGMA_RAD = 0.0175


def tilt_rms_deg(trajectory, truth) -> float:
    true = truth.trajectory.at(trajectory.stamp_s).T_world_drone[:, :3, :3]
    tilt = tilt_of(trajectory.T_world_drone[:, :3, :3] @ true.transpose(0, 2, 1))
    return float(np.degrees(np.sqrt((tilt**2).sum(axis=1).mean())))


def fly(flight, method):
    return correct(flight, OdometrySettings.preset(method, overrides={"tilt_sigma_rad": SIGMA_RAD}))


def test_an_odometry_corrects_the_tilt_of_its_prior(tilted):
    flight, truth = tilted
    found = fly(flight, "best")
    assert score_trajectory(found.corrected, truth.trajectory)["ate_rmse_m"] < 0.05
    assert tilt_rms_deg(flight.prior, truth) > 3.0
    assert tilt_rms_deg(found.corrected, truth) < 0.5
    assert not any(found.reason[1:])


def test_so_does_one_by_faces_and_the_smoothing(tilted, monkeypatch):
    monkeypatch.setattr(faces, "REFIT_S", 4.0)
    before = []  # the estimate that is smoothed: that of `faces`
    monkeypatch.setattr(methods, "smooth", lambda *given: before.append(given[1]) or fusion.smooth(*given))
    truth, smooth = tilted[1], fly(tilted[0], "smoothed")
    (online,) = before
    assert score_trajectory(online.corrected, truth.trajectory)["ate_rmse_m"] < 0.03
    assert tilt_rms_deg(online.corrected, truth) < 0.5
    assert score_trajectory(smooth.corrected, truth.trajectory)["ate_rmse_m"] < 0.02
    assert tilt_rms_deg(smooth.corrected, truth) < 0.2
    assert 0.2 < nees(smooth, truth.trajectory).mean() / 6 < 5.0


def nees(smooth, truth) -> np.ndarray:
    """Normalised estimation error squared of each pose after the first. Its mean is 6 if the covariances are right."""
    T, true = smooth.corrected.T_world_drone[1:], truth.at(smooth.corrected.stamp_s[1:]).T_world_drone
    turned = Rotation.from_matrix(true[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
    error = np.column_stack([(true - T)[:, :3, 3], turned])
    weighted = np.linalg.solve(smooth.pose_covariance[1:], error[:, :, None])[:, :, 0]
    return np.einsum("ni,ni->n", error, weighted)


def test_what_no_scan_tells_of_the_tilt_fades_and_the_yaw_stays():
    prediction, prior = DriftPrediction((0.05, 0.02), SIGMA_RAD), np.eye(4)
    prior[:3, :3] = Rotation.from_euler("zyx", [0.4, 0.02, -0.01]).as_matrix()
    pose = prior.copy()
    tilt = Rotation.from_rotvec([0.03, -0.02, 0.0]).as_matrix()
    pose[:3, :3] = tilt @ Rotation.from_rotvec([0.0, 0.0, 0.7]).as_matrix() @ prior[:3, :3]
    prediction.pose(prior, 0.0)
    prediction.correct(RegisteredPose(pose))
    later = prediction.pose(prior, TILT_S)[:3, :3] @ prior[:3, :3].T
    np.testing.assert_allclose(tilt_of(later.T), -np.exp(-1) * np.array([0.03, -0.02]), atol=2e-5)
    assert np.arctan2(later[1, 0], later[0, 0]) == pytest.approx(0.7, abs=1e-3)
    for passed_s, sigma_rad in ((1e6, SIGMA_RAD), (0.1, SIGMA_RAD * (0.2 / TILT_S) ** 0.5)):
        prediction.pose(prior, passed_s)
        assert np.diag(prediction.information)[:2] == pytest.approx(sigma_rad**-2.0, rel=0.02)
