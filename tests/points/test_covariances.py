import numpy as np
import pytest

from steelnb.points.covariances import PLANE_THICKNESS, PlaneCovariances, neighbour_covariances, normals, regularised
from steelnb.points.kdtree import build_kdtree
from tests import naive

RNG = np.random.default_rng(1)
CLOUDS = {
    "uniform": RNG.uniform(-1, 1, (150, 3)),
    "plane": np.column_stack([RNG.uniform(-1, 1, (120, 2)), np.zeros(120)]),
    "line": np.outer(RNG.uniform(size=90), [1.0, 2, -1]),
    "clusters": np.vstack([RNG.normal(size=(70, 3)) * 1e-3, RNG.normal(size=(60, 3)) + 20]),
    "few": RNG.normal(size=(7, 3)),
    "one": np.array([[1.0, 2, 3]]),
    "far": RNG.uniform(-1, 1, (120, 3)) + np.array([4e5, 5e6, 100]),
}


@pytest.mark.kernels
@pytest.mark.parametrize("k", [4, 20])
@pytest.mark.parametrize("name", CLOUDS)
def test_covariances_equal_their_slow_twin(name, k):
    points = CLOUDS[name]
    result = neighbour_covariances(points, k)
    expected = naive.covariances(points, min(k, len(points)))
    np.testing.assert_allclose(naive.full(result), expected, atol=1e-10 * max(expected.max(), 1e-6))
    tree = build_kdtree(points)
    np.testing.assert_array_equal(neighbour_covariances(points, k, tree), result)
    np.testing.assert_array_equal(neighbour_covariances(tree.point, k, tree), result[tree.order])


@pytest.mark.parametrize("k", [5, 20])
def test_ties_and_duplicates(k):
    # On a grid many points are at equal distance. The trace is Σd²/k − |mean|², however ties are broken.
    grid = np.stack(np.meshgrid(*[np.arange(7.0)] * 3), axis=-1).reshape(-1, 3)
    middle = np.flatnonzero((grid == 3).all(axis=1))[0]
    result = naive.full(neighbour_covariances(grid, k))
    _, distance = naive.nearest_k(grid, grid[middle], k)
    trace = np.trace(result[middle])
    assert (distance**2).mean() - 1.0 <= trace <= (distance**2).mean() + 1e-12
    np.testing.assert_allclose(neighbour_covariances(np.ones((50, 3)), k), 0)
    two_places = np.repeat([[0.0, 0, 0], [1, 0, 0]], 30, axis=0)
    np.testing.assert_allclose(neighbour_covariances(two_places, min(k, 30)), 0, atol=1e-15)


def test_no_points_have_no_covariances():
    assert neighbour_covariances(np.zeros((0, 3))).shape == (0, 6)
    assert regularised(np.zeros((0, 6))).shape == (0, 6)
    assert normals(np.zeros((0, 6))).shape == (0, 3)


def test_normals_and_regularised_covariances_keep_the_eigenvectors():
    spread = neighbour_covariances(CLOUDS["uniform"], 8)
    value, vector = np.linalg.eigh(naive.full(spread))
    assert (np.diff(value, axis=1) > 1e-6).all()
    np.testing.assert_allclose(np.abs((normals(spread) * vector[:, :, 0]).sum(axis=1)), 1, atol=1e-9)
    expected = (vector * [PLANE_THICKNESS, 1, 1]) @ vector.transpose(0, 2, 1)
    np.testing.assert_allclose(naive.full(regularised(spread)), expected, atol=1e-8)


def test_covariances_computed_on_demand_equal_those_of_all_points():
    tree = build_kdtree(CLOUDS["uniform"])
    rng, expected = np.random.default_rng(3), regularised(neighbour_covariances(tree.point, 12, tree))
    planes = PlaneCovariances(tree, 12)
    for _ in range(6):
        index = np.append(rng.integers(0, len(tree.point), 4), -1)
        planes.fill(index)
        np.testing.assert_array_equal(planes.value[index[:-1]], expected[index[:-1]])
    computed = np.isfinite(planes.value).all(axis=1)
    assert 4 <= np.count_nonzero(computed) < len(computed)
    np.testing.assert_array_equal(planes.value[computed], expected[computed])
