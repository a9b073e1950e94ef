import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.config import FusionSettings
from steelnb.datatypes import Segments
from steelnb.fusion import SegmentMap, associate, intersections

NARROW = FusionSettings(angle_max_rad=math.radians(5), distance_max_m=0.1, gap_max_m=0.2, add_radii=False)


def segments(*bars, count=50, radius=0.01):
    bars = np.array(bars, dtype=float).reshape(-1, 2, 3)
    counts = np.full(len(bars), count) if np.isscalar(count) else np.array(count)
    return Segments(bars[:, 0], bars[:, 1], counts, np.full(len(bars), radius))


LEG = ([0, 0, 0], [0, 0, 4])


@pytest.mark.parametrize(
    ("bar", "matches"),
    [
        (([0.09, 0, 1], [0.09, 0, 2]), True),
        (([0.11, 0, 1], [0.11, 0, 2]), False),
        (([0, 0.05, 2], [0, 0.05, 1]), True),  # the other way round
        (([0, 0, 4.15], [0, 0, 5]), True),  # a gap of 15 cm
        (([0, 0, 4.25], [0, 0, 5]), False),
        (([0, 0, 1], [math.tan(math.radians(4)), 0, 2]), True),
        (([0, 0, 1], [math.tan(math.radians(6)), 0, 2]), False),
        (([0, 0, -1], [0, 0, 5]), True),  # longer than what is known
        (([-0.5, 0, 2], [0.5, 0, 2]), False),
    ],
)
def test_a_bar_is_known_by_angle_distance_and_gap(bar, matches):
    assert (associate(segments(bar), segments(LEG), NARROW)[0] == 0) == matches


def test_the_nearest_of_two_bars_is_taken_and_radii_widen_the_gate():
    known = segments(LEG, ([0.15, 0, 0], [0.15, 0, 4]))
    new = segments(([0.09, 0, 1], [0.09, 0, 2]))
    assert associate(new, known, NARROW)[0] == 1
    far = segments(([0.33, 0, 1], [0.33, 0, 2]), radius=0.05)
    assert associate(far, known, NARROW)[0] == -1
    wide = Segments(known.start, known.end, known.count, np.full(2, 0.05))
    assert associate(far, wide, NARROW.but(add_radii=True))[0] == 1


def test_nothing_matches_nothing():
    assert len(associate(Segments.empty(), segments(LEG), NARROW)) == 0
    np.testing.assert_array_equal(associate(segments(LEG), Segments.empty(), NARROW), [-1])


def test_merging_is_weighted_by_point_counts():
    bars = SegmentMap(NARROW)
    bars.insert(segments(LEG, count=300))
    bars.insert(segments(([0.08, 0, 0], [0.08, 0, 4]), count=100))
    assert len(bars) == 1
    np.testing.assert_allclose(bars.segments.middle[0], [0.02, 0, 2], atol=1e-9)
    assert bars.segments.count[0] == 400
    assert bars.sightings[0] == 2


def test_a_bar_grows_along_its_axis():
    bars = SegmentMap(NARROW)
    for z in range(5):
        bars.insert(segments(([0, 0, z], [0, 0, z + 1.1])))
    assert len(bars) == 1
    assert sorted([bars.segments.start[0, 2], bars.segments.end[0, 2]]) == pytest.approx([0, 5.1])


def test_two_bars_that_grow_into_each_other_become_one():
    bars = SegmentMap(NARROW)
    bars.insert(segments(([0, 0, 0], [0, 0, 1]), ([0, 0, 3], [0, 0, 4]), ([5, 0, 0], [6, 0, 0])))
    assert len(bars) == 3
    target = bars.insert(segments(([0, 0, 0.9], [0, 0, 3.1])))
    assert len(bars) == 2
    assert target.tolist() == [0]
    assert bars.segments.length[0] == pytest.approx(4)
    assert bars.sightings.tolist() == [3, 1]
    assert bars.segments.count.tolist() == [150, 50]


@settings(max_examples=30, deadline=None)
@given(st.permutations(range(6)))
def test_the_axis_of_a_merged_bar_does_not_depend_on_the_order(order):
    rng = np.random.default_rng(0)
    pieces = [
        segments(
            ([*rng.normal(scale=0.01, size=2), z], [*rng.normal(scale=0.01, size=2), z + 2]), count=int(50 + 20 * z)
        )
        for z in np.linspace(0, 2, 6)
    ]
    bars = SegmentMap(NARROW)
    for k in order:
        bars.insert(pieces[k])
    reference = SegmentMap(NARROW)
    for piece in pieces:
        reference.insert(piece)
    assert len(bars) == len(reference) == 1
    assert abs(bars.segments.direction[0] @ reference.segments.direction[0]) > 1 - 1e-12
    apart = bars.segments.middle[0] - reference.segments.middle[0]
    assert np.linalg.norm(np.cross(apart, reference.segments.direction[0])) < 1e-9
    assert bars.segments.radius[0] == pytest.approx(reference.segments.radius[0])


def test_segments_handed_out_do_not_change_later():
    bars = SegmentMap(NARROW)
    bars.insert(segments(LEG))
    before = bars.segments
    end = before.end.copy()
    bars.insert(segments(([0.05, 0, 3], [0.05, 0, 6])))
    np.testing.assert_array_equal(before.end, end)


def test_intersections_are_the_closest_points_of_bars_that_cross():
    bars = segments(([-1, 0, 0], [1, 0, 0]), ([0, -1, 0.04], [0, 1, 0.04]), ([0.02, 5, 0], [0.02, 6, 0]), LEG)
    met = intersections(bars, 0.05)
    assert met.pair.tolist() == [[0, 1], [0, 3], [1, 3]]
    np.testing.assert_allclose(met.point[0], [0, 0, 0.02], atol=1e-12)
    np.testing.assert_allclose(met.distance, [0.04, 0, 0], atol=1e-12)
    assert len(intersections(bars, 0.03).pair) == 2


def test_intersections_reach_the_ends_of_segments_and_leave_parallels_out():
    tee = segments(([0, 0, 0], [1, 0, 0]), ([0.5, 0.03, 0], [0.5, 2, 0]))
    met = intersections(tee, 0.05)
    np.testing.assert_allclose(met.point, [[0.5, 0.015, 0]])
    assert len(intersections(segments(LEG, ([0.01, 0, 0], [0.01, 0, 4])), 0.05).pair) == 0


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000))
def test_intersection_distance_is_the_smallest_of_a_dense_search(seed):
    bars = segments(*np.random.default_rng(seed).uniform(-1, 1, (2, 2, 3)))
    share = np.linspace(0, 1, 400)[:, None]
    a, b = (bars.start[k] + share * (bars.end[k] - bars.start[k]) for k in (0, 1))
    searched = np.linalg.norm(a[:, None] - b, axis=2).min()
    met = intersections(bars, 10.0, parallel_cosine=2.0)
    assert met.distance[0] <= searched + 1e-12
    assert met.distance[0] == pytest.approx(searched, abs=0.01)
