import numpy as np
import pytest

from steelnb.core.types import Scan, Segments
from steelnb.fusion import SegmentMap, associate
from steelnb.odometry import SegmentOdometry, segments, shared_segments
from steelnb.odometry.base import SPACING_M
from steelnb.odometry.segments import (
    average,
    bar_equations,
    least_squares,
    least_squares_yaw,
    shared_ends,
    shifted,
)
from steelnb.settings import OdometrySettings
from tests import naive

BARS = np.array(
    [
        ([0, 0, 0], [0, 0, 4]), ([3, 0, 0], [3, 0, 4]), ([0, 0, 1], [3, 0, 1]), ([0, 0, 3], [3, 0, 3.2]),
        ([0, 0, 1], [3, 0, 4]), ([0, 2, 2], [0, -2, 2.5]),
    ],
    dtype=float,
)  # fmt: skip


def seen(offset, bars=BARS, noise_m=0.0, seed=0):
    jitter = np.random.default_rng(seed).normal(scale=noise_m, size=bars.shape)
    shifted = bars + offset + jitter
    return Segments(shifted[:, 0], shifted[:, 1], np.full(len(bars), 60), np.full(len(bars), 0.01))


DRONE = np.array([-3.0, 1.0, 2.0])
"""Position of the drone, about which a yaw turns."""
SCALE_M = 0.05
FUSION = OdometrySettings.preset("average", "report-4cm").fusion


@pytest.fixture
def known():
    """Bars that were seen twice, as `bar_equations` asks for."""
    bars = SegmentMap(FUSION)
    bars.insert(seen(0))
    bars.insert(seen(0))
    return bars


@pytest.mark.parametrize("offset", [[0.05, 0, 0], [0, -0.08, 0], [0, 0, 0.06], [0.05, -0.06, 0.04]])
def test_least_squares_finds_the_translation(known, offset, monkeypatch):
    monkeypatch.setattr(segments, "DAMPING_PAIRS", 0.0)
    state, matches = least_squares(seen(offset), known, SCALE_M, DRONE)
    np.testing.assert_allclose(state, [0, *-np.array(offset)], atol=1e-3)
    assert matches == len(BARS)
    one_moved = seen(offset)
    one_moved.start[4] += [0, 0.15, 0]
    one_moved.end[4] += [0, 0.15, 0]
    robust = least_squares(one_moved, known, SCALE_M, DRONE)[0]
    np.testing.assert_allclose(robust[1:], -np.array(offset), atol=0.01)


def test_least_squares_leaves_a_direction_that_no_bar_constrains(known, monkeypatch):
    upright = seen([0.05, 0.04, 0.07], BARS[:2])
    (_, x, _, z), _ = least_squares(upright, known, SCALE_M, DRONE)
    assert abs(z) < 1e-9
    assert -0.05 < x < -0.02  # damping holds back
    monkeypatch.setattr(segments, "DAMPING_PAIRS", 1e-6)
    np.testing.assert_allclose(
        least_squares(upright, known, SCALE_M, DRONE)[0], [0, -0.05, -0.04, 0], atol=2e-3
    )  # fmt: skip


@pytest.mark.parametrize(("yaw", "offset"), [(0.02, [0, 0, 0]), (-0.015, [0.03, -0.04, 0.02]), (0, [0, 0.05, 0])])
def test_yaw_and_translation_are_found_together(known, yaw, offset, monkeypatch):
    monkeypatch.setattr(segments, "ITERATIONS_MAX", 60)
    monkeypatch.setattr(segments, "TOLERANCE_M", 1e-9)
    monkeypatch.setattr(segments, "PRIOR", np.zeros(4))
    away = shifted(seen(0), np.append(yaw, offset), DRONE)
    state, _ = least_squares_yaw(away, known, SCALE_M, DRONE)
    back = shifted(away, state, DRONE)
    assert state[0] == pytest.approx(-yaw, abs=1e-6)
    np.testing.assert_allclose(back.start, BARS[:, 0], atol=1e-5)
    np.testing.assert_allclose(back.end, BARS[:, 1], atol=1e-5)


def test_bar_equations_are_those_of_the_definition_and_the_derivatives_of_its_loss(known):
    def by_definition(seen):
        bars = known.segments.take(associate(seen, known.segments, known.settings))
        information = 0.5 * seen.count / (seen.radius**2 + segments.SIGMA_FLOOR_M**2)
        return naive.bar_equations(shared_ends(seen, bars), bars.start, bars.direction, information, DRONE, SCALE_M)

    apart, step = seen([0.03, -0.02, 0.01], noise_m=0.01), 1e-6
    H, b, matches = bar_equations(apart, known, SCALE_M, DRONE)
    _, H_defined, b_defined = by_definition(apart)
    assert matches == len(apart)
    np.testing.assert_allclose(H, H_defined, atol=1e-9 * H.max())
    np.testing.assert_allclose(b, b_defined, atol=1e-9 * np.abs(b).max())
    for k, axis in enumerate(np.eye(4)):
        ahead, behind = (by_definition(shifted(apart, sign * step * axis, DRONE))[0] for sign in (1, -1))
        slack = 1e-3 * np.abs(b).max()  # the ends shared slide a little
        assert (ahead - behind) / (2 * step) == pytest.approx(b[k], abs=slack)


def test_a_prior_holds_what_no_bar_constrains_and_a_new_bar_waits(known):
    upright = seen([0.05, 0.04, 0.07], BARS[:2])
    state, _ = least_squares_yaw(upright, known, SCALE_M, DRONE)
    assert abs(state[3]) < 1e-9
    np.testing.assert_allclose(state[1:3], [-0.05, -0.04], atol=5e-3)
    new = SegmentMap(FUSION)
    new.insert(seen(0))
    assert least_squares_yaw(upright, new, SCALE_M, DRONE)[1] == 0


def test_shared_ends_lie_where_both_are():
    bar = Segments(np.zeros((1, 3)), np.array([[4.0, 0, 0]]), np.array([9]), np.array([0.01]))
    for start, end, expected in [(-1, 2, (0, 2)), (3, 6, (3, 4)), (3, 1, (3, 1)), (5, 6, (5, 5))]:
        piece = Segments(np.array([[start, 0.1, 0]]), np.array([[end, 0.1, 0]]), np.array([9]), np.array([0.01]))
        assert tuple(shared_ends(piece, bar)[0, :, 0]) == pytest.approx(expected)


def test_average_is_the_mean_of_the_offsets_across_times_the_gain(known):
    # Two upright bars and four others: the upright ones do not observe a shift along z, so the mean is too small.
    state, _ = average(seen([0, 0, 0.06]), known, SCALE_M, DRONE)
    d = (BARS[:, 1] - BARS[:, 0]) / np.linalg.norm(BARS[:, 1] - BARS[:, 0], axis=1)[:, None]
    across = np.array([0, 0, 0.06]) - d * (d[:, 2:] * 0.06)
    np.testing.assert_allclose(state, [0, *-0.5 * across.mean(axis=0)], atol=1e-9)
    assert abs(state[3]) < 0.5 * 0.06 * 0.75


@pytest.mark.parametrize("rule", [average, least_squares, least_squares_yaw])
def test_no_match_gives_no_correction(known, rule):
    state, matches = rule(seen([0.8, 0.8, 0.8], BARS[:1]), known, SCALE_M, DRONE)
    assert matches == 0
    np.testing.assert_array_equal(state, 0)


def frame(seed=0):
    """A scan of the bars from 2.5 m, sensor at the origin looking along x."""
    rng = np.random.default_rng(seed)
    pieces = [b[0] + rng.uniform(0, 1, (250, 1)) * (b[1] - b[0]) for b in BARS[:5]]
    points = np.concatenate(pieces)[:, [1, 0, 2]] + [2.5, -1.5, -1.0]
    return points + rng.normal(scale=0.005, size=points.shape)


def odometry(correction="least_squares"):
    return SegmentOdometry(OdometrySettings.preset(correction))


def pose(x=0.0, y=0.0, z=2.0):
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


@pytest.mark.parametrize(("correction", "bound_m"), [("average", 0.12), ("least_squares", 0.03)])
def test_the_odometry_pulls_a_drifting_pose_back(correction, bound_m):
    # The drone hovers; its prior drifts 1.1 cm a scan, 21 cm in all. Scans come as bare arrays and as images.
    run = odometry(correction)
    for k in range(20):
        step = run.update(frame(k).reshape(50, 25, 3) if k % 2 else frame(k), pose(y=0.01 * k, z=2 + 0.005 * k))
        assert step.used == (k > 0)
    error = np.linalg.norm(step.T_world_drone[:3, 3] - [0, 0, 2])
    assert error < bound_m
    assert step.matches >= 4
    assert set(step.seconds) == {"preprocess", "hough", "match", "map"}
    np.testing.assert_array_equal(step.T_world_drone[:3, :3], np.eye(3))


def test_without_correction_the_prior_comes_back():
    run = odometry("none")
    for k in range(3):
        step = run.update(Scan(0.2 * k, frame(k)), pose(y=0.02 * k))
        np.testing.assert_array_equal(step.T_world_drone, pose(y=0.02 * k))
        assert (step.used, step.stamp_s) == (False, 0.2 * k)


def test_losing_sight_keeps_the_correction_and_says_so():
    run = odometry()
    assert run.update(frame(0), pose()).reason == "first scan"
    held = run.update(frame(1), pose(y=0.05)).T_world_drone[:3, 3] - pose(y=0.05)[:3, 3]
    for blind in (np.full((4, 4, 3), np.nan), np.zeros((0, 3)), np.ones((30, 3)), frame(2)[:10]):
        step = run.update(blind, pose(y=0.06))
        assert not step.used
        assert step.reason == "no segment seen"
        np.testing.assert_allclose(step.T_world_drone[:3, 3] - pose(y=0.06)[:3, 3], held)
    assert run.update(frame(1), pose(x=30)).reason == "no segment of the map seen"
    again = run.update(frame(3), pose(y=0.1))
    assert again.used
    assert np.linalg.norm(again.T_world_drone[:3, 3] - [0, 0, 2]) < 0.035


def test_map_points_lie_on_the_bars():
    run = odometry()
    assert run.map_points().shape == (0, 3)
    run.update(frame(0), pose())
    points = run.map_points()
    bars = run.map.segments
    assert len(points) >= bars.length.sum() / SPACING_M
    apart = points[:, None] - bars.start
    along = (apart * bars.direction).sum(axis=2, keepdims=True) * bars.direction
    assert np.linalg.norm(apart - along, axis=2).min(axis=1).max() < 1e-9


def test_methods_that_share_segments_find_them_once_and_end_the_same(monkeypatch):
    def fly(method):
        run = odometry(method)
        steps = [run.update(frame(k), pose(y=0.01 * k)) for k in range(5)]
        return [step.T_world_drone for step in steps], [step.seconds["hough"] for step in steps]

    alone = {method: fly(method)[0] for method in ("average", "least_squares")}
    calls, found = [], segments.segments_in
    monkeypatch.setattr(segments, "segments_in", lambda *given: calls.append(1) or found(*given))
    with shared_segments():
        shared = {method: fly(method) for method in alone}
    assert len(calls) == 5  # no point lies by the floor, so both crop alike
    for method, poses in alone.items():
        np.testing.assert_array_equal(shared[method][0], poses)
    assert shared["average"][1] == shared["least_squares"][1]
