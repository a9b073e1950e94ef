import numpy as np
import pytest

from steelnb.config import ExperimentSettings, StructureSettings
from steelnb.datatypes import Segments
from steelnb.errors import EmptyCloudError, SettingsError
from steelnb.experiment import simulate
from steelnb.fusion import sections
from steelnb.fusion.joints import find_joints, nearest_point, trim_bends
from steelnb.fusion.merging import combined, merge_pieces
from steelnb.fusion.reconstruct import reconstruct, reconstruct_cloud
from steelnb.fusion.section_fit import fit_sections
from steelnb.metrics.structure import reference, score_structure
from steelnb.simulation.visibility import see


def bars_of(*axes, count=100):
    axes = np.array(axes, dtype=float)
    return Segments(axes[:, 0], axes[:, 1], np.full(len(axes), count), np.full(len(axes), 0.01))


def tube(start, end, rng, spacing=0.004, sigma=0.012):
    start, end = np.array(start, float), np.array(end, float)
    share = rng.random((int(np.linalg.norm(end - start) / spacing), 1))
    return start + share * (end - start) + sigma * rng.standard_normal((len(share), 3))


CORNERS = ((0, 0, 0), (2, 0, 0), (0, 0, 3), (2, 0, 3))
FRAME = [(CORNERS[a], CORNERS[b]) for a, b in ((0, 2), (1, 3), (2, 3), (0, 3), (0, 1))]


def test_a_frame_comes_back_with_its_joints():
    rng = np.random.default_rng(3)
    structure = reconstruct_cloud(np.concatenate([tube(*bar, rng) for bar in FRAME]))
    assert len(structure) == 5
    assert structure.reason == ""
    assert len(structure.joint) == 4
    distance = np.linalg.norm(structure.joint[:, None] - np.array(CORNERS), axis=2).min(axis=0)
    assert distance.max() < 0.02
    assert structure.graph().number_of_edges() == 5
    again = reconstruct_cloud(np.concatenate([tube(*bar, np.random.default_rng(3)) for bar in FRAME[:1]]))
    assert len(again) == 1
    assert len(again.joint) == 0


@pytest.mark.parametrize("what", ["plane", "ball", "noise", "few"])
def test_a_cloud_without_lines_gives_an_empty_structure_and_says_so(what):
    rng = np.random.default_rng(1)
    sphere = rng.normal(size=(20000, 3))
    cloud = {
        "plane": np.column_stack([rng.uniform(-1, 1, (20000, 2)), rng.normal(0, 0.01, 20000)]),
        "ball": sphere / np.linalg.norm(sphere, axis=1)[:, None],
        "noise": rng.uniform(-1, 1, (8000, 3)),
        "few": rng.uniform(0, 0.1, (5, 3)),
    }[what]
    structure = reconstruct_cloud(cloud)
    assert len(structure) == 0
    assert len(structure.joint) == 0
    assert structure.reason


def test_bad_input_is_refused():
    with pytest.raises(EmptyCloudError, match="0 points"):
        reconstruct_cloud(np.zeros((0, 3)))
    with pytest.raises(EmptyCloudError, match="1 of them not finite"):
        reconstruct_cloud(np.array([[0, 0, 0], [0, np.nan, 0]]))
    with pytest.raises(SettingsError, match=r"expected \(N, 3\)"):
        reconstruct_cloud(np.zeros((4, 2)))
    with pytest.raises(EmptyCloudError, match="without a return"):
        reconstruct([], np.zeros((0, 4, 4)))
    with pytest.raises(SettingsError, match=r"expected \(0, 4, 4\)"):
        reconstruct([], np.zeros((1, 4, 4)))


def test_moments_of_pieces_are_those_of_the_whole():
    whole = bars_of([[0, 0, 0], [0, 3, 4]])
    cuts = [0, 0.1, 0.35, 0.36, 0.9, 1.0]
    pieces = Segments(
        *(np.array([[0, 3 * s, 4 * s] for s in side]) for side in (cuts[:-1], cuts[1:])),
        np.round(np.diff(cuts) * 100).astype(int), np.full(5, 0.01),
    )  # fmt: skip
    for order in ([0, 1, 2, 3, 4], [3, 0, 4, 2, 1]):
        mean, axis, count, radius = combined(pieces.take(np.array(order)))
        assert mean == pytest.approx([0, 1.5, 2.0])
        assert count == 100
        assert abs(axis @ whole.direction[0]) == pytest.approx(1.0)
        assert radius == pytest.approx(0.01)


def test_pieces_join_copies_go_and_neighbours_stay():
    piece_a, piece_b = [[0, 0, 0], [1, 0, 0]], [[1.2, 0.01, 0], [2, 0, 0]]
    copy, neighbour, turned = [[0.2, 0.06, 0], [0.8, 0.09, 0]], [[0, 0.3, 0], [2, 0.3, 0]], [[1, 0, 0], [1, 1, 0]]
    merged = merge_pieces(bars_of(piece_a, piece_b, copy, neighbour, turned), 0.3, 0.12, 0.06)
    assert sorted(np.round(merged.length, 1)) == [1.0, 2.0, 2.0]
    assert len(merge_pieces(Segments.empty(), 0.3, 0.12, 0.06)) == 0


def test_a_wide_bar_has_wide_copies_and_pieces():
    leg, copy, beside = [[0, 0, 0], [0, 0, 3]], [[0.13, 0, 0.5], [0.13, 0, 1.5]], [[0.3, 0, 0], [0.3, 0, 3]]
    piece = [[0.08, 0, 3.1], [0.08, 0, 5]]
    bars, width = bars_of(leg, beside, piece, copy), np.array([0.18, np.nan, 0.18, 0.1])
    assert len(merge_pieces(bars, 0.3, 0.12, 0.06)) == 4
    merged = merge_pieces(bars, 0.3, 0.12, 0.06, width)
    assert sorted(np.round(merged.length, 1)) == [3.0, 5.0]
    assert len(merge_pieces(bars.take(np.array([3, 1, 2, 0])), 0.3, 0.12, 0.06, width[[3, 1, 2, 0]])) == 2


def test_bars_are_led_to_what_they_meet_first():
    post, strut = [[0, 0, 0], [0, 0, 4]], [[0.15, 0, 1], [2, 0, 1]]
    beyond = [[-0.1, -1, 1.0], [-0.1, 1, 1.0]]  # the strut would reach this one behind the post, but for the post
    joint, tie, led = find_joints(bars_of(post, strut), np.full(2, 0.07), 0.02, 0.2, 0.15, 1.2)
    assert joint == pytest.approx(np.array([[0, 0, 1]]), abs=1e-6)
    assert sorted(map(tuple, tie.tolist())) == [(0, 0), (0, 1)]
    assert led.start[1] == pytest.approx([0, 0, 1], abs=1e-6)
    assert led.end[0] == pytest.approx([0, 0, 4])
    assert len(find_joints(bars_of(strut, beyond), np.full(2, 0.01), 0.0, 0.2, 0.15, 1.2)[0]) == 0


def test_bars_that_continue_each_other_end_at_the_bend():
    # Two bars at 6° to each other, each of which has grown 30 cm past the bend at the origin, or stops short of it.
    turned = np.array([np.sin(np.radians(6)), 0, np.cos(np.radians(6))])
    bars = trim_bends(bars_of([[0, 0, -3], [0, 0, 0.3]], [0.2 * turned, 3 * turned]), 1.2)
    assert bars.end[0] == pytest.approx([0, 0, 0], abs=1e-9)
    assert bars.start[1] == pytest.approx([0, 0, 0], abs=1e-9)


def test_the_nearest_point_of_lines():
    axes = np.array([[[0, 0, 0.01], [1, 0, 0.01]], [[0, 0, -0.01], [0, 1, -0.01]]])
    assert nearest_point(axes, np.zeros(3)) == pytest.approx([0, 0, 0], abs=1e-12)


@pytest.mark.parametrize("flange", [0.045, 0.07, 0.12])
@pytest.mark.parametrize("turn", [0.3, 2.0, 4.4])
def test_the_axis_of_an_angle_section_is_found_from_what_is_seen(flange, turn):
    # A bar along z, its centroid off the assumed axis, seen from three sides with range noise of 2 cm.
    rng, off = np.random.default_rng(5), np.array([0.012, -0.02])
    corner = sections.outlines(np.array([turn]), np.array([flange]))[0]
    direction, start, length = np.array([[0, 0, 1.0]]), np.zeros((1, 3)), np.array([2.0])
    across, histogram = sections.frames(direction), sections.empty_histogram(1)
    for view in np.radians([10, 80, 150]):
        towards = np.array([np.cos(view), np.sin(view)])
        for _ in range(4000):
            beside, t = rng.uniform(-0.15, 0.15), rng.uniform(0, 2)
            front, _ = sections.front_face(corner, *towards, beside)
            if front < -1:
                continue
            uv = off + (front + 0.02 * rng.standard_normal()) * towards + beside * np.array([-towards[1], towards[0]])
            point = uv @ across[0] + [0, 0, t]
            eye = point + 3.0 * towards @ across[0]
            sections.look(point[None], eye, np.zeros(1, int), start, direction, length, across, 0.05, histogram)
    centre, slope, found = np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((4, 1))
    fit_sections(histogram, length, centre, slope, *found)
    assert np.linalg.norm(centre[0] - off) < 0.005
    assert found[0, 0] == pytest.approx(flange, rel=0.12)
    assert np.abs(slope).max() < 0.006


@pytest.mark.slow
def test_a_flight_gives_right_bars_and_adjusting_undoes_a_drift():
    settings = ExperimentSettings.preset("orbit", "none", seed=11, duration_s=25.0, method="best")
    flight, truth = simulate(settings)
    poses = truth.trajectory.at(flight.scans.stamp_s).T_world_drone
    visible = reference(truth.tower, see(truth.tower, truth.trajectory, flight.T_drone_sensor, flight.scans))
    # Poses that slide away by 3 cm after the first five seconds.
    slid = poses.copy()
    drift = np.clip((np.arange(len(poses)) - 25) / len(poses), 0, 1)
    slid[:, :3, 3] += drift[:, None] * [0.02, -0.02, 0.015]
    metrics = {}
    for name, given, adjusting in (("true", poses, False), ("slid", slid, False), ("adjusted", slid, True)):
        structure = reconstruct(flight.scans, given, flight.T_drone_sensor, StructureSettings(adjust=adjusting))
        metrics[name] = score_structure(structure, visible).metrics
    assert metrics["true"]["precision"] > 0.9
    assert metrics["true"]["recall"] > 0.7
    assert metrics["true"]["offset_median_m"] < 0.006
    assert metrics["true"]["end_median_m"] < 0.03
    assert metrics["adjusted"]["offset_median_m"] < metrics["slid"]["offset_median_m"]
