import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.core.types import Segments
from steelnb.hough import alternatives
from steelnb.hough.alternatives import bars_of_groups, in_passes, refine
from steelnb.hough.near_segments import nearest_bar
from tests.fusion.made import bars_of
from tests.hough.made import strip


@pytest.mark.kernels
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), end_margin=st.floats(0, 0.3))
def test_nearest_bar_equals_its_slow_twin(seed, end_margin):
    rng = np.random.default_rng(seed)
    points, candidates = rng.uniform(-1, 1, (60, 3)), bars_of(rng.uniform(-1, 1, (5, 2, 3)))
    distance = rng.uniform(0.1, 0.5, 5)
    label = nearest_bar(points, candidates, distance, end_margin)
    for point, found in zip(points, label, strict=True):
        along = ((point - candidates.start) * candidates.direction).sum(axis=1)
        across = np.linalg.norm(point - candidates.start - along[:, None] * candidates.direction, axis=1)
        across[(along < -end_margin) | (along > candidates.length + end_margin) | (across >= distance)] = np.inf
        assert found == (-1 if np.isinf(across).all() else across.argmin())


@pytest.mark.kernels
def test_groups_are_cut_at_gaps_and_merged(monkeypatch):
    along = strip([0, 0, 0], [1, 0, 0], seed=1)
    points = np.concatenate([along, along + np.array([1.5, 0, 0]), along + np.array([0, 0.06, 0])])
    label = np.repeat([0, 0, 1], 600)
    found = bars_of_groups(points, label)
    assert sorted(found.count) == [600, 1200]
    assert len(bars_of_groups(points, np.full(1800, -1))) == 0
    monkeypatch.setattr(alternatives, "MERGE_DISTANCE_M", 0.0)
    assert len(bars_of_groups(points, label)) == 3


def test_refine_moves_a_bar_from_the_edge_to_the_middle_of_a_wide_section():
    points = strip([0, 0, 0], [2, 0, 0], wide_m=0.10)
    found = refine(points, bars_of(([0.5, 0.04, 0], [1.5, 0.03, 0])), 0.06)
    assert len(found) == 1
    assert abs(found.middle[0, 1]) < 0.004
    assert abs(found.direction[0, 1]) < 0.01


def test_refine_merges_the_parts_of_a_bar(monkeypatch):
    points = strip([0, 0, 0], [2, 0, 0], wide_m=0.02)
    points = points[abs(points[:, 0] - 1) > 0.2]
    parts = bars_of(([0, 0, 0], [0.8, 0, 0]), ([1.2, 0, 0], [2, 0, 0]))
    found = refine(points, parts, 0.05)
    assert len(found) == 1
    np.testing.assert_allclose(found.length, 2, atol=0.03)
    monkeypatch.setattr(alternatives, "MERGE_DISTANCE_M", 0.0)
    assert len(refine(points, parts, 0.05)) == 2


def test_a_chord_across_a_bar_is_dropped(monkeypatch):
    monkeypatch.setattr(alternatives, "MERGE_DISTANCE_M", 0.0)
    points = strip([0, 0, 0], [2, 0, 0], 3000, wide_m=0.08)
    found = refine(points, bars_of(([0, 0, 0], [2, 0, 0]), ([0.7, -0.09, 0], [1.3, 0.09, 0])), 0.05)
    assert len(found) == 1
    np.testing.assert_allclose(found.length, 2, atol=0.05)
    assert len(refine(points, Segments.empty(), 0.05)) == 0


def test_the_second_pass_gets_the_points_that_the_first_left():
    points = np.concatenate([strip([0, 0, 0], [1, 0, 0], 100), strip([0, 2, 0], [1, 2, 0], 80)])
    passed = []

    def find(some):
        passed.append(len(some))
        return bars_of(([0, 0, 0], [1, 0, 0]))

    assert len(in_passes(find, points, 0.05)) == 2
    assert passed == [180, 80]
