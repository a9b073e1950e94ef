import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from steelnb.core.errors import InputError
from steelnb.core.types import Segments, Trajectory
from steelnb.metrics import (
    position_error_m,
    score_gaps,
    score_segments,
    score_trajectory,
    seen_members,
)
from steelnb.simulation import build_tower
from steelnb.simulation.truth import SLICE_M, SliceCounter, Visibility
from tests.fusion.made import bars_of, random_bars, rigid, turned


def line(n, offset=0.0):
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = np.arange(n) * 0.1
    T[:, 1, 3] = offset
    return Trajectory(np.arange(n) * 0.2, T)


def test_trajectory_errors_are_not_aligned_and_use_the_stamps_of_the_estimate():
    truth = line(101)
    offset = np.linspace(0, 0.5, 101)[::2]
    T = truth.T_world_drone[::2].copy()
    T[:, 1, 3] += offset
    estimate = Trajectory(truth.stamp_s[::2], T)
    expected = {"ate_rmse_m": np.sqrt((offset**2).mean()), "error_mean_m": offset.mean(), "error_max_m": 0.5}
    expected |= {"error_final_m": 0.5, "rpe_rmse_m": 2 * 0.01}  # two scans of 0.4 s, 1 cm each
    assert score_trajectory(estimate, truth) == pytest.approx(expected)
    np.testing.assert_allclose(position_error_m(estimate, truth), offset)


def test_trajectory_errors_equal_evo():
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D
    from evo.core.units import Unit

    truth, rng = line(60), np.random.default_rng(0)
    T = truth.T_world_drone @ np.array([rigid(k) for k in range(60)])
    T[:, :3, 3] = truth.position + rng.normal(scale=0.1, size=(60, 3))
    pair = [PoseTrajectory3D(poses_se3=list(each), timestamps=truth.stamp_s) for each in (truth.T_world_drone, T)]
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    rpe = metrics.RPE(metrics.PoseRelation.translation_part, 5, Unit.frames, all_pairs=True)
    ape.process_data(pair)
    rpe.process_data(pair)
    score = score_trajectory(Trajectory(truth.stamp_s, T), truth)
    theirs = {f"error_{name}_m": ape.get_all_statistics()[name] for name in ("mean", "max")}
    theirs |= {"ate_rmse_m": ape.get_all_statistics()["rmse"], "rpe_rmse_m": rpe.get_all_statistics()["rmse"]}
    assert {name: score[name] for name in theirs} == pytest.approx(theirs, rel=1e-12)


AXES = np.array([([0, 0, 0], [0, 0, 4]), ([2, 0, 0], [2, 0, 4]), ([0, 0, 2], [2, 0, 2])], dtype=float)


def test_segment_scores_of_a_case_computed_by_hand():
    tilt = math.tan(math.radians(2))
    found = bars_of(
        ([0.03, 0, 0], [0.03, 0, 1.5]),  # on member 0, 3 cm off
        ([0, 0.04, 1.5], [0, 0.04, 3]),  # on member 0 too: together 75 % of it
        ([2, 0, 0], [2 + tilt, 0, 1]),  # on member 1 with 2°, but only a quarter of it
        ([0, 0.5, 2], [2, 0.5, 2]),  # run a metre off member 2
    )
    score = score_segments(found, AXES)
    assert score.right.tolist() == [True, True, True, False]
    assert score.recall == pytest.approx(1 / 3)
    assert score.precision == pytest.approx(3 / 4)
    assert np.degrees(score.angle_rad) == pytest.approx([0, 0, 2], abs=1e-6)
    assert score.offset_m[:2] == pytest.approx([0.03, 0.04], abs=1e-6)
    for kind in (bool, int, np.uint8):
        assert score_segments(found, AXES, observed=np.array([1, 0, 0]).astype(kind)).recall == 1.0


@pytest.mark.parametrize(
    ("tilt_deg", "low", "high", "right"),
    [(4.5, 1.6, 2.4, True), (5.5, 1.6, 2.4, False), (0, 3, 4.8, True), (0, 3, 5.4, False)],
)
def test_a_segment_is_right_up_to_five_degrees_and_with_half_its_length_on_the_member(tilt_deg, low, high, right):
    run = (high - low) / 2 * math.tan(math.radians(tilt_deg))
    assert score_segments(bars_of(([-run, 0, low], [run, 0, high])), AXES).right[0] == right


def test_a_segment_between_two_members_belongs_to_the_nearer():
    axes = np.array([([0, 0, 0], [0, 0, 2]), ([0.12, 0, 0], [0.12, 0, 2])], dtype=float)
    assert score_segments(bars_of(([0.08, 0, 0], [0.08, 0, 2])), axes, observed=np.array([False, True])).recall == 1.0


TOWER = build_tower()


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000))
def test_the_true_members_score_perfectly_in_any_frame_and_orientation(seed):
    T = rigid(seed)
    truth = bars_of(*TOWER.axes).transformed(T)
    score = score_segments(turned(truth, seed), np.stack([truth.start, truth.end], axis=1))
    assert (score.recall, score.precision, score.duplicates) == (1.0, 1.0, 0)
    assert score.offset_m.max() < 1e-6
    assert score.angle_rad.max() < 1e-6


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000), st.floats(0, 0.2))
def test_shifted_members_are_right_up_to_ten_centimetres(seed, shift_m):
    assume(abs(shift_m - 0.1) > 1e-9)  # where rounding decides
    bars = random_bars(seed, 6, reach_m=30.0)  # too far apart to be confused
    axes = np.stack([bars.start, bars.end], axis=1)
    aside = np.cross(bars.direction, np.random.default_rng(seed).normal(size=3))
    aside *= shift_m / np.linalg.norm(aside, axis=1)[:, None]
    score = score_segments(Segments(bars.start + aside, bars.end + aside, bars.count, bars.radius), axes)
    assert score.recall == score.precision == float(shift_m <= 0.1)
    np.testing.assert_allclose(score.offset_m, shift_m, atol=1e-6)


def test_an_empty_map_has_recall_zero():
    score = score_segments(Segments.empty(), AXES)
    assert score.recall == 0.0
    assert math.isnan(score.precision)
    assert len(score.offset_m) == 0


def test_duplicates_lie_beside_a_longer_segment_of_the_same_member():
    found = bars_of(
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


def test_hidden_parts_need_not_be_found():
    found = bars_of(([0, 0, 0], [0, 0, 1.2]))
    seen = np.ones((3, 200), dtype=bool)
    assert score_segments(found, AXES).recall == 0
    seen[0, 100:] = False  # of member 0, 2 m are seen, 1.2 m of them found
    assert score_segments(found, AXES, seen=seen).recall == pytest.approx(1 / 3)
    seen[1] = False  # a member of which nothing is seen is not found
    assert score_segments(found, AXES, seen=seen).recall == pytest.approx(1 / 3)


def test_the_axis_of_a_seen_member_runs_through_the_middle_of_its_surface():
    z = np.linspace(1, 3, 201)
    points = np.concatenate([np.column_stack([0 * z + 0.06, 0 * z, z]), [[2.05, 0.01, 1.0]]])
    points = points[(points[:, 2] < 1.5) | (points[:, 2] > 2.4) | (points[:, 0] > 1)]
    member = np.append(np.zeros(len(points) - 1, dtype=int), 1)
    seen = seen_members(AXES, points, member)
    np.testing.assert_allclose(seen.axes[0], [[0.06, 0, 1], [0.06, 0, 3]], atol=1e-9)
    np.testing.assert_allclose(seen.axes[1:], AXES[1:])
    assert seen.visibility.returns.tolist() == [len(points) - 1, 1, 0]
    # Slices from 1 m to 3 m, without those of the gap of 0.9 m.
    assert seen.visibility.length_m[0] == pytest.approx(1.1, abs=0.11)
    assert seen.visibility.length_m[1:].tolist() == [SLICE_M, 0]
    assert seen.observed().tolist() == [True, False, False]
    thin = seen_members(AXES, points[::5], member[::5])  # 22 returns
    assert thin.observed().tolist() == [False, False, False]
    # Parts of 1 cm; the 0.9 m without a point are hidden but for 5 cm at each side.
    assert seen.seen[0].sum() == pytest.approx(200 - 80, abs=2)
    assert not seen.seen[0, 60:130].any()
    assert not seen.seen[1:].any()


@pytest.mark.parametrize(
    ("each", "slices", "observed"), [(9, 11, False), (10, 10, True), (100, 5, False), (17, 6, True)]
)
def test_observed_requires_100_returns_and_30_cm(each, slices, observed):
    visibility = Visibility((np.full(slices, each), np.append(np.full(slices, each), np.zeros(40, int))))
    assert visibility.observed().tolist() == [observed] * 2
    assert visibility.observed(each * slices + 1).tolist() == [False] * 2


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_returns_are_counted_in_the_slices_of_their_members(seed):
    rng = np.random.default_rng(seed)
    bars = random_bars(seed, 5)
    member, share = rng.integers(0, 5, 300), rng.random(300)
    points = (bars.start + 0)[member] + share[:, None] * (bars.end - bars.start)[member]
    counter = SliceCounter(np.stack([bars.start, bars.end], axis=1))
    for some in np.array_split(np.arange(300), 4):  # scan by scan
        counter.add(points[some], member[some])
    for m, found in enumerate(counter.visibility().slices):
        size = math.ceil(bars.length[m] / SLICE_M - 1e-9)
        along = share[member == m] * bars.length[m]
        expected = np.histogram(along, np.arange(size + 1) * SLICE_M)[0]
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("epoch_s", [0.0, 1.7e9])
@pytest.mark.parametrize(
    "stamp_s",
    [
        np.arange(300) / 10, np.append(np.arange(300) / 10, 30.0 + np.arange(70)), np.arange(50) * 2.0,
        np.append(np.arange(300) / 10, 60.0 + np.arange(300) / 10), np.arange(30) * 5.0, np.array([0.0, 2.0]),
    ],
    ids=["10 Hz", "10 then 1 Hz", "0.5 Hz", "a gap", "0.2 Hz", "two poses"],
)  # fmt: skip
def test_the_relative_error_is_that_of_one_second_at_any_rate(stamp_s, epoch_s):
    def path(speed_m_s):
        T = np.tile(np.eye(4), (len(stamp_s), 1, 1))
        T[:, 0, 3] = speed_m_s * stamp_s
        return Trajectory(stamp_s + epoch_s, T)

    assert score_trajectory(path(0.31), path(0.30))["rpe_rmse_m"] == pytest.approx(0.010)


@pytest.mark.parametrize("epoch_s", [0.0, 1.7e9])
@pytest.mark.parametrize("off_s", [-0.05, 3600.0, 2e-6])
def test_stamps_of_another_clock_are_refused(off_s, epoch_s):
    path = line(40)
    truth = Trajectory(path.stamp_s + epoch_s, path.T_world_drone)
    with pytest.raises(InputError, match="no pose at"):
        score_trajectory(Trajectory(truth.stamp_s + off_s, path.T_world_drone), truth)


def test_a_flight_within_its_gaps_has_no_error_outside(recwarn):
    path = Trajectory(np.arange(5.0), np.tile(np.eye(4), (5, 1, 1)))
    assert all(np.isnan(value) for value in score_gaps(path, path, [(0.0, 10.0)]).values())
    assert not recwarn.list
