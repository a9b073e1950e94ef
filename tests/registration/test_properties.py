"""Properties of `register` on random scenes, for all errors, degrees of freedom and kinds of target."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from steelnb.points import VoxelMap
from steelnb.registration import register
from tests.registration.scenes import corner, motion, pose_error, transformed

METHODS = ("icp", "plane", "gicp")
REASONS = {"converged", "iterations exhausted", "too few pairs", "singular"}
SEEDS = st.integers(0, 10_000)


def as_target(points, kind):
    if kind == "cloud":
        return points
    voxels = VoxelMap(0.1)
    voxels.insert(points)
    return voxels


def rigid(seed, shift_m):
    """Random rigid motion with a translation of the given length."""
    T = motion(0, shift_m, seed=seed)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    return T


@pytest.mark.parametrize("dof", ["xyz", "xyz_yaw", "se3"])
@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=4, deadline=None)
@given(kind=st.sampled_from(["cloud", "map"]), seed=SEEDS)
def test_the_pose_its_inverse_and_the_pose_from_a_perturbed_start_are_found(method, dof, kind, seed):
    here, T_true = corner(3000, seed), motion(3, 0.08, dof, seed)
    there = transformed(here, T_true)
    # Identical points are matched to the tolerance of the solver; voxel means differ from the source points.
    shift_m, turn_deg = (1e-3, 0.02) if kind != "map" else (0.012, 0.2)
    options = {"method": method, "dof": dof, "max_correspondence_m": 0.5}
    start = motion(4, 0.1, dof, seed + 1) @ T_true
    runs = [
        (register(here, as_target(there, kind), **options), T_true),
        (register(there, as_target(here, kind), **options), np.linalg.inv(T_true)),
        (register(here, as_target(there, kind), T_init=start, **options), T_true),
    ]
    for result, T in runs:
        assert result.converged, result.reason
        assert np.less(pose_error(result.T_target_source, T), (shift_m, turn_deg)).all()
    # The perturbation is well above the tolerance.
    assert pose_error(start, T_true)[0] > 4 * shift_m or pose_error(start, T_true)[1] > 4 * turn_deg


@pytest.mark.parametrize("method", ["icp", "plane", "gicp"])
@settings(max_examples=8, deadline=None)
@given(seed=SEEDS, shift_m=st.sampled_from([0.0, 3.0, 100.0, 1e4]), robust=st.booleans())
def test_rigid_motions_of_both_clouds_transform_the_result(method, seed, shift_m, robust):
    here, there = corner(800, seed), corner(900, seed + 1, 0.005)
    T_init, A, B = motion(2, 0.05, seed=seed), rigid(seed + 2, shift_m), rigid(seed + 3, shift_m)
    scale = {"icp": 0.05, "plane": 0.03, "gicp": 2.0}[method]
    options = {"max_correspondence_m": 0.5, "robust_scale": scale if robust else np.inf}
    plain = register(here, there, method, T_init=T_init, **options)
    T_moved = B @ T_init @ np.linalg.inv(A)
    both = register(transformed(here, A), transformed(there, B), method, T_init=T_moved, **options)
    np.testing.assert_allclose(np.linalg.inv(B) @ both.T_target_source @ A, plain.T_target_source, atol=1e-6)
    assert (both.iterations, both.inliers) == (plain.iterations, plain.inliers)


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=6, deadline=None)
@given(seed=SEEDS)
def test_the_pose_does_not_depend_on_the_order_of_points_or_on_far_target_points(method, seed):
    rng = np.random.default_rng(seed)
    here, there = corner(800, seed), corner(900, seed + 1, 0.005)
    far = there.mean(axis=0) + 50 * np.sign(rng.normal(size=(100, 3))) + rng.normal(size=(100, 3))
    shuffled = rng.permutation(np.vstack([there, far]))
    options = {"T_init": motion(2, 0.05, seed=seed), "max_correspondence_m": 0.5}
    plain = register(here, there, method, **options)
    other = register(rng.permutation(here), shuffled, method, **options)
    np.testing.assert_allclose(other.T_target_source, plain.T_target_source, atol=1e-8)
    assert other.inliers == plain.inliers


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=6, deadline=None)
@given(seed=SEEDS, dof=st.sampled_from(["xyz", "xyz_yaw"]))
def test_a_restricted_solve_keeps_the_other_directions_of_the_start(method, seed, dof):
    points, tilt = corner(1500, seed), motion(2, 0.03, "se3", seed)
    result = register(points, points, method, dof, T_init=tilt, max_correspondence_m=0.5)
    change = result.T_target_source[:3, :3] @ tilt[:3, :3].T
    np.testing.assert_allclose(change[:, 2], [0, 0, 1], atol=1e-12)
    if dof == "xyz":
        np.testing.assert_allclose(change, np.eye(3), atol=1e-12)
    else:
        about = abs(Rotation.from_matrix(tilt[:3, :3]).as_rotvec()[2])
        assert about < 5e-3 or np.abs(change - np.eye(3)).max() > 1e-4  # the free angle was used


@settings(max_examples=6, deadline=None)
@given(seed=SEEDS, share=st.floats(0.15, 0.3))
def test_robust_weights_reject_outliers(seed, share):
    here = corner(3000, seed)
    stray = here[: int(share * 3000)] + np.array([0.25, 0.1, 0.2])  # a shifted copy of part of the scan
    source = np.random.default_rng(seed).permutation(np.concatenate([here, stray]))
    plain_m, robust_m = (
        pose_error(register(source, here, "icp", robust_scale=scale).T_target_source, np.eye(4))[0]
        for scale in (np.inf, 0.03)
    )
    assert plain_m > 0.008
    assert robust_m < 2e-3


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("shape", ["plane", "line", "two places", "one place"])
@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=5, deadline=None)
@given(seed=SEEDS, dof=st.sampled_from(["xyz", "xyz_yaw", "se3"]))
def test_degenerate_clouds_give_a_rigid_pose_and_a_reason(method, shape, seed, dof):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2, 2, (60, 3)) * {"plane": [1, 1, 0], "line": [1, 0, 0]}.get(shape, [1, 1, 1])
    if shape.endswith("place") or shape.endswith("places"):
        points = points[rng.integers(0, 1 if shape == "one place" else 2, 60)]
    T_init = motion(1, 0.05, dof, seed)
    result = register(points, points, method, dof, T_init=T_init, max_correspondence_m=0.5)
    T = result.T_target_source
    assert result.reason in REASONS
    assert result.converged == (result.reason == "converged")
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(T[:3, :3]) > 0.9
    # The solver does not move in unconstrained directions: on a plane, only the height changes.
    if shape == "plane" and method == "plane":
        drift = transformed(points, T) - transformed(points, T_init)
        assert np.abs(drift[:, :2]).max() < 0.05 * np.abs(drift[:, 2]).max() + 1e-6
