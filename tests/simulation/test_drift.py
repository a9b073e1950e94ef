import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from steelnb.core.types import Trajectory
from steelnb.settings import Noise
from steelnb.simulation.drift import drift_size, drift_size_rms, drifting


def still(seconds):
    stamp = np.arange(round(seconds * 125) + 1) / 125
    T = np.tile(np.eye(4), (len(stamp), 1, 1))
    T[:, :3, 3] = [1.0, 2.0, 3.0]
    return Trajectory(stamp, T)


def errors(noise, seconds, seeds):
    truth = still(seconds)
    return np.array([drifting(truth, Noise.parse(noise), s).position[-1] - [1, 2, 3] for s in range(seeds)])


@pytest.mark.parametrize("noise", ["random-walk", "constant-drift", "yaw-random-walk", "random-walk+yaw-random-walk"])
def test_the_size_of_the_drift_is_that_of_the_drifting_poses_and_follows_the_model(noise):
    truth, settings = still(10), Noise.parse(noise)
    T = drifting(truth, settings, 3).T_world_drone
    moved_m = np.linalg.norm(T[:, :3, 3] - truth.position, axis=1)
    turned_rad = np.abs(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    found = drift_size(truth.stamp_s, settings, 3)
    np.testing.assert_allclose(found, turned_rad if noise == "yaw-random-walk" else moved_m, atol=1e-12)
    sizes = np.array([drift_size(truth.stamp_s, settings, seed)[-1] for seed in range(300)])
    assert np.sqrt((sizes**2).mean()) == pytest.approx(drift_size_rms(truth.stamp_s, settings)[-1], rel=0.1)


def test_algorithm_1_is_a_cumulative_sum_of_normal_vectors():
    settings = Noise(random_walk_m=0.002)
    steps = np.diff(drifting(still(40), settings, 5).position, axis=0)
    assert steps.std() == pytest.approx(0.002, rel=0.02)
    assert np.abs(steps.mean(axis=0)).max() < 4 * 0.002 / np.sqrt(40 * 125)
    lag = np.corrcoef(steps[1:, 0], steps[:-1, 0])[0, 1]
    assert abs(lag) < 0.05


def test_constant_drift_has_its_length_in_a_random_direction():
    length = np.linalg.norm(errors("constant-drift", 8, 3), axis=1)
    np.testing.assert_allclose(length, 0.0001 * 1000)
    directions = errors("constant-drift", 8, 500) / length[0]
    assert np.abs(directions.mean(axis=0)).max() < 0.15
    np.testing.assert_allclose(np.cov(directions.T), np.eye(3) / 3, atol=0.06)


def test_yaw_walk_rotates_the_heading_and_not_the_position():
    truth = still(10)
    drifted = drifting(truth, Noise(yaw_random_walk_rad=0.0005), 2)
    np.testing.assert_array_equal(drifted.position, truth.position)
    R = drifted.T_world_drone[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(R[:, 2, 2], 1)


def test_tilt_affects_only_roll_and_pitch_and_has_zero_mean():
    truth = still(100)
    settings = Noise.parse("tilt")
    assert settings.tilt_rad == np.radians(1)
    turned = [drifting(truth, settings, seed) for seed in range(40)]
    np.testing.assert_array_equal(turned[0].position, truth.position)
    np.testing.assert_array_equal(turned[0].T_world_drone[0], truth.T_world_drone[0])
    vectors = Rotation.from_matrix(np.concatenate([each.T_world_drone[5000:, :3, :3] for each in turned])).as_rotvec()
    np.testing.assert_allclose(vectors[:, 2], 0, atol=1e-12)
    np.testing.assert_allclose(vectors[:, :2].std(axis=0), np.radians(1), rtol=0.25)
    later = np.array([[each.T_world_drone[k, 2, 1] for k in (5000, 5000 + 30 * 125)] for each in turned])
    assert 0.1 < np.corrcoef(later.T)[0, 1] < 0.7  # a correlation of 1/e after 30 s


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 10))
def test_drift_depends_on_the_seed_and_is_proportional_to_its_level(seed, level):
    truth = still(2)
    names = ("random_walk_m", "constant_drift_m", "yaw_random_walk_rad")
    moved = drifting(truth, Noise(1e-4, 2e-4), seed).position
    parts = [drifting(truth, Noise(*levels), seed).position - truth.position for levels in ((1e-4,), (0.0, 2e-4))]
    np.testing.assert_allclose(moved - truth.position, sum(parts), atol=1e-12)  # a sum contains its parts
    for name in names:
        one, same, more, none = (drifting(truth, Noise(**{name: 1e-4 * size}), seed) for size in (1.0, 1.0, level, 0.0))
        np.testing.assert_array_equal(one.T_world_drone, same.T_world_drone)
        np.testing.assert_array_equal(none.T_world_drone, truth.T_world_drone)
        np.testing.assert_allclose(more.position - truth.position, level * (one.position - truth.position), atol=1e-12)
        yaw, larger = (np.arctan2(each.T_world_drone[:, 1, 0], each.T_world_drone[:, 0, 0]) for each in (one, more))
        np.testing.assert_allclose(larger, level * yaw, atol=1e-12)
        np.testing.assert_array_equal(one.T_world_drone[0], truth.T_world_drone[0])
        assert np.abs(one.T_world_drone - truth.T_world_drone).max() > 1e-5
