"""Inertial factors: readings of a known motion, their equations against differences, and smoothing with an IMU."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from steelnb import experiment
from steelnb.core.errors import InputError
from steelnb.core.geometry import moved_poses
from steelnb.core.types import GRAVITY, Imu, Trajectory
from steelnb.fusion import smooth
from steelnb.fusion.adjustment import factors, imu_factors
from steelnb.metrics import score_trajectory
from steelnb.settings import ExperimentSettings, ImuSettings
from steelnb.simulation import measured_imu

SHEET = ImuSettings.preset("starling2-honest")
STEP_S, EVERY = 0.008, 25
MOUNT = np.eye(4)
MOUNT[:3, :3], MOUNT[:3, 3] = Rotation.from_rotvec([0.0, 0.3, 0.1]).as_matrix(), [0.06, 0.0, 0.02]


def swaying(scans, rate=(0.1, -0.2, 0.5)):
    """A drone that sways and turns: trajectory and exact readings at 125 Hz, and its motions at every 25th stamp."""
    stamp_s = STEP_S * np.arange(EVERY * (scans - 1) + 1)
    phase = np.outer(stamp_s, [0.9, 1.3, 0.7])
    T = np.tile(np.eye(4), (len(stamp_s), 1, 1))
    T[:, :3, 3] = np.sin(phase)
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(stamp_s, rate)).as_matrix()
    velocity = np.cos(phase) * [0.9, 1.3, 0.7]
    gained = np.diff(velocity, axis=0, prepend=velocity[:1]) / STEP_S + [0.0, 0.0, GRAVITY]
    force = np.einsum("nji,nj->ni", T[:, :3, :3], gained)
    motion = np.hstack([velocity, np.zeros((len(stamp_s), 6))])[::EVERY]
    return Trajectory(stamp_s, T), Imu(stamp_s, force, np.tile(rate, (len(stamp_s), 1))), motion


def made(scans=5):
    """Inertial factors at the true poses of `swaying`, and those poses of the sensor."""
    trajectory, imu, motion = swaying(scans)
    at = Trajectory(trajectory.stamp_s[::EVERY], trajectory.T_world_drone[::EVERY])
    return replace(imu_factors.Inertial.started(imu, SHEET, MOUNT, at), motion=motion), at.T_world_drone @ MOUNT


@given(st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6))
def test_readings_integrate_to_the_motion_that_they_are_of_whatever_the_biases(bias):
    factors, T = made()
    imu = factors.imu
    biased = Imu(imu.stamp_s, imu.specific_force + bias[3:], imu.angular_rate + bias[:3])
    motion = factors.motion + np.array([0.0, 0.0, 0.0, *bias])
    error = replace(factors, imu=biased, motion=motion).errors(T)
    np.testing.assert_allclose(error[:, :3], 0.0, atol=1e-9)
    np.testing.assert_allclose(error[:, 3:6], 0.0, atol=1e-9)
    np.testing.assert_allclose(error[:, 6:9], 0.0, atol=2e-5)  # the path is no parabola within a step
    np.testing.assert_array_equal(error[:, 9:], 0.0)


def test_an_error_is_in_the_axes_of_the_world():
    factors, T = made(2)
    T[1, :3, 3] += [0.01, 0.02, 0.03]
    np.testing.assert_allclose(factors.errors(T)[0, 6:9], [0.01, 0.02, 0.03], atol=2e-5)
    factors, T = made(2)
    moved = factors.moved(np.hstack([np.zeros((2, 6)), [[0.0] * 9, [0.1, 0.2, 0.3, 0.01, 0, 0, 0, 0, 0.02]]]))
    np.testing.assert_allclose(moved.errors(T)[0, 3:], [0.1, 0.2, 0.3, 0, 0, 0, 0.01, 0, 0, 0, 0, 0.02], atol=2e-5)


def test_the_equations_are_those_of_derivatives_by_differences():
    """The gradient of half the sum of squares, in random directions."""
    factors, T = made()
    rng = np.random.default_rng(3)
    T = moved_poses(T, 0.01 * rng.normal(size=(len(T), 6)))
    factors = replace(factors, motion=factors.motion + 0.01 * rng.normal(size=factors.motion.shape))

    def cost(states):
        moved = factors.moved(states)
        error = moved.errors(moved_poses(T, states[:, :6]))
        between = 0.5 * np.einsum("kd,kde,ke", error, factors.weight, error)
        return between + 0.5 * (moved.information * moved.motion**2).sum()

    found = factors.equations(T)
    for _ in range(20):
        states = rng.normal(size=found.vector.shape)
        slope = (cost(1e-6 * states) - cost(-1e-6 * states)) / 2e-6
        expected = -(found.vector * states).sum()
        assert slope == pytest.approx(expected, rel=1e-3, abs=1e-3 * np.abs(found.vector).max())
    # Gauss–Newton curvature: that of the linearised errors.
    before, after = (factors.errors(moved_poses(T, sign * 1e-6 * states[:, :6])) for sign in (-1, 1))
    slope, flat = (after - before) / 2e-6, np.where(np.arange(15) < 6, states, 0.0)
    curvature = np.einsum("kd,kde,ke", flat, found.matrix, flat)
    curvature += 2 * np.einsum("kd,kde,ke", flat[:-1], found.beside, flat[1:])
    assert curvature == pytest.approx(np.einsum("kd,kde,ke", slope, factors.weight, slope), rel=1e-3)


def test_noise_spreads_as_its_covariance_says():
    """In 2000 intervals of a stationary drone."""
    count = 2000
    n = EVERY * count + 1
    still = Imu(STEP_S * np.arange(n), np.tile([0, 0, GRAVITY], (n, 1)), np.zeros((n, 3)))
    noise = SHEET.replace(gyro_bias=0.0, accelerometer_bias=0.0, gyro_walk=0.0, accelerometer_walk=0.0)
    at = Trajectory(still.stamp_s[::EVERY], np.tile(np.eye(4), (count + 1, 1, 1)))
    factors = imu_factors.Inertial.started(measured_imu(still, noise, 0), noise, np.eye(4), at)
    expected = imu_factors.integration_covariances(noise, np.array([EVERY * STEP_S]))[0]
    scale = np.outer(*[np.sqrt(np.diag(expected))] * 2)
    found = np.cov(factors.errors(at.T_world_drone)[:, :9].T)
    np.testing.assert_allclose(found / scale, expected / scale, atol=5 / np.sqrt(count) + 0.05)


def test_an_interval_with_a_gap_says_nothing():
    factors, T = made(6)
    kept = (factors.imu.stamp_s < 0.45) | (factors.imu.stamp_s > 0.56)
    torn = Imu(factors.imu.stamp_s[kept], factors.imu.specific_force[kept], factors.imu.angular_rate[kept])
    np.testing.assert_array_equal(imu_factors.gaps(torn.stamp_s, factors.stamp_s), [False, False, True, False, False])
    stopped = Imu(*(column[factors.imu.stamp_s < 0.85] for column in vars(factors.imu).values()))
    np.testing.assert_array_equal(imu_factors.gaps(stopped.stamp_s, factors.stamp_s), [False] * 4 + [True])
    at = Trajectory(factors.stamp_s, T @ np.linalg.inv(MOUNT))
    weight = imu_factors.Inertial.started(torn, SHEET, MOUNT, at).weight
    assert not weight[2, :9, :9].any()
    assert np.linalg.eigvalsh(weight[[0, 1, 3, 4], :9, :9]).min() > 0


def test_readings_of_another_clock_are_refused():
    trajectory, imu, _ = swaying(21, rate=(0.02, 0.01, 0.3))
    prior = Trajectory(trajectory.stamp_s[::EVERY], trajectory.T_world_drone[::EVERY])
    imu_factors.check_overlap(imu, prior)
    with pytest.raises(InputError, match="0 of 501 readings within the time of the poses"):
        imu_factors.check_overlap(replace(imu, stamp_s=imu.stamp_s + 1e9), prior)


@pytest.fixture(scope="module")
def flown():
    """A flight of 12 s around the tower, with a realistic IMU, and roll and pitch from a filter on it."""
    settings = ExperimentSettings.preset(
        "loops", "random-walk", seed=12, duration_s=12.0, method="best", overrides={"imu": SHEET.model_dump()}
    )
    flight, truth = experiment.simulate(settings)
    return flight, truth, experiment.estimate(settings, flight, truth)


@pytest.fixture(scope="module")
def without(flown):
    """The flight smoothed without the readings of its IMU."""
    return smooth(flown[0], flown[2])


def test_smoothing_with_an_imu_finds_the_vertical_that_the_prior_has_wrong(flown, without):
    flight, truth, estimate = flown
    found = smooth(flight, estimate, imu=SHEET)
    up = truth.trajectory.at(flight.prior.stamp_s).T_world_drone[:, 2, :3]
    lean, before = (
        np.linalg.norm(each.T_world_drone[:, 2, :3] - up, axis=1).mean() for each in (found.corrected, flight.prior)
    )
    assert lean < 0.4 * before
    errors = [score_trajectory(each.corrected, truth.trajectory)["ate_rmse_m"] for each in (found, without)]
    assert errors[0] < errors[1]
    sigma = np.sqrt(found.pose_covariance[1:, [3, 4], [3, 4]])
    assert sigma.min() > 0
    assert sigma.max() < factors.TILT_SIGMA_RAD


def test_a_flight_without_readings_is_smoothed_without(flown, without):
    flight, _, estimate = flown
    found = smooth(replace(flight, imu=None), estimate, imu=SHEET)
    assert found.unsmoothed == ""
    np.testing.assert_array_equal(found.corrected.T_world_drone, without.corrected.T_world_drone)
