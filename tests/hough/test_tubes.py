"""Bars as tubes that are denser than what surrounds them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from steelnb.hough import tubes
from steelnb.hough.tubes import find_tubes
from steelnb.metrics.segments import match_members
from tests.lattice import lattice, rods, scanned

LATTICE = lattice()


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 1000), st.floats(-math.pi, math.pi))
def test_a_lattice_is_found_wherever_it_stands_and_whatever_the_order_of_its_points(seed, yaw):
    rng, turn = np.random.default_rng(seed), Rotation.from_rotvec([0.1, 0.0, yaw])
    points = turn.apply(scanned(LATTICE, 60, 0.06, 0.01)) + rng.uniform(-50, 50, 3)
    shift = points.mean(axis=0) - turn.apply(scanned(LATTICE, 60, 0.06, 0.01)).mean(axis=0)
    bars = turn.apply(LATTICE.reshape(-1, 3)).reshape(-1, 2, 3) + shift
    found, gain = find_tubes(rng.permutation(points), 0.04).found()
    match = match_members(found, bars)
    assert match.right.mean() > 0.85  # before bars are extended to their joints
    assert len({*match.member[match.right]}) > 0.95 * len(bars)
    assert np.all(np.diff(gain) <= 0)
    assert gain.min() >= tubes.COST


@pytest.mark.parametrize("degrees", [8.0, 12.0])
@pytest.mark.parametrize("kind", ["crossing", "from one foot"])
def test_two_bars_at_a_small_angle_are_two(degrees, kind):
    half = math.radians(degrees / 2)
    aside = 2.0 if kind == "crossing" else 0.0
    bars = [
        ((-aside, -aside * math.tan(side), 3.0), (4.0 - aside, (4.0 - aside) * math.tan(side), 3.0))
        for side in (half, -half)
    ]
    points = rods(np.random.default_rng(0), *bars, radius_m=0.035)
    found, _ = find_tubes(points, 0.04).found()
    strongest = found.take(np.arange(2))
    axes = np.diff(np.array(bars), axis=1)[:, 0]
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    angle = np.degrees(np.arccos(np.clip(np.abs(strongest.direction @ axes.T), 0, 1)))
    assert sorted(angle.argmin(axis=1)) == [0, 1]
    assert angle.min(axis=1).max() < 1.0
    assert strongest.length.min() > 2.5


def test_gaps_are_bridged_where_the_bar_goes_on_and_ends_found_where_it_does_not():
    rng = np.random.default_rng(1)
    points = rods(rng, ((0.0, 0.0, 0.0), (3.0, 0.0, 0.0)), radius_m=0.02, per_m2=1000)
    with_gap = points[np.abs(points[:, 0] - 1.5) > 0.2]
    apart = np.concatenate([points, points + np.array([13.0, 0.0, 0.0])])
    assert find_tubes(with_gap, 0.04).found()[0].length == pytest.approx([3.0], abs=0.15)
    assert find_tubes(apart, 0.04).found()[0].length == pytest.approx([3.0, 3.0], abs=0.15)


@pytest.mark.parametrize("radius_m", [0.01, 0.04, 0.08])
def test_a_wide_bar_is_one_and_so_is_a_narrow_one(radius_m):
    found, _ = find_tubes(rods(np.random.default_rng(2), ((0, 0, 0), (0, 0, 4)), radius_m=radius_m), 0.04).found()
    assert found.length == pytest.approx([4.0], abs=0.1)
    assert np.abs(found.middle[0, :2]).max() < 0.01


def test_a_bar_gains_as_much_beside_others_and_less_with_points_around_it():
    rng = np.random.default_rng(3)
    bars = [((0.0, 0.0, 0.0), (0.0, 0.0, 4.0)), ((1.0, 0.0, 0.0), (1.0, 0.0, 4.0))]
    points = rods(rng, *bars, radius_m=0.03)
    search = find_tubes(points, 0.04)
    found, gain = search.found()
    again, each = search.gains_of(found)
    assert again == pytest.approx(gain, rel=0.1)
    among = np.concatenate([points, rng.uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 4.0], (20_000, 3))])
    fewer = find_tubes(among, 0.04).gains_of(found)[1]
    hidden = int(np.abs(found.middle[:, 0]).argmin())
    assert fewer[hidden] < 0.5 * each[hidden]
    assert fewer[1 - hidden] == pytest.approx(each[1 - hidden], rel=0.2)


@pytest.mark.parametrize("count", [0, 1, 4, 5, 30])
def test_few_points_and_equal_ones_have_no_bars(count):
    rng = np.random.default_rng(0)
    for points in (rng.uniform(0, 1, (count, 3)), np.ones((count, 3))):
        search = find_tubes(points, 0.04)
        found, gain = search.found()
        assert len(found) == len(gain) == len(search.gains_of(found)[0]) == 0


def test_kadane_s_stretch_is_the_best_of_all():
    rng = np.random.default_rng(4)
    for _ in range(50):
        gain = rng.normal(size=12)
        best, first, last = tubes.best_stretch(gain)
        sums = {(i, j): gain[i:j].sum() for i in range(12) for j in range(i, 13)}
        assert best == pytest.approx(max(0.0, *sums.values()))
        assert best == pytest.approx(gain[first:last].sum())


def test_sectors_are_sixteenths_of_a_turn():
    turn = np.radians(np.arange(0.3, 360.0))
    expected = np.floor(turn / (np.pi / 8)).astype(int)
    assert [tubes.sector_of(math.cos(a), math.sin(a)) for a in turn] == expected.tolist()
