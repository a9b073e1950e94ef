import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from steelnb.registration import free_directions
from steelnb.registration.observability import unobserved_shifts, without_shifts

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


@given(st.integers(0, 10**6))
def test_along_a_wall_both_directions_are_unobserved_whatever_way_it_faces(seed):
    normal = Rotation.random(random_state=seed).as_matrix()[0]
    found = unobserved(plates(normal))
    assert found.shape == (2, 3)
    np.testing.assert_allclose(found @ normal, 0, atol=1e-9)
    np.testing.assert_allclose(found @ found.T, np.eye(2), atol=1e-9)


@given(st.integers(0, 10**6))
def test_between_two_walls_it_is_the_edge_and_in_a_corner_nothing(seed):
    axes = Rotation.random(random_state=seed).as_matrix()
    edge = unobserved(plates(axes[:2]))
    assert edge.shape == (1, 3)
    assert abs(edge[0] @ axes[2]) == pytest.approx(1)
    assert unobserved(plates(axes)).shape == (0, 3)


@pytest.mark.parametrize(("share", "left"), [(0.02, 1), (0.2, 0)])
def test_a_few_points_of_another_direction_do_not_make_it_observed_but_a_fifth_does(share, left):
    few = plates([[0, 0, 1.0]], count=round(1000 * share))
    assert len(unobserved(np.concatenate([plates([[1.0, 0, 0], [0, 1.0, 0]], count=500), few]))) == left


def test_points_without_a_pair_and_no_pairs_at_all():
    covariance = np.concatenate([plates([1.0, 0, 0]), plates([[0, 1.0, 0], [0, 0, 1.0]])])
    only_the_wall = np.where(np.arange(150) < 50, np.arange(150), -1)
    assert len(unobserved_shifts(covariance, only_the_wall, SHARE)) == 2
    assert unobserved_shifts(covariance, np.full(7, -1), SHARE).shape == (0, 3)


@pytest.mark.parametrize("dof", ["xyz", "xyz_yaw", "se3"])
def test_what_is_left_of_the_free_directions_has_no_shift_along_them_and_all_turns(dof):
    free, along = free_directions(dof), np.array([[0.6, 0.8, 0.0]])
    left = without_shifts(free, along)
    assert left.shape == (6, free.shape[1] - 1)
    np.testing.assert_allclose(along @ left[3:], 0, atol=1e-12)
    assert np.linalg.matrix_rank(left[:3], tol=1e-9) == np.linalg.matrix_rank(free[:3])
    assert without_shifts(free, np.zeros((0, 3))) is free
