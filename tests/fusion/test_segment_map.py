"""Association of segments, and the map into which they are merged."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from steelnb.core.types import Segments
from steelnb.fusion import SegmentMap, associate
from steelnb.fusion.segment_map import GAP_MAX_M, pair_distance, structure_of
from steelnb.settings import FusionSettings
from tests import naive
from tests.fusion.made import bars_of, distance_to_lines, random_bars, rigid, turned

NARROW = FusionSettings(angle_max_rad=math.radians(5), distance_max_m=0.1, add_radii=False)
LEG = ([0, 0, 0], [0, 0, 4])
# A portal: two posts, a beam and a brace, which meet at four places.
PORTAL = np.array(
    [[[0, 0, 0], [0, 0, 4]], [[3, 0, 0], [3, 0, 4]], [[0, 0, 4], [3, 0, 4]], [[0, 0, 0], [3, 0, 4]]], dtype=float
)
SEEDS = st.integers(0, 10_000)


def frame(rng, share=0.5):
    """Pieces of some bars of the portal, as a scan sees them: noisy, of any length, either end first."""
    pieces = []
    for start, end in PORTAL[rng.random(len(PORTAL)) < 0.8]:
        low = rng.uniform(0, 1 - share)
        ends = start + np.array([[low], [low + rng.uniform(0.4, 1) * share]]) * (end - start)
        pieces.append((ends + rng.normal(scale=0.005, size=(2, 3)))[:: rng.choice([-1, 1])])
    pieces = bars_of(*pieces)
    return Segments(pieces.start, pieces.end, rng.integers(20, 200, len(pieces)), rng.uniform(0.005, 0.02, len(pieces)))


def built(frames, settings=NARROW):
    bars = SegmentMap(settings)
    for each in frames:
        bars.insert(each)
    return bars


def test_the_nearest_of_two_bars_is_taken():
    known, new = bars_of(LEG, ([0.15, 0, 0], [0.15, 0, 4])), bars_of(*(([x, 0, 1], [x, 0, 2]) for x in (0.09, 0.33)))
    assert associate(new, known, NARROW).tolist() == [1, -1]
    assert len(associate(Segments.empty(), known, NARROW)) == 0
    assert associate(new, Segments.empty(), NARROW).tolist() == [-1, -1]


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_distances_are_those_of_the_definition(seed):
    rng = np.random.default_rng(seed)
    known, wide = random_bars(seed, 12), FusionSettings(angle_max_rad=0.5, distance_max_m=0.3, add_radii=bool(seed % 2))
    # Most overlap the known ones, others lie behind an end, some of them by more than the gap.
    shift, low = rng.normal(scale=0.15, size=(2, 12, 3)), rng.uniform(-1.0, 1.2, 12)[:, None]
    run = known.end - known.start
    ends = known.start + (low + 0.7) * run + shift[0], known.start + low * run + shift[1]
    new = Segments(*ends, known.count, known.radius)
    expected = naive.pair_distance(new, known, wide, GAP_MAX_M)
    assume(np.isfinite(expected).any())
    np.testing.assert_allclose(pair_distance(new, known, wide), expected, atol=1e-12)
    np.testing.assert_allclose(pair_distance(turned(new, seed), turned(known, seed + 1), wide), expected, atol=1e-12)


def test_merging_is_weighted_by_point_counts():
    bars = built([bars_of(LEG, count=300), bars_of(([0.08, 0, 0], [0.08, 0, 4]), count=100)])
    assert len(bars) == 1
    np.testing.assert_allclose(bars.segments.middle[0], [0.02, 0, 2], atol=1e-9)
    assert bars.segments.count[0] == 400
    assert bars.sightings[0] == 2


def test_two_bars_that_grow_into_each_other_become_one():
    bars = built([bars_of(([0, 0, 0], [0, 0, 1]), ([0, 0, 3], [0, 0, 4]), ([5, 0, 0], [6, 0, 0]), count=50)])
    assert len(bars) == 3
    target = bars.insert(bars_of(([0, 0, 0.9], [0, 0, 3.1]), count=50))
    assert target.tolist() == [0]
    assert bars.segments.length[0] == pytest.approx(4)
    assert bars.sightings.tolist() == [3, 1]
    assert bars.segments.count.tolist() == [150, 50]


def by_axis(bars: SegmentMap) -> tuple[Segments, np.ndarray]:
    """The bars of the portal that the map holds, in their order, and their sightings."""
    away = distance_to_lines(bars.segments.middle, PORTAL)
    order = np.argsort(away.argmin(axis=1), kind="stable")
    return bars.segments.take(order), bars.sightings[order]


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.permutations(range(12)))
def test_the_order_of_frames_changes_ends_by_the_noise_and_nothing_else(seed, order):
    rng = np.random.default_rng(seed)
    frames = [bars_of(*PORTAL), *(frame(rng) for _ in range(12))]  # the whole first: no piece is left apart
    one, other = built(frames), built([frames[0], *(frames[k + 1] for k in order)])
    assert len(one) == len(other) == 4
    (a, seen), (b, seen_too) = by_axis(one), by_axis(other)
    np.testing.assert_array_equal(seen, seen_too)
    np.testing.assert_array_equal(a.count, b.count)
    assert a.count.sum() == sum(each.count.sum() for each in frames)
    np.testing.assert_allclose(a.radius, b.radius, rtol=1e-12)
    np.testing.assert_allclose(np.abs((a.direction * b.direction).sum(axis=1)), 1, atol=1e-12)
    assert np.diag(distance_to_lines(a.middle, np.stack([b.start, b.end], axis=1))).max() < 1e-9
    assert np.abs(a.length - b.length).max() < 0.02


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.sampled_from([(10.0, 1e-9), (5e6, 1e-7)]))
def test_a_moved_map_is_the_map_of_moved_segments_also_in_the_coordinates_of_a_survey(seed, reach):
    rng, (reach_m, atol) = np.random.default_rng(seed), reach
    frames, T = [frame(rng) for _ in range(6)], rigid(seed, reach_m)
    moved, bars = built(each.transformed(T) for each in frames), built(frames)
    assert len(moved) == len(bars)
    expected = bars.segments.transformed(T)
    np.testing.assert_allclose(moved.segments.middle, expected.middle, atol=atol)
    np.testing.assert_allclose(np.abs((moved.segments.direction * expected.direction).sum(axis=1)), 1, atol=atol)
    np.testing.assert_allclose(moved.segments.length, expected.length, atol=atol)
    np.testing.assert_allclose(moved.segments.radius, expected.radius, atol=atol)


def test_segments_handed_out_do_not_change_later():
    bars = built([bars_of(LEG)])
    before = bars.segments
    end = before.end.copy()
    bars.insert(bars_of(([0.05, 0, 3], [0.05, 0, 6])))
    np.testing.assert_array_equal(before.end, end)


def test_pruning_drops_bars_seen_seldom_and_long_ago():
    bars = built([bars_of(([x, 0, 0], [x, 0, 2])) for x in (0.0, 0.0, 5.0, 0.0, 0.0, 9.0)])
    bars.prune(3, inserts=4)
    assert len(bars) == 3  # the one at 5 m was seen three inserts ago
    bars.prune(3, inserts=3)
    np.testing.assert_allclose(bars.segments.start[:, 0], [0, 9])
    bars.insert(bars_of(([9.0, 0, 0], [9.0, 0, 2])))
    assert bars.sightings.tolist() == [4, 2]
    assert bars.segments.count.tolist() == [400, 200]


def test_bars_seen_often_enough_are_tied_where_they_meet():
    rng = np.random.default_rng(3)
    bars = built([*(frame(rng, share=0.9) for _ in range(40)), bars_of(([8, 0, 0], [8, 0, 1]))])
    structure = structure_of(bars)
    assert len(structure) == 4
    assert np.isnan(structure.width_m).all()
    assert (structure.sightings >= 20).all()
    assert (structure.sigma_m < 0.01).all()
    corners = np.unique(PORTAL.reshape(-1, 3), axis=0)
    assert len(structure.joint) == 3  # nothing else stands on the foot of the second post
    assert np.linalg.norm(structure.joint[:, None] - corners, axis=2).min(axis=1).max() < 0.03
    assert len(set(structure.pieces()[:, 2])) == 3


def test_an_empty_map_and_one_of_bars_seen_once_give_an_empty_structure_that_says_why():
    bars = SegmentMap(NARROW)
    assert structure_of(bars).reason
    bars.insert(bars_of(LEG))
    assert len(structure_of(bars)) == 0
    assert structure_of(bars).reason
