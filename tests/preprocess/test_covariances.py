import numpy as np
import pytest

from steelnb.preprocess.covariances import eigen, full, neighbour_covariances, normals, packed, regularised
from steelnb.preprocess.kdtree import build_kdtree
from tests import naive

RNG = np.random.default_rng(1)
CLOUDS = {
    "uniform": RNG.uniform(-1, 1, (500, 3)),
    "plane": np.column_stack([RNG.uniform(-1, 1, (400, 2)), np.zeros(400)]),
    "line": np.outer(RNG.uniform(size=200), [1.0, 2, -1]),
    "clusters": np.vstack([RNG.normal(size=(100, 3)) * 1e-3, RNG.normal(size=(60, 3)) + 20]),
    "few": RNG.normal(size=(7, 3)),
    "one": np.array([[1.0, 2, 3]]),
    "far": RNG.uniform(-1, 1, (300, 3)) + np.array([4e5, 5e6, 100]),
}


@pytest.mark.parametrize("k", [4, 20])
@pytest.mark.parametrize("name", CLOUDS)
def test_covariances_are_their_slow_twin(name, k):
    points = CLOUDS[name]
    result = neighbour_covariances(points, k)
    expected = naive.covariances(points, min(k, len(points)))
    np.testing.assert_allclose(full(result), expected, atol=1e-10 * max(expected.max(), 1e-6))


def test_covariances_come_in_the_order_of_the_tree_where_its_points_are_given():
    points = CLOUDS["uniform"]
    tree = build_kdtree(points)
    in_order = neighbour_covariances(points, 10)
    np.testing.assert_array_equal(neighbour_covariances(points, 10, tree), in_order)
    np.testing.assert_array_equal(neighbour_covariances(tree.point, 10, tree), in_order[tree.order])
    assert (tree.order != np.arange(len(points))).any()


@pytest.mark.parametrize("k", [5, 7, 20, 30])
def test_ties_and_duplicates_are_taken_as_they_come(k):
    # A grid: many points are equally far. The trace is Σd²/k − |mean|², whatever the choice among equals.
    grid = np.stack(np.meshgrid(*[np.arange(7.0)] * 3), axis=-1).reshape(-1, 3)
    middle = np.flatnonzero((grid == 3).all(axis=1))[0]
    result = full(neighbour_covariances(grid, k))
    _, distance = naive.nearest_k(grid, grid[middle], k)
    trace = np.trace(result[middle])
    assert (distance**2).mean() - 1.0 <= trace <= (distance**2).mean() + 1e-12
    np.testing.assert_allclose(neighbour_covariances(np.ones((50, 3)), k), 0)
    half = np.repeat([[0.0, 0, 0], [1, 0, 0]], 30, axis=0)
    np.testing.assert_allclose(neighbour_covariances(half, min(k, 30)), 0, atol=1e-15)


def test_no_points_have_no_covariances():
    assert neighbour_covariances(np.zeros((0, 3))).shape == (0, 6)
    assert regularised(np.zeros((0, 6))).shape == (0, 6)
    assert normals(np.zeros((0, 6))).shape == (0, 3)


def matrices():
    rng = np.random.default_rng(2)
    general = rng.normal(size=(200, 3, 3))
    shapes = [general @ general.transpose(0, 2, 1)]
    axes = np.linalg.qr(rng.normal(size=(60, 3, 3)))[0]
    for values in ([0, 0, 1], [0, 1, 1], [1, 1, 1], [1e-12, 1e-6, 1], [0, 0, 0], [1e-9, 1e-9, 2e-9]):
        shapes.append((axes * np.array(values, dtype=float)) @ axes.transpose(0, 2, 1))
    return np.concatenate([*shapes, [np.diag([3.0, 1, 2])]])


def test_eigenvalues_and_vectors_are_lapacks():
    for matrix in matrices():
        answer = np.array(eigen(*packed(matrix[None])[0]))
        value, vector = answer[:, 0], answer[:, 1:].T
        np.testing.assert_allclose(value, np.linalg.eigvalsh(matrix), atol=1e-13 * max(np.abs(matrix).max(), 1e-300))
        np.testing.assert_allclose(vector.T @ vector, np.eye(3), atol=1e-13)
        np.testing.assert_allclose(matrix @ vector, vector * value, atol=1e-13 * max(np.abs(matrix).max(), 1e-300))


def test_normals_and_regularised_covariances_have_the_axes_of_the_spread():
    spread = packed(matrices()[:200])
    _, vector = np.linalg.eigh(full(spread))
    along = (normals(spread) * vector[:, :, 0]).sum(axis=1)
    np.testing.assert_allclose(np.abs(along), 1, atol=1e-9)
    for wanted in ((1e-3, 1.0, 1.0), (0.5, 2.0, 3.0)):
        expected = (vector * np.array(wanted)) @ vector.transpose(0, 2, 1)
        np.testing.assert_allclose(full(regularised(spread, wanted)), expected, atol=1e-8)


def test_packed_and_full_are_inverse():
    spread = np.arange(12.0).reshape(2, 6)
    np.testing.assert_array_equal(packed(full(spread)), spread)
    np.testing.assert_array_equal(full(spread), full(spread).transpose(0, 2, 1))
