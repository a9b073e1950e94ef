import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.registration import FREE, FeatureTarget, align
from tests.naive import full

NONE = np.zeros((0, 3))
LINES = [(np.zeros(3), [1, 0, 0]), (np.array([0, 1.0, 0]), [0, 1, 0.2]), (np.array([1.0, 0, 1]), [0, 0.1, 1])]


def points_on(lines, spacing_m=0.05, length_m=2.0):
    steps = np.arange(0, length_m, spacing_m)[:, None]
    return np.concatenate(
        [start + steps * np.asarray(direction) / np.linalg.norm(direction) for start, direction in lines]
    )


def test_the_residual_of_a_line_is_the_distance_to_it_in_standard_deviations():
    rng = np.random.default_rng(1)
    for start, direction in LINES:
        source = points_on([(start, direction)])[8:-8] + rng.normal(0, 0.02, (24, 3))
        plane = np.zeros(len(source), dtype=np.int64)
        target = FeatureTarget.of(points_on([(start, direction)]), NONE, plane, sigma_m=0.02)
        match = target.search(source, 0.5)(np.eye(4))
        np.testing.assert_array_equal(match, np.arange(len(source)))
        unit = np.asarray(direction) / np.linalg.norm(direction)
        for point, middle, upper in zip(source, target.point, target.covariance, strict=True):
            offset = point - start
            across_m = np.linalg.norm(offset - (offset @ unit) * unit)
            squared = (point - middle) @ np.linalg.inv(full([upper])[0]) @ (point - middle)
            assert squared == pytest.approx((across_m / 0.02) ** 2, abs=1e-3)


def test_the_residual_of_a_plane_is_the_distance_along_its_normal():
    rng = np.random.default_rng(2)
    wall = (
        np.column_stack([rng.uniform(-1, 1, (800, 2)), np.zeros(800)])
        @ Rotation.from_euler("x", 30, True).as_matrix().T
    )
    normal = Rotation.from_euler("x", 30, True).as_matrix()[:, 2]
    source = 0.3 * wall[:40] + rng.normal(0, 0.02, (40, 3))
    target = FeatureTarget.of(NONE, wall, np.ones(40, dtype=np.int64), sigma_m=0.01)
    paired = target.search(source, 0.5)(np.eye(4)) >= 0
    assert paired.mean() > 0.7  # five collinear points give no plane
    for point, middle, upper in zip(source[paired], target.point[paired], target.covariance[paired], strict=True):
        squared = (point - middle) @ np.linalg.inv(full([upper])[0]) @ (point - middle)
        assert squared == pytest.approx(((point @ normal) / 0.01) ** 2, abs=0.05, rel=1e-2)


@pytest.mark.parametrize("dof", ["xyz", "xyz_yaw", "se3"])
def test_lines_of_different_directions_determine_the_pose(dof):
    T = np.eye(4)
    T[:3, 3] = [0.04, -0.05, 0.03]
    if dof != "xyz":
        T[:3, :3] = Rotation.from_euler(
            "zyx" if dof == "se3" else "z", [2, 1, -1] if dof == "se3" else 2, True
        ).as_matrix()
    target_points = points_on(LINES)
    source = (points_on(LINES)[::2] - T[:3, 3]) @ T[:3, :3]
    target = FeatureTarget.of(target_points, NONE, np.zeros(len(source), dtype=np.int64), 0.02)
    zero = np.zeros((len(source), 6))
    found = align(source, target, "gicp", FREE[dof], np.eye(4), 0.3, zero, 5.0)
    assert found.converged
    np.testing.assert_allclose(found.T_target_source, T, atol=2e-3)


def test_few_neighbours_and_round_clusters_give_no_line():
    rng = np.random.default_rng(3)
    plane = np.zeros(1, dtype=np.int64)
    for edges in (points_on([LINES[0]])[:4], rng.normal(0, 0.05, (200, 3)), np.zeros((0, 3))):
        target = FeatureTarget.of(edges, NONE, plane, 0.02)
        assert target.search(np.zeros((1, 3)), 0.5 if len(edges) < 5 else 0.02)(np.eye(4))[0] == -1
