import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.odometry.loam import FeatureTarget
from steelnb.registration import FREE, AlignOptions, align
from tests.naive import full

NONE = np.zeros((0, 3))
LINES = [(np.zeros(3), [1, 0, 0]), (np.array([0, 1.0, 0]), [0, 1, 0.2]), (np.array([1.0, 0, 1]), [0, 0.1, 1])]


def points_on(lines, spacing_m=0.05, length_m=2.0):
    steps = np.arange(0, length_m, spacing_m)[:, None]
    return np.concatenate(
        [start + steps * np.asarray(direction) / np.linalg.norm(direction) for start, direction in lines]
    )


def squared_residuals(target, source, match):
    """eᵀ C⁻¹ e of each pair, and whether there is one."""
    paired = match >= 0
    e = source[paired] - target.point[paired]
    return np.einsum("ni,nij,nj->n", e, np.linalg.inv(full(target.covariance[paired])), e), paired


@pytest.mark.parametrize(("start", "direction"), LINES)
def test_the_residual_of_a_line_is_the_distance_to_it_in_standard_deviations(start, direction):
    source = points_on([(start, direction)])[8:-8] + np.random.default_rng(1).normal(0, 0.02, (24, 3))
    target = FeatureTarget.of(points_on([(start, direction)]), NONE, np.zeros(24, dtype=np.int64), sigma_m=0.02)
    squared, paired = squared_residuals(target, source, target.search(source, 0.5)(np.eye(4)))
    assert paired.all()
    across_m = np.linalg.norm(np.cross(source - start, direction / np.linalg.norm(direction)), axis=1)
    np.testing.assert_allclose(squared, (across_m / 0.02) ** 2, atol=1e-3)


def test_the_residual_of_a_plane_is_the_distance_along_its_normal():
    rng, R = np.random.default_rng(2), Rotation.from_euler("x", 30, True).as_matrix()
    wall = np.column_stack([rng.uniform(-1, 1, (800, 2)), np.zeros(800)]) @ R.T
    source = 0.3 * wall[:40] + rng.normal(0, 0.02, (40, 3))
    target = FeatureTarget.of(NONE, wall, np.ones(40, dtype=np.int64), sigma_m=0.01)
    squared, paired = squared_residuals(target, source, target.search(source, 0.5)(np.eye(4)))
    assert paired.mean() > 0.7  # five collinear points give no plane
    np.testing.assert_allclose(squared, (source[paired] @ R[:, 2] / 0.01) ** 2, atol=0.05, rtol=1e-2)


@pytest.mark.parametrize("dof", ["xyz", "xyz_yaw", "se3"])
def test_lines_of_different_directions_determine_the_pose(dof):
    T = np.eye(4)
    T[:3, 3] = [0.04, -0.05, 0.03]
    if dof != "xyz":
        T[:3, :3] = Rotation.from_euler("zyx", [2, 1, -1] if dof == "se3" else [2, 0, 0], True).as_matrix()
    source = (points_on(LINES)[::2] - T[:3, 3]) @ T[:3, :3]
    target = FeatureTarget.of(points_on(LINES), NONE, np.zeros(len(source), dtype=np.int64), 0.02)
    zero = np.zeros((len(source), 6))
    found = align(source, target, np.eye(4), AlignOptions("gicp", FREE[dof], 0.3, robust_scale=5.0), zero)
    assert found.converged
    np.testing.assert_allclose(found.T_target_source, T, atol=2e-3)


def test_few_neighbours_and_round_clusters_give_no_line():
    rng = np.random.default_rng(3)
    plane = np.zeros(1, dtype=np.int64)
    for edges in (points_on([LINES[0]])[:4], rng.normal(0, 0.05, (200, 3)), np.zeros((0, 3))):
        target = FeatureTarget.of(edges, NONE, plane, 0.02)
        assert target.search(np.zeros((1, 3)), 0.5 if len(edges) < 5 else 0.02)(np.eye(4))[0] == -1
