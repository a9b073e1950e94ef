import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.config import FusionSettings
from steelnb.datatypes import Segments
from steelnb.fusion import SegmentMap
from steelnb.fusion.incremental import insert_batch, structure_of

NARROW = FusionSettings(angle_max_rad=math.radians(8), distance_max_m=0.1, gap_max_m=0.2, add_radii=False)
# A portal: two posts, a beam and a brace, which meet at four places.
BARS = np.array(
    [[[0, 0, 0], [0, 0, 4]], [[3, 0, 0], [3, 0, 4]], [[0, 0, 4], [3, 0, 4]], [[0, 0, 0], [3, 0, 4]]], dtype=float
)


def frame(rng, share=0.5):
    """Pieces of some of the bars, as a scan sees them: noisy, of any length, either end first."""
    pieces = []
    for start, end in BARS[rng.random(len(BARS)) < 0.8]:
        low = rng.uniform(0, 1 - share)
        ends = start + np.array([[low], [low + rng.uniform(0.4, 1) * share]]) * (end - start)
        pieces.append((ends + rng.normal(scale=0.005, size=(2, 3)))[:: rng.choice([-1, 1])])
    pieces = np.array(pieces).reshape(-1, 2, 3)
    return Segments(
        pieces[:, 0], pieces[:, 1], rng.integers(20, 200, len(pieces)), rng.uniform(0.005, 0.02, len(pieces))
    )


def built(frames, batch):
    bars = SegmentMap(NARROW)
    for k in range(0, len(frames), batch):
        insert_batch(bars, frames[k : k + batch])
    return bars


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.permutations(range(6)))
def test_the_order_of_frames_within_a_batch_changes_not_one_bit(seed, order):
    rng = np.random.default_rng(seed)
    before, batch = [frame(rng) for _ in range(4)], [frame(rng) for _ in range(6)]
    one, other = built(before, 4), built(before, 4)
    insert_batch(one, batch)
    insert_batch(other, [batch[k] for k in order])
    first, second = structure_of(one, 1), structure_of(other, 1)
    for name in ("start", "end", "count", "radius"):
        np.testing.assert_array_equal(getattr(first.segments, name), getattr(second.segments, name))
    for name in ("sightings", "sigma_m", "joint", "tie"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 12))
def test_moments_merge_exactly_however_the_frames_are_batched(seed, batch):
    # Whatever the grouping, a bar is the bar of all its points: their number, and the axis of their summed moments.
    rng = np.random.default_rng(seed)
    pieces = []
    for _ in range(12):
        low = rng.uniform(0, 2)
        ends = np.array([[0, 0, low], [0, 0, low + 2]]) + rng.normal(scale=0.004, size=(2, 3))
        pieces.append(Segments(ends[:1], ends[1:], rng.integers(20, 200, 1), np.full(1, 0.01)))
    whole, parts = built(pieces, 12), built(pieces, batch)
    assert len(whole) == len(parts) == 1
    assert whole.segments.count[0] == parts.segments.count[0] == sum(int(p.count[0]) for p in pieces)
    assert whole.sightings[0] == parts.sightings[0] == 12
    one, other = (bars.segments.direction[0] for bars in (whole, parts))
    np.testing.assert_allclose(np.cross(one, other), 0, atol=1e-12)
    apart = whole.segments.middle[0] - parts.segments.middle[0]
    np.testing.assert_allclose(apart - (apart @ one) * one, 0, atol=1e-9)
    assert whole.segments.radius[0] == pytest.approx(parts.segments.radius[0], rel=1e-12)


def test_bars_seen_often_enough_are_tied_where_they_meet():
    rng = np.random.default_rng(3)
    bars = built([frame(rng, share=0.9) for _ in range(40)], 4)
    insert_batch(bars, [Segments(np.array([[8.0, 0, 0]]), np.array([[8.0, 0, 1]]), np.array([30]), np.array([0.01]))])
    structure = structure_of(bars, sightings_min=5)
    assert len(structure) == 4
    assert np.isnan(structure.width_m).all()
    assert (structure.sightings >= 20).all()
    assert (structure.sigma_m < 0.01).all()
    corners = np.unique(BARS.reshape(-1, 3), axis=0)
    away = np.linalg.norm(structure.joint[:, None] - corners, axis=2).min(axis=1)
    assert len(structure.joint) == 3  # nothing else stands on the foot of the second post
    assert away.max() < 0.03
    edges = {bars for *_, bars in structure.graph().edges(data="bar")}
    assert len(edges) == 3


def test_an_empty_map_and_one_of_bars_seen_once_give_an_empty_structure_that_says_why():
    bars = SegmentMap(NARROW)
    insert_batch(bars, [])
    insert_batch(bars, [Segments.empty()])
    assert len(bars) == bars.inserts == 0
    assert structure_of(bars).reason == "none of 0 bars was seen 5 times"
    insert_batch(bars, [frame(np.random.default_rng(0))])
    assert len(structure_of(bars)) == 0
    assert "5 times" in structure_of(bars).reason


def test_pruning_drops_what_was_seen_seldom_and_long_ago():
    def bar(x):
        return Segments(np.array([[x, 0, 0]]), np.array([[x, 0, 2.0]]), np.array([50]), np.array([0.01]))

    bars = SegmentMap(NARROW)
    for x in (0.0, 0.0, 5.0, 0.0, 0.0, 9.0):
        bars.insert(bar(x))
    assert bars.prune(3, inserts=4) == 0  # the one at 5 m was seen three inserts ago
    assert bars.prune(3, inserts=3) == 1
    np.testing.assert_allclose(bars.segments.start[:, 0], [0, 9])
    assert bars.sightings.tolist() == [4, 1]
    bars.insert(bar(9.0))
    assert bars.sightings.tolist() == [4, 2]
    assert bars.segments.count.tolist() == [200, 100]
