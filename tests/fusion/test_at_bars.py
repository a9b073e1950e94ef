"""Ends at many bars at once, against one bar after the other."""

import numpy as np
import pytest

from steelnb.fusion.bars import TUBE_M, beyond_ends
from steelnb.fusion.cloud_bars import at_bars
from steelnb.fusion.joints import REACH_M
from steelnb.hough.near_segments import within
from tests.fusion.made import bars_of


@pytest.mark.kernels
@pytest.mark.parametrize("some", [False, True])
def test_an_end_meets_others_but_not_its_own_bar(some: bool) -> None:
    rng = np.random.default_rng(2)
    bars, number = bars_of(*rng.uniform(-0.5, 0.5, (12, 2, 3))), np.arange(12)
    these = number % 3 > 0 if some else np.ones(12, dtype=bool)
    beyond = beyond_ends(bars, REACH_M, TUBE_M)
    others = [bars.take(these & (number != k)) for k in number]
    meets = [within(beyond[:, :, k].reshape(-1, 3), others[k], 1.5 * TUBE_M).reshape(2, -1).any(axis=1) for k in number]
    np.testing.assert_array_equal(at_bars(bars, TUBE_M, these if some else None), meets)
    assert 0 < np.mean(meets) < 1
