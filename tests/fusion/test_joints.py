"""Pieces that become one bar, and joints where bars meet."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from steelnb.core.types import Segments
from steelnb.fusion import Structure, joints
from steelnb.fusion.bars import merge_pieces
from steelnb.fusion.joints import between_joints, find_joints, nearest_point, trim_bends
from tests.fusion.made import bars_of, distance_to_lines, random_bars, rigid, structure_of_bars, turned

SEEDS = st.integers(0, 10_000)


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.sets(st.integers(1, 7), min_size=1))
def test_the_pieces_of_a_bar_become_the_bar_in_any_order_and_frame(seed, cuts):
    rng = np.random.default_rng(seed)
    cuts = np.array([0, *sorted(cuts), 8]) / 8  # pieces of 0.6 m and more: shorter ones are copies
    bar = bars_of([[0, 0, 0], [0, 3, 4]]).transformed(rigid(seed))
    run = bar.end - bar.start
    share = np.diff(cuts)
    pieces = Segments(
        bar.start + cuts[:-1, None] * run, bar.start + cuts[1:, None] * run, np.round(1600 * share).astype(int),
        np.full(len(share), 0.01),
    )  # fmt: skip
    merged = merge_pieces(turned(pieces, seed).take(rng.permutation(len(share))))
    assert len(merged) == 1
    assert merged.count[0] == pieces.count.sum()
    ends = np.linalg.norm(np.concatenate([merged.start, merged.end]) - bar.start, axis=1)
    assert sorted(ends) == pytest.approx([0, 5], abs=1e-6)
    assert merged.radius[0] == pytest.approx(0.01)


def test_pieces_join_copies_go_and_neighbours_stay():
    piece_a, piece_b = [[0, 0, 0], [1, 0, 0]], [[1.2, 0.01, 0], [2, 0, 0]]
    copy, neighbour, across = [[0.2, 0.06, 0], [0.8, 0.09, 0]], [[0, 0.3, 0], [2, 0.3, 0]], [[1, 0, 0], [1, 1, 0]]
    merged = merge_pieces(bars_of(piece_a, piece_b, copy, neighbour, across))
    assert sorted(np.round(merged.length, 1)) == [1.0, 2.0, 2.0]
    assert len(merge_pieces(Segments.empty())) == 0


def test_a_wide_bar_has_wide_copies_and_pieces():
    leg, copy, beside = [[0, 0, 0], [0, 0, 3]], [[0.22, 0, 0.5], [0.22, 0, 1.5]], [[0.5, 0, 0], [0.5, 0, 3]]
    piece = [[0.13, 0, 3.1], [0.13, 0, 5]]
    bars, width = bars_of(leg, beside, piece, copy), np.array([0.3, np.nan, 0.3, 0.17])
    assert len(merge_pieces(bars)) == 4
    merged = merge_pieces(bars, width)
    assert sorted(np.round(merged.length, 1)) == [3.0, 5.0]
    assert len(merge_pieces(bars.take(np.array([3, 1, 2, 0])), width[[3, 1, 2, 0]])) == 2


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.floats(0.3, 3), st.floats(5, 14))
def test_a_bar_across_a_stronger_one_stays_if_it_rises_by_more_than_the_bound(seed, length, angle_deg):
    """At any position and heading: both pass through one point, the weaker one near the stronger over its length."""
    up = np.radians(angle_deg)
    rise = length * np.sin(up)
    assume(rise < 0.3 and abs(rise - 0.06) > 1e-6)
    half = 0.5 * length * np.array([np.cos(up), 0, np.sin(up)])
    bars = bars_of([[-2.5, 0, 0], [2.5, 0, 0]], np.array([-half, half])).transformed(rigid(seed))
    assert len(merge_pieces(bars, rise_m=0.06)) == 1 + (rise > 0.06)
    assert len(merge_pieces(bars)) == 1


def test_a_line_from_flange_to_flange_of_a_wide_leg_is_a_copy():
    leg, across = [[0, 0, 0], [0, 0, 5]], [[-0.05, 0, 1], [0.06, 0, 2]]
    bars, width = bars_of(leg, across), np.array([0.16, np.nan])
    assert len(merge_pieces(bars, rise_m=0.06)) == 2
    assert len(merge_pieces(bars, width, rise_m=0.06)) == 1


def test_a_bar_of_weak_direction_runs_from_joint_to_joint_if_it_is_tied_at_both_ends():
    posts = [[0, 0, 0], [0, 0, 2]], [[0.5, 0, 0], [0.5, 0, 2]]
    strut, loose = [[0.03, 0.02, 1], [0.45, -0.03, 1.04]], [[0.02, 0, 1.6], [0.3, 0, 1.6]]
    joint, tie, led = find_joints(bars_of(*posts, strut, loose), np.full(4, 0.06))
    straight = between_joints(led, joint, tie, np.array([True, False, True, True]))
    ends = joint[tie[tie[:, 1] == 2, 0]]
    assert len(ends) == 2
    np.testing.assert_allclose(np.sort([straight.start[2], straight.end[2]], axis=0), np.sort(ends, axis=0))
    for bar in (0, 1, 3):
        np.testing.assert_array_equal(straight.start[bar], led.start[bar])
        np.testing.assert_array_equal(straight.end[bar], led.end[bar])


def test_bars_are_extended_to_the_first_that_they_meet(monkeypatch):
    post, strut = [[0, 0, 0], [0, 0, 4]], [[0.15, 0, 1], [2, 0, 1]]
    beyond = [[-0.1, -1, 1.0], [-0.1, 1, 1.0]]  # the strut would reach this one behind the post, but for the post
    joint, tie, led = find_joints(bars_of(post, strut, beyond), np.full(3, 0.01))
    assert joint == pytest.approx(np.array([[0, 0, 1]]), abs=1e-6)
    assert sorted(map(tuple, tie.tolist())) == [(0, 0), (0, 1)]
    assert led.start[1] == pytest.approx([0, 0, 1], abs=1e-6)
    assert led.end[0] == pytest.approx([0, 0, 4])
    monkeypatch.setattr(joints, "SLACK_M", 0.0)
    assert len(find_joints(bars_of(strut, beyond), np.full(2, 0.01))[0]) == 0


def test_bars_whose_axes_cross_far_beyond_their_ends_are_not_tied():
    """Two bars at 11° that end 1.2 m before their crossing, close together: no joint in mid-air."""
    tip, up = np.zeros(3), np.radians([-5.5, 5.5])
    bars = bars_of(*[[tip + 1.2 * u, tip + 3.2 * u] for u in np.column_stack([np.cos(up), 0 * up, np.sin(up)])])
    assert bars.start[1, 2] - bars.start[0, 2] < 0.3
    joint, tie, led = find_joints(bars, np.full(2, 0.1))
    assert len(joint) == len(tie) == 0
    np.testing.assert_array_equal(led.start, bars.start)


def test_bars_that_continue_each_other_end_at_the_bend():
    # Two bars at 6° to each other, each of which has grown 30 cm past the bend at the origin, or stops short of it.
    up = np.array([np.sin(np.radians(6)), 0, np.cos(np.radians(6))])
    bars = trim_bends(bars_of([[0, 0, -3], [0, 0, 0.3]], [0.2 * up, 3 * up]))
    assert bars.end[0] == pytest.approx([0, 0, 0], abs=1e-9)
    assert bars.start[1] == pytest.approx([0, 0, 0], abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(2, 14))
def test_joints_lie_on_their_bars_in_any_frame(seed, n):
    """Random bars, as many again from the middle of one to near the middle of another: those meet."""
    rng = np.random.default_rng(seed)
    bars = random_bars(seed, n)
    some = rng.permutation(n)
    ends = np.stack([bars.middle, bars.middle[some]], axis=1) + rng.normal(scale=0.005, size=(n, 2, 3))
    bars = Segments.joined((bars, bars_of(*ends[some != np.arange(n)])))
    width = np.full(len(bars), 0.06)
    joint, tie, led = find_joints(bars, width)
    axes = np.stack([bars.start, bars.end], axis=1)
    assume(len(joint))
    # Every joint ties two bars at least. That of two lies between them; of more, which met less than `SAME_M` apart,
    # not further from each than that for every bar.
    ties = np.bincount(tie[:, 0], minlength=len(joint))[tie[:, 0]]
    assert (ties >= 2).all()
    apart = np.array([distance_to_lines(joint[j : j + 1], axes[b : b + 1])[0, 0] for j, b in tie])
    assert (apart <= np.where(ties == 2, 0.5 * (joints.SLACK_M + 0.06) + 1e-9, joints.SAME_M * ties)).all()
    along = ((joint[tie[:, 0]] - led.start[tie[:, 1]]) * led.direction[tie[:, 1]]).sum(axis=1)
    assert ((along >= -1e-9) & (along <= led.length[tie[:, 1]] + 1e-9)).all()
    reach = joints.LEAD_MAX_M + 2 * joints.SAME_M
    # Bars are extended or cut only along their axes, by a limited length.
    np.testing.assert_allclose(np.diag(distance_to_lines(led.start, axes)), 0, atol=1e-9)
    np.testing.assert_allclose(np.diag(distance_to_lines(led.end, axes)), 0, atol=1e-9)
    assert np.abs(led.length - bars.length).max() <= 2 * reach
    T = rigid(seed)
    moved, tie_too, _ = find_joints(bars.transformed(T), width)
    np.testing.assert_array_equal(tie_too, tie)
    np.testing.assert_allclose(moved, joint @ T[:3, :3].T + T[:3, 3], atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.integers(2, 6))
def test_the_nearest_point_is_where_lines_cross(seed, n):
    rng = np.random.default_rng(seed)
    at, direction = rng.uniform(-5, 5, 3), rng.normal(size=(n, 3))
    axes = np.stack([at - direction, at + rng.uniform(0.5, 2, (n, 1)) * direction], axis=1)
    assert nearest_point(axes, at) == pytest.approx(at, abs=1e-9)
    # Held to a point elsewhere with a hundredth of a line's weight, it moves towards that.
    away = rng.normal(size=3)
    held = nearest_point(axes, at + away) - at
    assert 0 < held @ away < away @ away


def test_there_is_a_piece_of_bar_between_neighbouring_joints():
    # A post with three joints, given out of order, and a strut that meets its middle one.
    joint = [[0, 0, 4], [0, 0, 0], [0, 0, 2], [3, 0, 2]]
    tie = [[0, 0], [1, 0], [2, 0], [2, 1], [3, 1]]
    structure = structure_of_bars([[[0, 0, 0], [0, 0, 4]], [[0, 0, 2], [3, 0, 2]]], joint, tie)
    assert structure.pieces().tolist() == [[1, 2, 0], [2, 0, 0], [2, 3, 1]]
    assert structure_of_bars([[[0, 0, 0], [0, 0, 1]]], [[0, 0, 0]], [[0, 0]]).pieces().shape == (0, 3)
    assert Structure.empty().pieces().shape == (0, 3)
