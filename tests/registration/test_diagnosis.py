"""A result says how well the clouds fit at its pose, and what their surfaces leave open."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from steelnb.core.geometry import transform_points
from steelnb.registration import register
from tests.registration.scenes import corner, motion, transformed


@pytest.mark.parametrize("iterations_max", [1, 50])
@pytest.mark.parametrize("method", ["icp", "plane", "gicp"])
def test_rmse_and_overlap_are_those_of_the_pairs_at_the_returned_pose(method, iterations_max):
    source, limit_m = corner(900, 4), 0.08
    target = transformed(corner(900, 5)[:600], motion(1, 0.05))
    result = register(source, target, method, max_correspondence_m=limit_m, iterations_max=iterations_max)
    distance = cKDTree(target).query(transform_points(result.T_target_source, source))[0]
    paired = distance <= limit_m
    assert 0.1 < result.overlap < 0.95
    assert result.overlap == pytest.approx(paired.mean())
    assert result.rmse_m == pytest.approx(np.sqrt((distance[paired] ** 2).mean()))
    assert result.inliers == paired.sum()


@pytest.mark.parametrize(("method", "walls"), [("icp", 1), ("plane", 2), ("gicp", 1), ("gicp", 3)])
def test_directions_along_bare_walls_are_reported(method, walls):
    rng = np.random.default_rng(walls)

    def cloud():
        points = rng.uniform(-1, 1, (900, 3))
        points[np.arange(900), np.arange(900) % walls] = 0.003 * rng.normal(size=900)
        return points @ axes.T

    axes = motion(3, 0.5)[:3, :3]
    found = register(cloud(), cloud(), method, max_correspondence_m=0.3).unobserved
    assert found.shape == (3 - walls, 3)
    np.testing.assert_allclose(found @ axes[:, :walls], 0, atol=0.1)


@pytest.mark.parametrize("method", ["icp", "gicp"])
def test_clouds_without_overlap_do_not_converge_and_nothing_is_observed(method):
    points = corner(500, 5)
    result = register(points, points + 100.0, method, max_correspondence_m=0.5)
    assert (result.converged, result.reason, result.inliers) == (False, "too few pairs", 0)
    np.testing.assert_array_equal(result.T_target_source, np.eye(4))
    assert np.isnan(result.rmse_m)
    assert result.overlap == 0
    assert len(result.unobserved) == 3
