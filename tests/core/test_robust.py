import numpy as np
import pytest
from numba import njit

from steelnb.core.robust import geman_mcclure, weighted_geman_mcclure
from tests import naive

SCALE = 0.05


@njit
def compiled(squared, scale, weight):
    return geman_mcclure(squared, scale), weighted_geman_mcclure(squared, scale * scale, weight)


@pytest.mark.kernels
def test_compiled_weights_are_those_of_python_to_the_last_bit_and_for_arrays_those_of_numbers():
    squared = np.random.default_rng(0).gamma(1.0, 0.01, 50)
    arrays = np.array([*geman_mcclure(squared, SCALE), *weighted_geman_mcclure(squared, SCALE * SCALE, 3.0)])
    for k, each in enumerate(squared.tolist()):
        one, other = compiled(each, SCALE, 3.0)
        assert [*one, *other] == arrays[:, k].tolist()


def test_the_weight_is_the_derivative_of_the_loss_by_half_the_square():
    squared, step = np.linspace(0.0, 0.02, 20), 1e-8
    weight, _ = geman_mcclure(squared, SCALE)
    ahead, behind = (geman_mcclure(squared + s * step, SCALE)[1] for s in (1, -1))
    np.testing.assert_allclose((ahead - behind) / step, weight, atol=1e-6)


def test_both_forms_agree_with_the_twin_and_the_loss_is_bounded():
    squared = np.geomspace(1e-8, 1e8, 30)
    weight, loss = geman_mcclure(squared, SCALE)
    other, doubled = weighted_geman_mcclure(squared, SCALE**2, 1.0)
    np.testing.assert_allclose(other, weight, rtol=1e-12)
    np.testing.assert_allclose(0.5 * doubled, loss, rtol=1e-12)
    np.testing.assert_allclose(loss, [naive.robust(each, SCALE) for each in squared], rtol=1e-12)
    assert loss.max() <= 0.5 * SCALE**2
    assert (np.diff(weight) < 0).all()


@pytest.mark.kernels
def test_an_infinite_scale_is_plain_least_squares():
    assert geman_mcclure(4.0, np.inf) == compiled(4.0, np.inf, 1.0)[0] == (1.0, 2.0)
