import math

import numpy as np
import pytest

from steelnb.datatypes import Segments, Trajectory
from steelnb.metrics import position_error_m, score_segments, score_trajectory, seen_members


def line(n, offset=0.0):
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = np.arange(n) * 0.1
    T[:, 1, 3] = offset
    return Trajectory(np.arange(n) * 0.2, T)


def test_trajectory_errors_are_unaligned_and_at_the_stamps_of_the_estimate():
    truth = line(101)
    offset = np.linspace(0, 0.5, 101)[::2]
    T = truth.T_world_drone[::2].copy()
    T[:, 1, 3] += offset
    estimate = Trajectory(truth.stamp_s[::2], T)
    score = score_trajectory(estimate, truth, rpe_delta_s=4.0)
    assert score["ate_rmse_m"] == pytest.approx(np.sqrt((offset**2).mean()))
    assert score["error_mean_m"] == pytest.approx(offset.mean())
    assert score["error_max_m"] == pytest.approx(0.5)
    assert score["error_final_m"] == pytest.approx(0.5)
    assert score["rpe_rmse_m"] == pytest.approx(10 * 0.01)  # ten scans of 0.4 s, 1 cm each
    np.testing.assert_allclose(position_error_m(estimate, truth), offset)


def test_stamps_that_the_truth_does_not_have_are_refused():
    estimate = Trajectory(np.array([0.0, 0.31]), line(2).T_world_drone)
    with pytest.raises(ValueError, match="stamps"):
        score_trajectory(estimate, line(10))


AXES = np.array([([0, 0, 0], [0, 0, 4]), ([2, 0, 0], [2, 0, 4]), ([0, 0, 2], [2, 0, 2])], dtype=float)


def segments(*bars):
    bars = np.array(bars, dtype=float)
    return Segments(bars[:, 0], bars[:, 1], np.full(len(bars), 50), np.full(len(bars), 0.01))


def test_segment_scores_of_a_case_worked_by_hand():
    tilt = math.tan(math.radians(2))
    found = segments(
        ([0.03, 0, 0], [0.03, 0, 1.5]),  # on member 0, 3 cm off
        ([0, 0.04, 1.5], [0, 0.04, 3]),  # on member 0 too: together 75 % of it
        ([2, 0, 0], [2 + tilt, 0, 1]),  # on member 1 with 2°, but only a quarter of it
        ([0, 0.5, 2], [2, 0.5, 2]),  # half a metre off member 2
    )
    score = score_segments(found, AXES)
    assert score.found.tolist() == [True, False, False]
    assert score.right.tolist() == [True, True, True, False]
    assert score.recall == pytest.approx(1 / 3)
    assert score.precision == pytest.approx(3 / 4)
    assert math.degrees(score.angle_median_rad) == pytest.approx(0, abs=1e-6)
    assert score.offset_median_m == pytest.approx(0.03, abs=1e-6)
    assert score_segments(found, AXES, observed=np.array([True, False, False])).recall == 1.0


@pytest.mark.parametrize(("tilt_deg", "right"), [(4.5, True), (5.5, False)])
def test_a_segment_tilted_too_far_is_wrong(tilt_deg, right):
    half = 0.4 * math.tan(math.radians(tilt_deg))
    assert score_segments(segments(([-half, 0, 1.6], [half, 0, 2.4])), AXES).right[0] == right


@pytest.mark.parametrize(("beyond_m", "right"), [(0.8, True), (1.4, False)])
def test_a_segment_must_lie_on_the_member_for_half_its_length(beyond_m, right):
    assert score_segments(segments(([0, 0, 3], [0, 0, 4 + beyond_m])), AXES).right[0] == right


def test_of_two_members_side_by_side_the_nearer_is_meant():
    axes = np.array([([0, 0, 0], [0, 0, 2]), ([0.12, 0, 0], [0.12, 0, 2])], dtype=float)
    assert score_segments(segments(([0.08, 0, 0], [0.08, 0, 2])), axes).found.tolist() == [False, True]


def test_an_empty_map_scores_nothing_found():
    score = score_segments(Segments.empty(), AXES)
    assert score.recall == 0.0
    assert math.isnan(score.precision)
    assert math.isnan(score.offset_median_m)


def test_duplicates_lie_beside_a_longer_segment_of_the_same_member():
    found = segments(
        ([0, 0.02, 0], [0, 0.02, 3]),
        ([0, -0.05, 1], [0, -0.05, 2]),  # beside the first
        ([0, 0, 2.8], [0, 0, 3.9]),  # mostly beyond it
        ([2, 0, 0], [2, 0, 1]),  # on another member
        ([0, 0.5, 0], [0, 0.5, 3]),  # wrong
    )
    score = score_segments(found, AXES)
    assert score.right.tolist() == [True, True, True, True, False]
    assert score.duplicates == 1
    np.testing.assert_allclose(score.offset_m, [0.02, 0.05, 0, 0], atol=1e-9)
    np.testing.assert_allclose(score.angle_rad, 0, atol=1e-7)


def test_what_is_hidden_need_not_be_found():
    found = segments(([0, 0, 0], [0, 0, 1.2]))
    seen = np.ones((3, 200), dtype=bool)
    assert not score_segments(found, AXES).found[0]
    seen[0, 100:] = False  # of member 0, 2 m are seen, 1.2 m of them found
    assert score_segments(found, AXES, seen=seen).found.tolist() == [True, False, False]
    seen[1] = False
    assert not score_segments(found, AXES, seen=seen).found[1]


def test_the_axis_of_a_seen_member_runs_through_the_middle_of_its_surface():
    z = np.linspace(1, 3, 201)
    points = np.concatenate([np.column_stack([0 * z + 0.06, 0 * z, z]), [[2.05, 0.01, 1.0]]])
    points = points[(points[:, 2] < 1.5) | (points[:, 2] > 2.4) | (points[:, 0] > 1)]
    member = np.append(np.zeros(len(points) - 1, dtype=int), 1)
    seen = seen_members(AXES, points, member)
    np.testing.assert_allclose(seen.axes[0], [[0.06, 0, 1], [0.06, 0, 3]], atol=1e-9)
    np.testing.assert_allclose(seen.axes[1:], AXES[1:])
    assert seen.count.tolist() == [len(points) - 1, 1, 0]
    np.testing.assert_allclose(seen.length_m, [2, 0, 0], atol=1e-9)
    assert seen.observed().tolist() == [True, False, False]
    assert seen.observed(count_min=1000).tolist() == [False, False, False]
    # Parts of 1 cm; the 0.9 m without a point are hidden but for 5 cm at each side.
    assert seen.seen[0].sum() == pytest.approx(200 - 80, abs=2)
    assert not seen.seen[0, 60:130].any()
    assert not seen.seen[1:].any()
