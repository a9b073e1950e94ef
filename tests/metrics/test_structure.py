import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.fusion import Structure
from steelnb.metrics.structure import Reference, reference, score_structure
from steelnb.settings import TowerSettings
from steelnb.simulation import build_tower
from steelnb.simulation.truth import SLICE_M, Visibility
from tests.fusion.made import structure_of_bars, turned

# A post of 4 m with joints at 0, 2 and 4 m, and a strut of 3 m from its middle.
JOINTS = np.array([[0, 0, 0], [0, 0, 2], [0, 0, 4], [3, 0, 2]], dtype=float)
AXES = JOINTS[[[0, 2], [1, 3]]]
ALONG = ((0, 1, 2), (1, 3))


def truth(observed=(True, True), joint_observed=(True, True, True, True)):
    slices = tuple(np.ones(round(length / SLICE_M), dtype=bool) for length in (4, 3))
    return Reference(AXES, JOINTS, ALONG, slices, np.array(observed), np.array(joint_observed))


def made(axes=AXES, joint=JOINTS, tie=((0, 0), (1, 0), (2, 0), (1, 1), (3, 1))):
    return structure_of_bars(axes, joint, tie)


def test_the_truth_is_perfect():
    metrics = score_structure(made(), truth()).metrics
    ones = ("recall", "precision", "joint_recall", "joint_precision", "edge_recall", "edge_precision")
    assert [metrics[name] for name in ones] == [1.0] * 6
    zeros = ("duplicates", "angle_p90_deg", "offset_p90_m", "end_p90_m", "joint_error_p90_m")
    assert [metrics[name] for name in zeros] == pytest.approx([0.0] * 5, abs=1e-6)


def test_offsets_ends_and_joint_errors_equal_the_applied_ones():
    shifted = AXES + np.array([0, 0.03, 0])
    shifted[0, 1, 2] -= 0.2  # the post ends 20 cm short
    metrics = score_structure(made(shifted, JOINTS + np.array([0, 0, 0.04])), truth()).metrics
    assert metrics["offset_median_m"] == pytest.approx(0.03)
    assert metrics["end_median_m"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["end_p90_m"] == pytest.approx(np.percentile([0, 0.2, 0, 0], 90))
    assert metrics["joint_error_median_m"] == pytest.approx(0.04)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_the_score_does_not_depend_on_the_order_or_orientation_of_bars_and_joints(seed):
    rng = np.random.default_rng(seed)
    structure = made(AXES + rng.normal(scale=0.02, size=AXES.shape), JOINTS + rng.normal(scale=0.02, size=(4, 3)))
    bar, joint, s = rng.permutation(2), rng.permutation(4), turned(structure.segments, seed)
    tie = np.stack([np.argsort(joint)[structure.tie[:, 0]], np.argsort(bar)[structure.tie[:, 1]]], axis=1)
    other = made(np.stack([s.start[bar], s.end[bar]], axis=1), structure.joint[joint], tie)
    score, expected = score_structure(other, truth()).metrics, score_structure(structure, truth()).metrics
    assert score == pytest.approx(expected, abs=1e-9)
    assert score["offset_p90_m"] > 0


def test_duplicates_wrong_bars_and_pieces():
    extra = np.concatenate([AXES, AXES[:1] + np.array([0.05, 0, 0]), [[[1, 1, 0], [1, 1, 3]]]])
    metrics = score_structure(made(extra), truth()).metrics
    assert (metrics["duplicates"], metrics["precision"], metrics["recall"]) == (1.0, 0.75, 1.0)
    short = AXES.copy()
    short[0, 1, 2] = 1.9  # less than half of the post
    for m, recall in enumerate((0.0, 1.0)):
        assert score_structure(made(short), truth(observed=np.arange(2) == m)).metrics["recall"] == recall


def test_only_observed_members_and_joints_count():
    only_post = made(AXES[:1], JOINTS[:3], [(0, 0), (1, 0), (2, 0)])
    assert score_structure(only_post, truth()).metrics["recall"] == 0.5
    metrics = score_structure(only_post, truth((True, False), (True, False, True, False))).metrics
    assert (metrics["recall"], metrics["joint_recall"]) == (1.0, 1.0)


def test_an_edge_that_skips_an_observed_joint_is_wrong():
    past = made(AXES[:1], JOINTS[[0, 2]], [(0, 0), (1, 0)])
    metrics = score_structure(past, truth()).metrics
    assert (metrics["edge_recall"], metrics["edge_precision"], metrics["joint_recall"]) == (0.0, 0.0, 0.5)
    metrics = score_structure(past, truth(joint_observed=(True, False, True, False))).metrics
    assert (metrics["edge_recall"], metrics["edge_precision"]) == (1.0, 1.0)


def test_an_empty_structure_has_recall_zero_and_no_precision():
    metrics = score_structure(Structure.empty(), truth()).metrics
    assert metrics["recall"] == metrics["joint_recall"] == metrics["edge_recall"] == 0.0
    assert np.isnan(metrics["precision"])
    assert np.isnan(metrics["offset_median_m"])


def test_the_centroid_of_a_thin_angle_is_a_quarter_of_its_flange_from_either_face():
    tower = build_tower(TowerSettings(sections_m={"leg": (0.1, 0.0001)}))
    lengths_m = np.linalg.norm(tower.axes[:, 1] - tower.axes[:, 0], axis=1)
    seen = Visibility(tuple(np.full(int(length_m / SLICE_M) + 1, 9) for length_m in lengths_m))
    found = reference(tower, seen)
    leg = next(m for m, member in enumerate(tower.members) if member.kind == "leg")
    shift_m = np.linalg.norm(found.axes[leg] - tower.axes[leg], axis=1)
    assert shift_m == pytest.approx(np.full(2, 0.025 * np.sqrt(2)), rel=2e-3)
    assert np.linalg.norm(found.joints - tower.joints, axis=1).max() < 0.1


def test_members_in_line_are_one_bar_of_the_reference_whichever_way_they_run():
    joints = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 1, 0], [1, -1, 0], [3, 0.2, 0]], dtype=float)
    along = ((0, 1), (2, 1), (3, 1), (1, 4), (2, 5))
    parts = tuple(np.full(20, k == 0) for k in range(5))
    found = Reference(joints[np.array(along)], joints, along, parts, np.arange(5) == 0, np.ones(6, bool)).joined()
    ends = {tuple(sorted((each[0], each[-1]))) for each in found.along}
    assert ends == {(0, 2), (3, 4), (2, 5)}
    long = next(k for k, each in enumerate(found.along) if 0 in each)
    assert found.observed.tolist() == [k == long for k in range(3)]
    assert found.slices[long].sum() == 20
    assert len(found.slices[long]) == 40
