import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.hough import cut_and_sort, detect_lines, detect_segments
from steelnb.hough.lines import default_dx
from steelnb.hough.near_segments import FREE_MIN
from steelnb.hough.segments import merge
from tests import naive
from tests.hough.made import ends_off_m, strip


def test_a_line_is_cut_at_gaps():
    points = np.concatenate([strip([0, 0, 0], [1, 0, 0], 100, seed=1), strip([1.5, 0, 0], [3, 0, 0], 150, seed=2)])
    together = detect_segments(points, 0.05, min_votes=20, gap_max=0.6)
    separate = detect_segments(points, 0.05, min_votes=20, gap_max=0.3)
    assert len(together) == 1
    np.testing.assert_allclose(sorted(separate.length), [1, 1.5], atol=0.05)
    np.testing.assert_array_equal(sorted(separate.count), [100, 150])


def test_lines_on_a_wall_do_not_stand_free_and_bars_before_it_do():
    rng = np.random.default_rng(3)
    wall = np.column_stack([2.0 + rng.normal(0, 0.01, 12_000), rng.uniform(-1.5, 1.5, (12_000, 2))])
    bars = [strip([1, y, -1.4], [1, y + 0.3, 1.4], 600, 0.01, seed) for seed, y in enumerate((-1.0, 0.0, 0.9))]
    sorting = {"dx": 0.07, "min_votes": 20, "pca_ratio_min": 0.98, "radius_max": 0.07, "max_lines": 60}
    assert len(detect_segments(wall, **sorting)) > 20
    assert len(detect_segments(wall, **sorting, free_min=FREE_MIN)) == 0
    found = detect_segments(np.concatenate([wall, *bars]), **sorting, free_min=FREE_MIN)
    assert len(found) == 3
    np.testing.assert_allclose(found.middle[:, 0], 1.0, atol=0.02)
    with pytest.raises(InputError, match=r"free_min = 1.5: expected a number from 0 to 1"):
        detect_segments(wall, free_min=1.5)


def test_ends_direction_and_radius_equal_those_of_the_bar():
    start, end = np.array([1.0, 2, 3]), np.array([1.5, 2.5, 5])
    found = detect_segments(strip(start, end, 2000, noise_m=0.01), 0.08, min_votes=500)
    assert len(found) == 1
    assert ends_off_m(found, np.array([[start, end]]))[0] < 0.03
    assert found.radius[0] == pytest.approx(0.01 * np.sqrt(2), rel=0.1)


@pytest.mark.parametrize(
    ("bounds", "kept"),
    [
        ({"pca_ratio_min": 0.99, "radius_max": 0.03, "density_min": 90.0, "length_min": 0.9}, 1),
        ({"pca_ratio_min": 0.9999999}, 0),
        ({"radius_max": 0.002}, 0),
        ({"density_min": 120.0}, 0),
        ({"length_min": 1.2}, 0),
    ],
)
def test_segments_outside_the_bounds_are_dropped(bounds, kept):
    points = strip([0, 0, 0], [0, 1, 0], 100)
    assert len(detect_segments(points, 0.05, min_votes=20, **bounds)) == kept


def test_parallel_segments_of_a_wide_bar_are_merged():
    points = strip([0, 0, 0], [2, 0, 0], 1500, wide_m=0.14)
    lines = detect_lines(points, 0.04, min_votes=60, skip_weak=True)
    assert len(cut_and_sort(points, lines, 0.16, 60, 0.98, np.inf, 0.0, 0.0)) >= 2
    found = cut_and_sort(points, lines, 0.16, 60, 0.98, np.inf, 0.0, 0.0, merge_distance=0.1)
    assert len(found) == 1
    assert abs(found.middle[0, 1]) < 0.01
    assert abs(found.direction[0, 0]) > np.cos(np.radians(0.5))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), turn=st.tuples(*[st.floats(-3, 3)] * 3), shift=st.tuples(*[st.floats(-20, 20)] * 3))
def test_merging_does_not_depend_on_the_pose_or_on_the_order_of_the_pieces(seed, turn, shift):
    rng = np.random.default_rng(seed)
    ends = rng.uniform(-0.4, 0.4, (6, 2, 3)) + np.array([[0, 0, 0], [2, 0, 0]])
    clouds = [strip(*each, 40 + k, seed=k) for k, each in enumerate(ends)]
    R = Rotation.from_rotvec(turn).as_matrix()
    groups = []
    for points, chosen in ((clouds, range(6)), ([c @ R.T + shift for c in clouds], rng.permutation(6))):
        first = np.concatenate([[0], np.cumsum([len(points[k]) for k in chosen])])
        p = np.concatenate([points[k] for k in chosen]).T.copy()
        piece = np.column_stack([first[:-1], first[1:]])
        order, rows = merge(*p, np.arange(p.shape[1]), piece, 0.15, 0.3)
        owner = np.repeat(np.array(chosen), np.diff(first))
        groups.append({frozenset(owner[order[a:b]].tolist()) for a, b in rows})
        expected = {frozenset(np.array(chosen)[list(g)].tolist()) for g in naive.merged(p.T, piece, 0.15, 0.3)}
        assert groups[-1] == expected
    assert groups[0] == groups[1]


@pytest.mark.parametrize(("spacing_m", "dx"), [(0.01, 0.07), (0.05, 0.07), (0.25, 0.3)])
def test_default_dx_follows_the_spacing_within_its_bounds(spacing_m, dx):
    grid = spacing_m * np.stack(np.meshgrid(*[np.arange(20)] * 3), axis=-1).reshape(-1, 3)
    assert default_dx(grid) == pytest.approx(dx)
    assert default_dx(np.array([[0.0, 0, 0], [0.1, 0, 0]])) == pytest.approx(0.05)  # half the diagonal


def test_lines_and_segments_use_the_same_default_dx():
    points = np.concatenate([strip([0, 0, 0], [2, 0, 0], 1500), strip([0, 0, 3], [0, 2, 3], 1500, seed=1)])
    chosen, given_dx = detect_segments(points, min_votes=30), detect_segments(points, default_dx(points), min_votes=30)
    np.testing.assert_array_equal(chosen.start, given_dx.start)
    np.testing.assert_array_equal(detect_lines(points).label, detect_lines(points, default_dx(points)).label)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), turn=st.tuples(*[st.floats(-3, 3)] * 3), shift=st.tuples(*[st.floats(-50, 50)] * 3))
def test_bars_and_their_ends_are_found_in_clutter_in_any_pose(seed, turn, shift):
    # Clutter behind an end lengthens a bar by one gap at most. The order of the points only affects rounding.
    rng = np.random.default_rng(seed)
    ends = np.array([[[0, 0, 0], [2, 0, 0]], [[0, 1, 0.3], [1, 1.2, 1.5]], [[1.5, -1, 0], [1.5, -0.8, 2]]], dtype=float)
    points = np.concatenate(
        [*(strip(*one, 300, 0.008, seed + k) for k, one in enumerate(ends)), rng.uniform(-1, 2, (60, 3))]
    )
    R = Rotation.from_rotvec(turn).as_matrix()
    placed, truth = points @ R.T + shift, ends @ R.T + shift
    arguments = {"dx": 0.06, "min_votes": 60, "gap_max": 0.12, "length_min": 0.5, "pca_ratio_min": 0.98}
    found = detect_segments(placed, **arguments)
    assert len(found) == 3
    assert ends_off_m(found, truth).max() < 0.12 + 0.03
    other = detect_segments(placed[rng.permutation(len(placed))], **arguments)
    np.testing.assert_allclose(other.start, found.start, atol=1e-9)
    np.testing.assert_array_equal(other.count, found.count)
