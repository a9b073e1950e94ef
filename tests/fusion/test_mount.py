"""The mount of the sensor and the delay of its stamps in an adjustment: derivatives, recovery and covariances."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.core.geometry import moved_poses, pose_difference
from steelnb.core.types import Flight, Scan, Trajectory
from steelnb.fusion.adjustment import factors, problem, smooth, solver
from steelnb.fusion.adjustment.mount import MOUNT_DOF, WORLD_DOF, Mount
from steelnb.settings import ExperimentSettings, MountSettings
from tests.fusion.made import made_up

STAMP_S = 0.2 * np.arange(40)
SIGMA = np.array([0.05, 0.05, 0.05, 0.03, 0.03, 0.03, 0.0])
STEP = np.array([0.012, -0.02, 0.025, 0.015, -0.01, 0.02, 0.0])


def empty_scans():
    return [Scan(stamp_s, np.zeros((0, 3))) for stamp_s in STAMP_S]


def swinging(stamp_s):
    """Poses of a drone that sways, turns and slides."""
    T = np.tile(np.eye(4), (len(stamp_s), 1, 1))
    swing = np.stack([0.1 * np.sin(2 * stamp_s), 0.08 * np.cos(1.7 * stamp_s), 0.5 * np.sin(0.6 * stamp_s)], axis=1)
    T[:, :3, :3] = Rotation.from_rotvec(swing).as_matrix()
    T[:, :3, 3] = np.stack([0.3 * np.sin(stamp_s), 0.2 * stamp_s - 1, 0.2 * np.cos(1.3 * stamp_s)], axis=1)
    return T


def mounted(sigma, path_s=0.01):
    """A mount that is moved off the stated one, on a swinging drone, whose path is known at its own rate."""
    stated = np.eye(4)
    stated[:3, :3], stated[:3, 3] = Rotation.from_rotvec([0.2, -0.3, 0.4]).as_matrix(), [0.1, 0.02, -0.05]
    path_s = np.arange(-0.5, STAMP_S[-1] + 0.5, path_s)
    prior = Trajectory(STAMP_S, swinging(STAMP_S))
    flight = Flight(empty_scans(), prior, stated, path=Trajectory(path_s, swinging(path_s)))
    return Mount.started(flight, np.asarray(sigma))


def test_sensor_and_drone_are_converted_to_each_other():
    mount = replace(mounted(np.full(7, 0.02)), late_s=0.13)
    T_world_drone = swinging(STAMP_S)
    T_world_sensor = T_world_drone @ mount.at_scans()
    np.testing.assert_allclose(T_world_sensor, swinging(STAMP_S - 0.13) @ mount.T_drone_sensor, atol=1e-4)
    np.testing.assert_allclose(mount.drones(T_world_sensor), T_world_drone, atol=1e-12)


def test_the_derivatives_are_those_of_small_steps():
    mount, small = replace(mounted(np.full(7, 0.02)), late_s=0.05), 1e-5
    T_world_drone = swinging(STAMP_S)
    T_world_sensor = T_world_drone @ mount.at_scans()
    by_drone, by_mount = mount._jacobians(T_world_sensor)
    for axis in range(6):
        moved = moved_poses(T_world_drone, np.tile(small * np.eye(6)[axis], (40, 1))) @ mount.at_scans()
        found = [pose_difference(a, b) / small for a, b in zip(T_world_sensor, moved, strict=True)]
        np.testing.assert_allclose(by_drone[:, :, axis], found, atol=1e-4)
    for part in range(MOUNT_DOF):
        step_size = 0.02 if part == 6 else small  # the path is known at steps of 10 ms
        both = [T_world_drone @ mount.moved(s * step_size * np.eye(7)[part]).at_scans() for s in (-1, 1)]
        found = [pose_difference(a, b) / (2 * step_size) for a, b in zip(*both, strict=True)]
        np.testing.assert_allclose(by_mount[:, :, part], found, atol=2e-3)


def solved(sigma, T, bars, observed, prior, steps=10):
    flight = Flight(empty_scans(), Trajectory(STAMP_S, prior), np.eye(4))
    state = problem.start(T, prior, bars, mount=Mount.started(flight, sigma))  # roll and pitch are the prior's
    for _ in range(steps):
        equations = factors.linearised(state, observed)
        state = solver.improve(state, equations, prior, STAMP_S)
    return state, equations


def swung(seed, noise_m):
    """`made_up`, seen from a sensor that is mounted wrongly: the drone's poses, which the prior knows, and the bars
    where the first scan sees them by the stated mount."""
    T, bars, observed = made_up(seed, noise_m)
    true = np.eye(4)
    true[:3, :3], true[:3, 3] = Rotation.from_rotvec(STEP[:3]).as_matrix(), STEP[3:6]
    drone = T @ np.linalg.inv(true)
    as_stated = drone[0] @ np.linalg.inv(T[0])
    segments, across = bars.segments.transformed(as_stated), bars.across @ as_stated[:3, :3].T
    return drone, replace(bars, segments=segments, across=across), observed


def test_a_mount_is_found_from_the_motion_of_the_prior():
    drone, bars, observed = swung(1, 0.002)
    state, equations = solved(SIGMA, drone, bars, observed, drone)
    covariance = smooth.marginals(state, equations, drone, STAMP_S)[2]
    error, sigma = state.mount.error[:6] - STEP[:6], np.sqrt(np.diag(covariance))
    assert (np.abs(error) < 3 * sigma + 1e-3).all()
    assert np.linalg.norm(error[:2]) < 0.05 * np.linalg.norm(STEP[:2])  # the drone turns: tilts are known
    np.testing.assert_allclose(state.poses[0], drone[0], atol=1e-9)
    known = problem.start(drone, drone, bars)
    for _ in range(10):
        known = solver.improve(known, factors.linearised(known, observed), drone, STAMP_S)
    paths = state.poses, known.T_world_sensor
    with_mount, without = (np.linalg.norm((each - drone)[:, :3, 3], axis=1).mean() for each in paths)
    assert with_mount < without


def test_what_a_mount_costs_is_how_far_the_poses_move_with_it():
    T, bars, observed = made_up(1, 0.002)
    stated = np.eye(4)

    def poses(T_drone_sensor):
        sensor = T @ T_drone_sensor  # the prior knows the drone's poses, and takes the sensor to be there
        state = problem.start(sensor, sensor, bars)
        for _ in range(15):
            equations = factors.linearised(state, observed)
            state = solver.improve(state, equations, sensor, STAMP_S)
        return state, equations, state.T_world_sensor @ np.linalg.inv(T_drone_sensor)

    state, equations, found = poses(stated)
    cost = smooth.mount_cost(state, equations, Flight(empty_scans(), Trajectory(STAMP_S, T), stated), stated)
    for part in range(6):
        off, step = stated.copy(), np.zeros(6)
        step[part] = 0.002
        off[:3, :3], off[:3, 3] = Rotation.from_rotvec(step[:3]).as_matrix(), step[3:]
        moved = np.linalg.norm((poses(off)[2] - found)[:, :3, 3], axis=1)
        assert np.sqrt((moved**2).mean()) / 0.002 == pytest.approx(cost[part], rel=0.15, abs=0.02)


def test_a_mount_that_is_practically_known_changes_nothing():
    T, bars, observed = made_up(1, 0.002)
    state, equations = solved(SIGMA * 1e-7, T, bars, observed, T, steps=4)
    known = problem.start(T, T, bars)
    for _ in range(4):
        same = factors.linearised(known, observed)
        known = solver.improve(known, same, T, STAMP_S)
    np.testing.assert_allclose(state.T_world_sensor, known.T_world_sensor, atol=2e-5)
    found, expected = (smooth.marginals(s, e, T, STAMP_S)[0] for s, e in ((state, equations), (known, same)))
    np.testing.assert_allclose(found[1:], expected[1:], rtol=0.05, atol=1e-9)


def test_all_bars_together_are_not_held_by_their_own_priors():
    """With a single heading, nothing but the prior tells how the map leans: its sigma is that of the mount."""
    T, bars, observed = made_up(1, 0.002)
    state, equations = solved(SIGMA, T, bars, observed, T, steps=3)
    assert np.isfinite(smooth.marginals(state, equations, T, STAMP_S)[1]).all()
    shared = state.mount.of_drone(equations, state.T_world_sensor, 4).shared
    assert shared.matrix.shape == (6 + WORLD_DOF, 6 + WORLD_DOF)


def test_the_level_of_the_drift_is_measured():
    rng, stamp_s = np.random.default_rng(5), 0.2 * np.arange(3000)
    T = np.tile(np.eye(4), (len(stamp_s), 1, 1))
    for level in (0.3, 1.5):
        prior = T.copy()
        prior[1:, :3, 3] += np.cumsum(level * 0.01 * rng.standard_normal((len(T) - 1, 3)), axis=0)
        found = factors.drift_ratio(T, prior, stamp_s)
        assert found[1:] == pytest.approx(level, rel=0.15)
        assert found[0] == factors.DRIFT_RATIO_MIN
    np.testing.assert_array_equal(factors.drift_ratio(T[:50], prior[:50], stamp_s[:50]), 1.0)


def test_poses_at_late_stamps_have_the_correction_of_their_neighbours():
    mount = replace(mounted(np.full(7, 0.02)), late_s=0.1)
    offset = np.array([0.1, -0.2, 0.05])
    measured = swinging(STAMP_S - 0.1)
    measured[:, :3, 3] += offset
    poses, unmeasured_s = mount.at_stamps(measured @ mount.T_drone_sensor)
    np.testing.assert_allclose(poses[1:, :3, 3], swinging(STAMP_S)[1:, :3, 3] + offset, atol=1e-4)
    assert unmeasured_s[1:-1] == pytest.approx(0.05)
    assert unmeasured_s[-1] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"rotation_sigma_deg": -1.0}, "greater than or equal to 0"),
        ({"rotation_sigma_deg": 11.0}, "state the mount instead"),
        ({"time_sigma_s": 2.0}, "state the offset of the clock instead"),
    ],
)
def test_sigmas_that_are_no_errors_are_refused(changes, says):
    with pytest.raises(InputError, match=says):
        MountSettings(**changes)


def test_only_smoothing_estimates_a_mount():
    with pytest.raises(InputError, match="only smoothing estimates it"):
        ExperimentSettings.preset(method="best", overrides={"mount.rotation_sigma_deg": 1.0})
    settings = ExperimentSettings.preset(method="smoothed", overrides={"mount.rotation_sigma_deg": 1.0})
    assert settings.odometry.mount.sigma[:3] == pytest.approx(np.radians(1.0))
