import numpy as np
import pytest

from steelnb.preprocess import kdtree
from tests import naive

CLOUDS = {
    "uniform": np.random.default_rng(1).uniform(-1, 1, (700, 3)),
    "line": np.outer(np.random.default_rng(2).uniform(size=300), [1.0, 2, -1]),
    "clusters": np.random.default_rng(3).normal(size=(400, 3)) * 1e-3 + np.repeat(np.eye(4, 3) * 50, 100, axis=0),
    "grid": np.stack(np.meshgrid(*[np.arange(6.0)] * 3), axis=-1).reshape(-1, 3),
    "one": np.array([[1.0, 2, 3]]),
    "equal": np.ones((60, 3)),
}
QUERIES = np.vstack([np.random.default_rng(4).uniform(-2, 6, (60, 3)), [[1.0, 1, 1], [50, 0, 0], [1e6, 0, 0]]])


def scratch():
    return np.empty(64, np.int64), np.empty((64, 4))


@pytest.mark.parametrize("name", CLOUDS)
def test_the_tree_holds_every_point_once(name):
    points = CLOUDS[name]
    tree = kdtree.build_kdtree(points)
    np.testing.assert_array_equal(np.sort(tree.order), np.arange(len(points)))
    np.testing.assert_array_equal(tree.point, points[tree.order])
    leaf = tree.axis < 0
    assert (tree.right - tree.left)[leaf].sum() == len(points)
    assert (tree.right - tree.left)[leaf].max() <= kdtree.LEAF


@pytest.mark.parametrize("limit", [np.inf, 1.0, 0.01])
@pytest.mark.parametrize("name", CLOUDS)
def test_nearest_k_is_its_slow_twin(name, limit):
    tree = kdtree.build_kdtree(CLOUDS[name])
    for k in (1, 3, 20):
        found, distance = np.full(k, -7), np.full(k, -7.0)
        for query in np.vstack([QUERIES, CLOUDS[name][::50]]):
            count = kdtree.nearest_k(tree, *query, k, limit**2, found, distance, *scratch())
            _, expected = naive.nearest_k(tree.point, query, k)
            expected = expected[expected < limit]
            np.testing.assert_allclose(np.sqrt(distance[:count]), expected, atol=1e-9)
            apart = np.linalg.norm(tree.point[found[:count]] - query, axis=1)
            np.testing.assert_allclose(apart, expected, atol=1e-9)
            assert len(set(found[:count])) == count


@pytest.mark.parametrize("name", CLOUDS)
def test_within_finds_all_points_in_a_ball(name):
    tree = kdtree.build_kdtree(CLOUDS[name])
    found = np.empty((3, len(tree.point) + 1))
    for query in QUERIES:
        for radius in (0.0, 0.6, 3.0, 1e7):
            count = kdtree.within(tree, *query, radius**2, *found, *scratch())
            inside = ((tree.point - query) ** 2).sum(axis=1) <= radius**2
            assert sorted(map(tuple, found[:, :count].T)) == sorted(map(tuple, tree.point[inside]))
