import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.points import moments
from tests import naive

pytestmark = pytest.mark.kernels
ROWS, COLUMNS = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]


def moments_about(points, weights, origin):
    m = moments.NO_MOMENTS
    for w, (x, y, z) in zip(weights, points - origin, strict=True):
        m = moments.add_point(m, w, x, y, z)
    return m


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(2, 40), first=st.integers(0, 40), shift=st.floats(-1e3, 1e3))
def test_moments_about_two_origins_add_up_to_the_covariance_of_all_points(seed, count, first, shift):
    rng = np.random.default_rng(seed)
    points, weights = rng.normal(size=(count, 3)) * [1, 3, 0.1] + shift, rng.uniform(0.1, 5, count)
    origin_a, origin_b = points[0] + rng.normal(size=(2, 3))
    part_a = moments_about(points[:first], weights[:first], origin_a)
    part_b = moments_about(points[first:], weights[first:], origin_b)
    total = moments.add_moments(part_a, part_b, *(origin_b - origin_a))
    assert total[0] == pytest.approx(weights.sum())
    np.testing.assert_allclose(np.array(total[1:4]) / total[0] + origin_a, weights @ points / weights.sum(), rtol=1e-9)
    expected = np.cov(points.T, aweights=weights, bias=True)
    np.testing.assert_allclose(naive.full([moments.covariance(total)])[0], expected, atol=1e-9)
    row = np.zeros(10)
    moments.store(total, row)
    np.testing.assert_array_equal(row, total)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 30), shift=st.floats(-1e6, 1e6))
def test_moments_about_the_mean_do_not_depend_on_where_the_points_lie(seed, count, shift):
    rng = np.random.default_rng(seed)
    points, chosen = rng.normal(size=(40, 3)) + shift, rng.permutation(40)
    *mean, m = moments.moments_about_mean(*points.T.copy(), chosen, count)
    some = points[chosen[:count]]
    np.testing.assert_allclose(mean, some.mean(axis=0), rtol=1e-9, atol=1e-9)
    offset = some - some.mean(axis=0)
    assert m[0] == count
    np.testing.assert_allclose(m[4:], (offset.T @ offset)[ROWS, COLUMNS], atol=1e-6)


def matrices():
    rng = np.random.default_rng(2)
    general = rng.normal(size=(200, 3, 3))
    shapes = [general @ general.transpose(0, 2, 1)]
    axes = np.linalg.qr(rng.normal(size=(60, 3, 3)))[0]
    for values in ([0, 0, 1], [0, 1, 1], [1, 1, 1], [1e-12, 1e-6, 1], [0, 0, 0], [1e-9, 1e-9, 2e-9]):
        shapes.append((axes * np.array(values, dtype=float)) @ axes.transpose(0, 2, 1))
    return np.concatenate([*shapes, [np.diag([3.0, 1, 2])]])


def test_eigenvalues_and_eigenvectors_equal_lapack():
    for matrix in matrices():
        atol = 1e-13 * max(np.abs(matrix).max(), 1e-300)
        answer = np.array(moments.eigen(*matrix[ROWS, COLUMNS]))
        value, vector = answer[:, 0], answer[:, 1:].T
        np.testing.assert_allclose(value, np.linalg.eigvalsh(matrix), atol=atol)
        np.testing.assert_allclose(vector.T @ vector, np.eye(3), atol=1e-13)
        np.testing.assert_allclose(matrix @ vector, vector * value, atol=atol)
        along, across, *axis = moments.principal_axis(*matrix[ROWS, COLUMNS])
        np.testing.assert_allclose([along, across], [value[2], max(value[0] + value[1], 0)], atol=atol)
        np.testing.assert_allclose(matrix @ axis, along * np.array(axis), atol=atol)
        assert axis[np.abs(axis).argmax()] > 0
