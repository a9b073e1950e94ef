import math

import numpy as np
import pytest

from steelnb.fusion import section_fit, sections
from steelnb.fusion.sights import owners


@pytest.mark.parametrize("turn", [0, 5, 17])
@pytest.mark.parametrize("flange", section_fit.FLANGES_M[[1, 5, 9]])
def test_the_search_takes_the_same_steps_with_tables_as_with_outlines(turn, flange):
    rng = np.random.default_rng(turn)
    view = rng.integers(0, sections.VIEWS, 200)
    angle = (view + 0.5) * 2 * math.pi / sections.VIEWS - math.pi
    place = flange * ([0.4, -0.3] + 0.4 * rng.normal(size=(200, 2)))
    weight, zero = rng.uniform(0.5, 2.0, 200), np.zeros(200)
    cells = np.column_stack([place, weight, np.cos(angle), np.sin(angle), zero, view])
    rows = np.column_stack([-0.5 * flange + zero[:9], 0.6 * flange + zero[:9], cells[:9, 3:5], weight[:9], view[:9]])
    corner, normal = np.empty((6, 2)), np.empty((4, 5))
    sections.outline(2 * math.pi * turn / section_fit.TURNS, flange, corner)
    exact = section_fit._step(cells, rows, corner, np.zeros(4), normal)
    total = cells[:, 2].sum()
    move = np.linalg.solve(normal[:2, :2] + 1e-3 * total * np.eye(2), normal[:2, 4]).clip(-0.03, 0.03)
    found = np.zeros(2)
    cost = section_fit._place(cells, rows, *section_fit._profiles(), flange, turn, found, 1)
    assert cost == pytest.approx(exact, rel=0.02)
    assert np.linalg.norm(move) > 0.02 * flange
    assert found == pytest.approx(move, abs=0.005 * flange)


def test_a_voxel_belongs_to_the_nearest_bar_unless_another_is_nearly_as_near():
    rng = np.random.default_rng(2)
    start, end = rng.uniform(-2, 2, (2, 12, 3))
    length = np.linalg.norm(end - start, axis=1)
    direction = (end - start) / length[:, None]
    at = rng.uniform(-2.5, 2.5, (20000, 3))
    along = np.einsum("nbk,bk->nb", at[:, None] - start, direction).clip(0, length)
    distance = np.linalg.norm(at[:, None] - start - along[..., None] * direction, axis=2)
    first, second = np.sort(distance, axis=1)[:, :2].T
    expected = np.where((first <= 0.2) & (second - first >= 0.05), distance.argmin(axis=1), -1)
    assert 200 < np.count_nonzero(expected >= 0) < 10000
    np.testing.assert_array_equal(owners(start, direction, length, at, 0.2, 0.05), expected)
