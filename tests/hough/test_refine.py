import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.core.types import Segments
from steelnb.hough.alternatives import refine as module
from steelnb.hough.alternatives.refine import bars_of_groups, in_passes, refine
from steelnb.hough.freedom import nearest_bar


def bars(*ends):
    ends = np.array(ends, dtype=float).reshape(-1, 2, 3)
    return Segments(ends[:, 0], ends[:, 1], np.full(len(ends), 50), np.full(len(ends), 0.01))


def strip(start, end, wide, n=600, noise_m=0.005, seed=0):
    """Points on a strip of width ``wide`` along y around a line from start to end."""
    rng = np.random.default_rng(seed)
    start, end = np.array(start, float), np.array(end, float)
    points = start + rng.uniform(size=(n, 1)) * (end - start) + rng.normal(scale=noise_m, size=(n, 3))
    points[:, 1] += rng.uniform(-wide / 2, wide / 2, n)
    return points


@pytest.mark.kernels
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), end_margin=st.floats(0, 0.3))
def test_nearest_bar_equals_its_slow_twin(seed, end_margin):
    rng = np.random.default_rng(seed)
    points, candidates = rng.uniform(-1, 1, (60, 3)), bars(rng.uniform(-1, 1, (5, 2, 3)))
    label = nearest_bar(points, candidates, 0.4, end_margin)
    for point, found in zip(points, label, strict=True):
        along = ((point - candidates.start) * candidates.direction).sum(axis=1)
        across = np.linalg.norm(point - candidates.start - along[:, None] * candidates.direction, axis=1)
        across[(along < -end_margin) | (along > candidates.length + end_margin) | (across >= 0.4)] = np.inf
        assert found == (-1 if np.isinf(across).all() else across.argmin())


@pytest.mark.kernels
def test_groups_are_cut_at_gaps_and_merged(monkeypatch):
    along = strip([0, 0, 0], [1, 0, 0], 0.0, seed=1)
    points = np.concatenate([along, along + np.array([1.5, 0, 0]), along + np.array([0, 0.06, 0])])
    label = np.repeat([0, 0, 1], 600)
    found = bars_of_groups(points, label)
    assert sorted(found.count) == [600, 1200]
    assert len(bars_of_groups(points, np.full(1800, -1))) == 0
    monkeypatch.setattr(module, "MERGE_DISTANCE_M", 0.0)
    assert len(bars_of_groups(points, label)) == 3


def test_refine_moves_a_bar_from_the_edge_to_the_middle_of_a_wide_section():
    points = strip([0, 0, 0], [2, 0, 0], 0.10)
    found = refine(points, bars(([0.5, 0.04, 0], [1.5, 0.03, 0])), 0.06)
    assert len(found) == 1
    assert abs(found.middle[0, 1]) < 0.004
    assert abs(found.direction[0, 1]) < 0.01


def test_refine_merges_the_parts_of_a_bar(monkeypatch):
    points = strip([0, 0, 0], [2, 0, 0], 0.02)
    points = points[abs(points[:, 0] - 1) > 0.2]
    parts = bars(([0, 0, 0], [0.8, 0, 0]), ([1.2, 0, 0], [2, 0, 0]))
    found = refine(points, parts, 0.05)
    assert len(found) == 1
    np.testing.assert_allclose(found.length, 2, atol=0.03)
    monkeypatch.setattr(module, "MERGE_DISTANCE_M", 0.0)
    assert len(refine(points, parts, 0.05)) == 2


def test_a_chord_across_a_bar_is_dropped(monkeypatch):
    monkeypatch.setattr(module, "MERGE_DISTANCE_M", 0.0)
    points = strip([0, 0, 0], [2, 0, 0], 0.08, n=3000)
    found = refine(points, bars(([0, 0, 0], [2, 0, 0]), ([0.7, -0.09, 0], [1.3, 0.09, 0])), 0.05)
    assert len(found) == 1
    np.testing.assert_allclose(found.length, 2, atol=0.05)
    assert len(refine(points, Segments.empty(), 0.05)) == 0


def test_the_second_pass_gets_the_points_that_the_first_left():
    points = np.concatenate([strip([0, 0, 0], [1, 0, 0], 0.02, n=100), strip([0, 2, 0], [1, 2, 0], 0.02, n=80)])
    passed = []

    def find(some):
        passed.append(len(some))
        return bars(([0, 0, 0], [1, 0, 0]))

    assert len(in_passes(find, points, 0.05)) == 2
    assert passed == [180, 80]
