import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from steelnb.registration import FREE
from steelnb.registration.solver import unobserved_shifts, without_shifts

SHARE = 0.05


def plates(normals, count=50, thin_m=0.01, wide_m=0.06):
    """Covariances ``(len(normals) * count, 6)`` of flat distributions with these normals."""
    rows = []
    for normal in np.atleast_2d(normals):
        n = normal / np.linalg.norm(normal)
        C = wide_m**2 * (np.eye(3) - np.outer(n, n)) + thin_m**2 * np.outer(n, n)
        rows += [C[np.triu_indices(3)]] * count
    return np.array(rows)


def unobserved(covariance):
    return unobserved_shifts(covariance, np.arange(len(covariance)), SHARE)


@pytest.mark.parametrize("walls", [1, 2, 3])
@given(seed=st.integers(0, 10**6))
def test_directions_without_a_wall_across_are_unobserved(walls, seed):
    axes = Rotation.random(random_state=seed).as_matrix()
    found = unobserved(plates(axes[:walls]))
    assert found.shape == (3 - walls, 3)
    np.testing.assert_allclose(found @ axes[:walls].T, 0, atol=1e-7)
    np.testing.assert_allclose(found @ found.T, np.eye(3 - walls), atol=1e-9)


@pytest.mark.parametrize(("share", "remaining"), [(0.02, 1), (0.2, 0)])
def test_a_fifth_of_the_points_makes_a_direction_observed_but_a_few_do_not(share, remaining):
    few = plates([[0, 0, 1.0]], count=round(1000 * share))
    assert len(unobserved(np.concatenate([plates([[1.0, 0, 0], [0, 1.0, 0]], count=500), few]))) == remaining


def test_points_without_a_pair_are_ignored():
    covariance = np.concatenate([plates([1.0, 0, 0]), plates([[0, 1.0, 0], [0, 0, 1.0]])])
    only_the_wall = np.where(np.arange(150) < 50, np.arange(150), -1)
    assert len(unobserved_shifts(covariance, only_the_wall, SHARE)) == 2
    assert unobserved_shifts(covariance, np.full(7, -1), SHARE).shape == (0, 3)


@pytest.mark.parametrize("dof", ["xyz", "xyz_yaw", "se3"])
def test_without_shifts_removes_the_translations_and_keeps_the_rotations(dof):
    free, along = FREE[dof], np.array([[0.6, 0.8, 0.0]])
    remaining = without_shifts(free, along)
    assert remaining.shape == (6, free.shape[1] - 1)
    np.testing.assert_allclose(along @ remaining[3:], 0, atol=1e-12)
    assert np.linalg.matrix_rank(remaining[:3], tol=1e-9) == np.linalg.matrix_rank(free[:3])
    assert without_shifts(free, np.zeros((0, 3))) is free
