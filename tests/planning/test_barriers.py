import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from steelnb.planning.barriers import Barrier, nearest_command

COST = np.array([1.0, 1.0, 1.0, 0.3])


def test_a_wish_that_keeps_all_barriers_is_granted():
    wished = np.array([0.5, 0.0, 0.1, 0.2])
    barrier = Barrier(np.array([-1.0, 0.0, 0.0, 0.0]), 1.0, 1.0, 1e4)
    np.testing.assert_array_equal(nearest_command(wished, COST, [barrier]), wished)
    np.testing.assert_array_equal(nearest_command(wished, COST, []), wished)


def test_a_wall_ahead_takes_the_part_of_the_wish_towards_it_and_no_other():
    ahead = Barrier(np.array([-1.0, 0.0, 0.0, 0.0]), 0.2, 1.0, 1e6)
    np.testing.assert_allclose(
        nearest_command(np.array([0.5, 0.3, 0.1, 0.2]), COST, [ahead]), [0.2, 0.3, 0.1, 0.2], atol=1e-5
    )


def test_between_barriers_that_exclude_each_other_the_heavier_one_wins():
    forward, back = np.array([1.0, 0.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0, 0.0])
    both = [Barrier(forward, -0.4, 1.0, 1e4), Barrier(back, -0.4, 1.0, 10.0)]
    assert nearest_command(np.zeros(4), COST, both)[0] == pytest.approx(0.4, abs=0.01)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 12))
def test_the_command_is_that_of_a_general_solver(seed, count):
    random = np.random.default_rng(seed)
    wished = random.uniform(-1, 1, 4)
    barriers = [
        Barrier(random.standard_normal(4), random.uniform(-0.5, 0.5), 1.0, 10 ** random.uniform(0, 3))
        for _ in range(count)
    ]

    def cost(u):
        missed = np.array([max(0.0, -b.alpha * b.value - b.gradient @ u) for b in barriers])
        return 0.5 * (COST * (u - wished) ** 2).sum() + 0.5 * np.array([b.weight for b in barriers]) @ missed**2

    found = nearest_command(wished, COST, barriers)
    general = minimize(cost, found, method="BFGS", options={"gtol": 1e-9})
    assert cost(found) <= general.fun + 1e-6 * (1 + general.fun)
