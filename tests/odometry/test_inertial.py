"""The filter that predicts poses from an IMU: exact on exact readings, with correct covariances, and in odometries."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.core.geometry import exp_about, information_at, pose_difference
from steelnb.core.types import Imu
from steelnb.fusion.adjustment.factors import DRIFT_SIGMA
from steelnb.fusion.adjustment.imu_factors import BIAS, POSE
from steelnb.metrics import score_trajectory
from steelnb.odometry import correct, faces, make_odometry, run
from steelnb.odometry.inertial import SHIFT, TURN, InertialPrediction
from steelnb.odometry.prediction import NO_ERROR, LastingError, RegisteredPose
from steelnb.points import VoxelMap
from steelnb.settings import ImuSettings, OdometrySettings
from steelnb.simulation import measured_imu
from tests.fusion.test_imu_factors import EVERY, SHEET, swaying
from tests.odometry.test_tilt import tilt_rms_deg

TURN_RAD, PLACE_M = 0.002, 0.004
TOLD = np.diag([TURN_RAD**-2.0] * 3 + [PLACE_M**-2.0] * 3)


def drifted(T, rng):
    """Poses whose position and yaw drift as the filter assumes of a prior; roll and pitch stay."""
    walk = np.cumsum(DRIFT_SIGMA * rng.normal(size=(len(T), 4)), axis=0)
    prior = T.copy()
    for k in range(1, len(T)):
        prior[k, :3, :3] = Rotation.from_euler("z", walk[k, 0]).as_matrix() @ T[k, :3, :3]
        step = prior[k - 1, :3, :3] @ T[k - 1, :3, :3].T @ (T[k, :3, 3] - T[k - 1, :3, 3])
        prior[k, :3, 3] = prior[k - 1, :3, 3] + step + walk[k, 1:] - walk[k - 1, 1:]
    return prior


def flown(imu, true, stamp_s, prior, rng=None, registered=lambda k: True, model=NO_ERROR, lost=None):
    """The filter after scans registered with noise and, if ``lost (K, 6)``, these errors besides; and the error of each
    prediction, with the states before and after the registration. ``model``: of the errors, as the filter knows it."""
    prediction, found = InertialPrediction(imu, SHEET), []
    for k, T in enumerate(true):
        T_init = prediction.pose(prior[k], stamp_s[k], model)
        ahead = prediction.predicted
        if registered(k):
            noise = np.zeros(6) if rng is None else rng.normal(size=6) * np.sqrt(np.diag(np.linalg.inv(TOLD)))
            measured = exp_about(T[:3, 3], noise if lost is None else noise + lost[k]) @ T
            # The most likely pose, as found by a registration with the filter's term.
            before = prediction.information
            step = np.linalg.solve(before + TOLD, TOLD @ pose_difference(T_init, measured))
            prediction.correct(RegisteredPose(exp_about(T_init[:3, 3], step) @ T_init, H=before + TOLD))
        else:
            prediction.lose()
        found.append((pose_difference(T_init, T), ahead, prediction.state))
    return prediction, found


def at_scans(scans):
    trajectory, imu, _ = swaying(scans)
    return trajectory.T_world_drone[::EVERY], trajectory.stamp_s[::EVERY], imu


def test_exact_readings_predict_the_motion_and_their_biases_are_found():
    true, stamp_s, imu = at_scans(60)
    bias = np.array([0.001, -0.0005, 0.0008, 0.02, -0.01, 0.015])
    biased = Imu(imu.stamp_s, imu.specific_force + bias[3:], imu.angular_rate + bias[:3])
    prediction, found = flown(biased, true, stamp_s, true)
    error = np.array([each for each, *_ in found])
    np.testing.assert_allclose(error[30:, :3], 0.0, atol=2e-4)
    np.testing.assert_allclose(error[30:, 3:], 0.0, atol=1e-3)
    sigma = np.sqrt(np.diag(prediction.state.covariance)[BIAS])
    assert (np.abs(prediction.state.bias - bias) < 3 * sigma).all()
    assert sigma[:3].max() < 5e-4 < SHEET.gyro_bias
    assert sigma[3:].max() < SHEET.accelerometer_bias


def test_a_prediction_is_as_uncertain_as_it_says():
    true, stamp_s, imu = at_scans(40)
    squares = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        read = measured_imu(imu, SHEET, seed)
        _, found = flown(read, true, stamp_s, drifted(true, rng), rng, registered=lambda k: k % 10)
        squares += [
            error @ np.linalg.solve(ahead.covariance[POSE, POSE], error) / 6 for error, ahead, _ in found[1:]
        ]  # fmt: skip
    assert 0.7 < np.mean(squares) < 1.4


def test_without_readings_it_follows_the_prior_and_knows_less():
    true, stamp_s, imu = at_scans(12)
    kept = (imu.stamp_s < stamp_s[8] + 0.02) | (imu.stamp_s > stamp_s[9] - 0.02)
    torn = Imu(imu.stamp_s[kept], imu.specific_force[kept], imu.angular_rate[kept])
    prior = true.copy()
    prior[9:, :3, 3] += [0.02, 0.0, -0.01]
    (_, whole), (_, found) = (flown(each, true, stamp_s, prior) for each in (imu, torn))
    np.testing.assert_allclose(found[9][0][3:], [-0.02, 0.0, 0.01], atol=3e-3)
    assert np.linalg.norm(whole[9][0][3:]) < 0.3 * np.linalg.norm(found[9][0][3:])
    size = [np.sqrt(np.diag(each[9][1].covariance)) for each in (whole, found)]
    assert (size[1] > 2 * size[0])[:9].all()
    for each in found[10:]:  # the readings are back, and the velocity is known again
        assert np.abs(each[0][3:]).max() < 0.015


def test_a_shift_that_a_scan_does_not_observe_stays_as_unsure_as_it_was():
    true, stamp_s, imu = at_scans(6)
    prediction, _ = flown(imu, true, stamp_s, true, registered=lambda k: k < 5)
    prediction.pose(true[5], stamp_s[5])
    before = prediction.predicted.covariance
    along = np.array([[0.6, 0.8, 0.0]])
    prediction.correct(RegisteredPose(prediction.predicted.T_world_drone, along, prediction.information + TOLD))
    after = prediction.state.covariance
    pose = np.linalg.inv(after[POSE, POSE]) - np.linalg.inv(before[POSE, POSE])
    u = np.append(np.zeros(3), along)
    assert u @ pose @ u == pytest.approx(0.0, abs=1e-3 * TOLD.max())
    assert pose[5, 5] == pytest.approx(TOLD[5, 5], rel=1e-6)


def test_the_term_is_the_distance_from_the_prediction_whatever_the_centre_of_the_twist():
    true, stamp_s, imu = at_scans(4)
    prediction, _ = flown(imu, true, stamp_s, true)
    T = prediction.pose(true[3], stamp_s[3] + 0.1)
    rng = np.random.default_rng(1)
    pose, centre = exp_about(T[:3, 3], 0.01 * rng.normal(size=6)) @ T, T[:3, 3] + [1.0, 2.0, -1.5]
    (term,) = prediction.terms(T, np.zeros((0, 3)))
    H, b, loss = term(pose, centre)
    d = pose_difference(T, pose)
    assert loss == pytest.approx(0.5 * d @ prediction.information @ d)
    for step in 1e-6 * np.eye(6):
        ahead, behind = (term(exp_about(centre, s * step) @ pose, centre)[2] for s in (1, -1))
        assert (ahead - behind) / 2e-6 == pytest.approx(b @ step / 1e-6, rel=0.02, abs=1e-3 * np.abs(b).max())
    np.testing.assert_allclose(information_at(H, pose[:3, 3] - centre), prediction.information, rtol=1e-6)


def test_an_odometry_takes_roll_and_pitch_from_the_readings_not_from_its_prior(tilted, monkeypatch):
    monkeypatch.setattr(faces, "REFIT_S", 4.0)
    flight, truth = tilted
    flight = replace(flight, imu=measured_imu(flight.imu, SHEET, 3))
    settings = OdometrySettings.preset("faces").override({"inertial": SHEET.model_dump()})
    found = correct(flight, settings)
    assert tilt_rms_deg(flight.prior, truth) > 3.0
    # The bias of the accelerometer is 0.039 m/s² across: a lean of 0.23 degrees, of which 16 s tell little.
    assert tilt_rms_deg(found.corrected, truth) < 0.25
    assert score_trajectory(found.corrected, truth.trajectory)["ate_rmse_m"] < 0.03
    assert not any(found.reason[1:])
    true = truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    squares = squares_of_poses(found.corrected.T_world_drone[1:], true[1:], found.pose_covariance[1:])
    assert np.all((squares > 0.02) & (squares < 2.0))
    told = correct(replace(flight, range_sigmas=(0.01, 0.0)), settings)
    stretch = told.pose_covariance - found.pose_covariance
    shift = (found.corrected.position - found.corrected.position[0])[:, :, None]
    np.testing.assert_allclose(stretch[:, :3, :3], 1e-4 * shift * shift.transpose(0, 2, 1), atol=1e-6)
    assert not stretch[:, 3:].any()


def squares_of_poses(T, true, covariance):
    """Mean normalised squared errors of position and rotation."""
    error = np.array([np.roll(pose_difference(a, b), 3) for a, b in zip(T, true, strict=True)])[:, :, None]
    parts = slice(0, 3), slice(3, 6)
    solved = [error[:, p].transpose(0, 2, 1) @ np.linalg.solve(covariance[:, p, p], error[:, p]) for p in parts]
    return np.mean(solved, axis=(1, 2, 3)) / 3


def test_a_pose_that_is_put_out_is_as_uncertain_as_its_covariance_says():
    true, stamp_s, imu = at_scans(60)
    lasting, squares = LastingError(0.003, 0.03, 10.0), []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        prior, lost = drifted(true, rng), lasting_errors(lasting, stamp_s, rng)
        readings = measured_imu(imu, SHEET, seed)
        prediction, found = flown(readings, true, stamp_s, prior, rng, model=lasting, lost=lost)
        poses, covariances = [], []
        for _, _, prediction.state in found[11:]:
            poses.append(prediction.levelled(prediction.state.T_registered))
            covariances.append(prediction.covariance(poses[-1]))
        squares.append(squares_of_poses(poses, true[11:], np.array(covariances)))
    position, rotation = np.mean(squares, axis=0)
    assert 0.4 < position < 1.5
    assert 0.4 < rotation < 1.5


def test_bars_correct_a_pose_that_clouds_have_led_astray_and_the_filter_expects_that(tilted, monkeypatch):
    monkeypatch.setattr(faces, "REFIT_S", 4.0)
    flight, truth = tilted
    flight = replace(flight, imu=measured_imu(flight.imu, SHEET, 3))
    estimator = make_odometry(
        OdometrySettings.preset("faces").override({"inertial": SHEET.model_dump()}), flight.T_drone_sensor, flight.imu
    )
    true = truth.trajectory.at(flight.prior.stamp_s).position
    located, begin, end, error_m = estimator._located, 33, 45, []
    for k in range(end + 3):
        if k == begin:  # from here on, only clouds are registered, to a map that lies 8 cm higher
            elsewhere = VoxelMap(estimator.clouds.map.voxel_m, estimator.clouds.map.accumulate)
            elsewhere.insert(estimator.map_points() + np.array([0.0, 0.0, 0.08]))
            estimator.clouds.map = elsewhere
        estimator._located = (lambda *_: None) if begin <= k < end else located
        step = estimator.update(flight.scans[k], flight.prior.T_world_drone[k])
        state = estimator.prediction.state
        error_m.append(np.linalg.norm(step.T_world_drone[:3, 3] - true[k]))
        if k == end - 1:
            assert 0.01 < np.sqrt(np.diag(state.covariance)[POSE][3:]).max() < 0.04
    assert error_m[begin - 1] < 0.02 < 0.05 < error_m[end - 1]
    assert error_m[-1] < 0.02


def test_the_readings_count_only_if_the_settings_know_their_noise(tilted):
    flight = tilted[0].first(12)
    poses = {}
    for noise in (SHEET.model_dump(), False):
        settings = OdometrySettings.preset("faces", overrides={"inertial": noise})
        for name, imu in (("exact", flight.imu), ("noisy", measured_imu(flight.imu, SHEET, 1)), ("none", None)):
            found = run(flight, make_odometry(settings, flight.T_drone_sensor, imu))
            poses[bool(noise), name] = found.corrected.T_world_drone
            assert (found.pose_covariance is not None) == (bool(noise) and imu is not None)
    plain = poses[False, "none"]
    for each in ((False, "exact"), (False, "noisy"), (True, "none")):
        np.testing.assert_array_equal(poses[each], plain)
    assert not np.array_equal(poses[True, "exact"], plain)
    assert not np.array_equal(poses[True, "exact"], poses[True, "noisy"])


def test_an_imu_without_errors_is_no_division_by_zero():
    true, stamp_s, imu = at_scans(10)
    prediction = InertialPrediction(imu, ImuSettings())
    for k, T in enumerate(true):
        prediction.pose(T, stamp_s[k])
        prediction.lose()
    assert np.isfinite(prediction.state.covariance).all()
    assert np.abs(pose_difference(prediction.state.T_world_drone, true[-1])[3:]).max() < 0.05


def lasting_errors(lasting, stamp_s, rng):
    """Errors (K, 6) of registrations, zero at the first scan; rotations walk."""
    error, decay = np.zeros((len(stamp_s), 6)), np.exp(-np.diff(stamp_s) / lasting.time_s)
    for k, each in enumerate(decay):
        kept = np.repeat([1.0, each], 3)
        error[k + 1] = kept * error[k] + np.sqrt((1 - each**2) * lasting.variance) * rng.normal(size=6)
    return error


def squares_of(model, lasting, seeds):
    """Mean normalised squared errors of position, velocity, roll and pitch, if registrations have a ``lasting`` error
    and the filter believes in a ``model`` of it."""
    trajectory, imu, _ = swaying(60)
    true, stamp_s = trajectory.T_world_drone[::EVERY], trajectory.stamp_s[::EVERY]
    velocity = np.gradient(trajectory.position, trajectory.stamp_s, axis=0)[::EVERY]
    squares = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        prior, lost = drifted(true, rng), lasting_errors(lasting, stamp_s, rng)
        _, found = flown(measured_imu(imu, SHEET, seed), true, stamp_s, prior, rng, model=model, lost=lost)
        for k in range(11, len(true)):
            state = found[k][2]
            e, P, v = pose_difference(state.T_world_drone, true[k]), state.covariance, velocity[k] - state.velocity
            squares.append([
                e[3:] @ np.linalg.solve(P[3:6, 3:6], e[3:]) / 3, v @ np.linalg.solve(P[6:9, 6:9], v) / 3,
                e[:2] @ np.linalg.solve(P[:2, :2], e[:2]) / 2,
            ])  # fmt: skip
    return np.mean(squares, axis=0)


def test_a_hundred_registrations_that_share_an_error_do_not_count_a_hundred_times():
    lasting = LastingError(0.003, 0.03, 10.0)
    position, velocity, tilt = squares_of(lasting, lasting, 12)
    assert 0.5 < position < 1.5
    assert 0.5 < velocity < 1.5
    assert 0.4 < tilt < 1.8
    assert squares_of(NO_ERROR, lasting, 3)[0] > 5


def led_astray(true, stamp_s, imu, lasting, off):
    """A filter told by nearly certain registrations, which are off by a twist ``off (6,)`` after the first scan."""
    prediction = InertialPrediction(imu, SHEET)
    for k, T in enumerate(true):
        prediction.pose(T, stamp_s[k], lasting)
        registered = exp_about(T[:3, 3], np.array(off) * (k > 0)) @ T
        prediction.correct(RegisteredPose(registered, H=prediction.information + 100 * TOLD))
    return prediction, registered


def test_another_map_has_an_error_of_its_own():
    true, stamp_s, imu = at_scans(9)
    one, other = LastingError(0.003, 0.03, 10.0), LastingError(0.001, 0.01, 20.0)
    prediction, _ = led_astray(true[:8], stamp_s, imu, one, [0, 0, 0, 0.02, 0, 0])
    before = prediction.state
    assert before.error[3] > 0.005
    prediction.pose(true[8], stamp_s[8], other)
    assert np.abs(prediction.predicted.error[3:]).max() == 0.0
    np.testing.assert_allclose(np.diag(prediction.predicted.covariance)[SHIFT], other.variance[3:], rtol=1e-6)
    np.testing.assert_allclose(prediction.predicted.covariance[TURN, TURN], before.covariance[TURN, TURN], atol=1e-5)


def test_a_moved_map_takes_the_position_along_but_tells_no_vertical():
    true, stamp_s, imu = at_scans(8)
    prediction, _ = led_astray(true, stamp_s, imu, LastingError(0.003, 0.03, 10.0), np.zeros(6))
    before, leant = prediction.state, exp_about(true[7, :3, 3], np.array([0.004, -0.002, 0.003, 0.02, 0.01, -0.01]))
    prediction.adjust(leant, np.full(6, 1e-6))
    after = prediction.state
    np.testing.assert_allclose(after.T_registered, leant @ before.T_registered, atol=1e-12)
    np.testing.assert_allclose(after.T_world_drone[:3, 3], after.T_registered[:3, 3], atol=1e-12)
    np.testing.assert_allclose(after.T_world_drone[:3, :3], before.T_world_drone[:3, :3], atol=2e-5)
    np.testing.assert_allclose(after.covariance[:3, :3], before.covariance[:3, :3], atol=1e-12)
    np.testing.assert_array_equal(after.bias, before.bias)


def test_roll_and_pitch_that_are_put_out_are_those_of_gravity():
    true, stamp_s, imu = at_scans(60)
    prediction, registered = led_astray(true, stamp_s, imu, LastingError(0.01, 0.03, 10.0), [0.01, 0, 0, 0, 0, 0])
    level = prediction.levelled(registered)
    assert (
        np.abs(pose_difference(level, true[-1])[:2]).max()
        < 0.004
        < np.abs(pose_difference(registered, true[-1])[:2]).max()
    )
    np.testing.assert_array_equal(level[:3, 3], registered[:3, 3])
