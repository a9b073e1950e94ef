import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.registration import FeatureTarget, align, free_directions
from tests.naive import full

NONE = np.zeros((0, 3))
LINES = [(np.zeros(3), [1, 0, 0]), (np.array([0, 1.0, 0]), [0, 1, 0.2]), (np.array([1.0, 0, 1]), [0, 0.1, 1])]


def along(lines, spacing_m=0.05, length_m=2.0):
    steps = np.arange(0, length_m, spacing_m)[:, None]
    return np.concatenate([start + steps * np.asarray(way) / np.linalg.norm(way) for start, way in lines])


def test_the_squared_residual_is_the_distance_from_the_line_by_its_standard_deviation():
    noise = np.random.default_rng(1)
    for start, way in LINES:
        source = along([(start, way)])[8:-8] + noise.normal(0, 0.02, (24, 3))
        plane = np.zeros(len(source), dtype=np.int64)
        target = FeatureTarget.of(along([(start, way)]), NONE, plane, sigma_m=0.02)
        pairs = target.pairs(source, 0.5)
        pairs.update(np.eye(4))
        np.testing.assert_array_equal(pairs.match, np.arange(len(source)))
        unit = np.asarray(way) / np.linalg.norm(way)
        for point, middle, upper in zip(source, target.point, target.covariance, strict=True):
            apart = point - start
            across_m = np.linalg.norm(apart - (apart @ unit) * unit)
            squared = (point - middle) @ np.linalg.inv(full([upper])[0]) @ (point - middle)
            assert squared == pytest.approx((across_m / 0.02) ** 2, abs=1e-3)


def test_the_squared_residual_of_a_plane_is_the_distance_along_its_normal():
    noise = np.random.default_rng(2)
    wall = (
        np.column_stack([noise.uniform(-1, 1, (800, 2)), np.zeros(800)])
        @ Rotation.from_euler("x", 30, True).as_matrix().T
    )
    normal = Rotation.from_euler("x", 30, True).as_matrix()[:, 2]
    source = 0.3 * wall[:40] + noise.normal(0, 0.02, (40, 3))
    target = FeatureTarget.of(NONE, wall, np.ones(40, dtype=np.int64), sigma_m=0.01)
    pairs = target.pairs(source, 0.5)
    pairs.update(np.eye(4))
    paired = pairs.match >= 0
    assert paired.mean() > 0.7  # five points that lie in a row make no plane
    for point, middle, upper in zip(source[paired], target.point[paired], target.covariance[paired], strict=True):
        squared = (point - middle) @ np.linalg.inv(full([upper])[0]) @ (point - middle)
        assert squared == pytest.approx(((point @ normal) / 0.01) ** 2, abs=0.05, rel=1e-2)


@pytest.mark.parametrize("dof", ["xyz", "xyz_yaw", "se3"])
def test_a_motion_is_found_by_lines_that_run_in_different_directions(dof):
    T = np.eye(4)
    T[:3, 3] = [0.04, -0.05, 0.03]
    if dof != "xyz":
        T[:3, :3] = Rotation.from_euler(
            "zyx" if dof == "se3" else "z", [2, 1, -1] if dof == "se3" else 2, True
        ).as_matrix()
    target_points = along(LINES)
    source = (along(LINES)[::2] - T[:3, 3]) @ T[:3, :3]
    target = FeatureTarget.of(target_points, NONE, np.zeros(len(source), dtype=np.int64), 0.02)
    zero = np.zeros((len(source), 6))
    found = align(source, target, "gicp", free_directions(dof), np.eye(4), 0.3, zero, 5.0)
    assert found.converged
    np.testing.assert_allclose(found.T_target_source, T, atol=2e-3)


def test_too_few_neighbours_and_bunches_of_points_are_no_lines():
    noise = np.random.default_rng(3)
    plane = np.zeros(1, dtype=np.int64)
    for edges in (along([LINES[0]])[:4], noise.normal(0, 0.05, (200, 3)), np.zeros((0, 3))):
        target = FeatureTarget.of(edges, NONE, plane, 0.02)
        pairs = target.pairs(np.array([[0.0, 0.0, 0.0]]), 0.5 if len(edges) < 5 else 0.02)
        pairs.update(np.eye(4))
        assert pairs.match[0] == -1
