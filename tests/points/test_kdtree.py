import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.points import kdtree
from tests import naive

pytestmark = pytest.mark.kernels


@st.composite
def clouds(draw):
    """Uniform points, points on a line, in clusters, on a grid (many ties), or all identical."""
    n, rng = draw(st.integers(1, 120)), np.random.default_rng(draw(st.integers(0, 10_000)))
    kind = draw(st.sampled_from(["even", "line", "clusters", "grid", "same"]))
    points = rng.uniform(-1, 1, (n, 3))
    if kind == "line":
        points = points[:, :1] * [1.0, 2, -1]
    elif kind == "clusters":
        points = 1e-3 * points + 50 * np.eye(4, 3)[rng.integers(0, 4, n)]
    elif kind == "grid":
        points = np.round(3 * points)
    elif kind == "same":
        points = np.ones((n, 3))
    return points


def search(points, query, k, limit):
    """(tree, indices, distances) of the nearest points within a limit."""
    tree, found, distance = kdtree.build_kdtree(points), np.full(k, -7), np.full(k, -7.0)
    count = kdtree.nearest_k(tree, *query, k, limit**2, found, distance, np.empty(64, np.int64), np.empty((64, 4)))
    return tree, found[:count], np.sqrt(distance[:count])


@settings(max_examples=60, deadline=None)
@given(points=clouds())
def test_the_tree_holds_every_point_once(points):
    tree = kdtree.build_kdtree(points)
    np.testing.assert_array_equal(np.sort(tree.order), np.arange(len(points)))
    np.testing.assert_array_equal(tree.point, points[tree.order])
    size = (tree.right - tree.left)[tree.axis < 0]
    assert size.sum() == len(points)
    assert size.max() <= kdtree.LEAF


@settings(max_examples=120, deadline=None)
@given(
    points=clouds(), seed=st.integers(0, 99), k=st.sampled_from([1, 3, 20]), limit=st.sampled_from([np.inf, 1.0, 0.02])
)
def test_nearest_k_equals_brute_force(points, seed, k, limit):
    rng = np.random.default_rng(seed)
    for query in (rng.uniform(-2, 2, 3), points[rng.integers(len(points))], np.array([1e6, 0, 0]), np.zeros(3)):
        tree, found, distance = search(points, query, k, limit)
        _, expected = naive.nearest_k(points, query, k)
        np.testing.assert_allclose(distance, expected[expected < limit], atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(tree.point[found] - query, axis=1), distance, atol=1e-9)
        assert len(set(found)) == len(found)


@settings(max_examples=80, deadline=None)
@given(points=clouds(), seed=st.integers(0, 99), radius=st.sampled_from([0.0, 0.6, 3.0, 1e7]))
def test_within_finds_all_points_in_a_ball(points, seed, radius):
    tree, found = kdtree.build_kdtree(points), np.empty((3, len(points) + 1))
    for query in (np.random.default_rng(seed).uniform(-2, 2, 3), points[0]):
        count = kdtree.within_radius(tree, *query, radius**2, *found, np.empty(64, np.int64), np.empty((64, 4)))
        inside = ((points - query) ** 2).sum(axis=1) <= radius**2
        assert sorted(map(tuple, found[:, :count].T)) == sorted(map(tuple, points[inside]))
