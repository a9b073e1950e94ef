"""The report's programs as they were."""

import copy

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from steelnb.core.types import Scan, Segments
from steelnb.odometry import ReportCloudOdometry, ReportSegmentOdometry, make_odometry, report_segments, shared_segments
from steelnb.points.covariances import neighbour_covariances, regularised
from steelnb.points.kdtree import build_kdtree
from steelnb.registration import Aligned, Target, gicp_as_pcl, icp_as_pcl, pcl
from steelnb.settings import OdometrySettings
from tests import naive

CLOUDS = ("report-icp", "report-icp-3dof", "report-gicp")


def corner(count=3000, seed=0, sigma_m=0.005):
    """Points of three walls in front of the sensor, ``(N, 3)`` in its frame, metres."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-1.2, 1.2, (2, count))
    wall = np.arange(count) % 3
    points = np.where(
        (wall == 0)[:, None], np.stack([np.full(count, 2.5), u, v], axis=1),
        np.where((wall == 1)[:, None], np.stack([2.0 + 0.4 * u, np.full(count, 1.2), v], axis=1),
                 np.stack([2.0 + 0.4 * u, v, np.full(count, -1.2)], axis=1)),
    )  # fmt: skip
    return points + rng.normal(0, sigma_m, points.shape)


def pose(position=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), position
    return T


def clouds(method="report-gicp", *switched, T_drone_sensor=None):
    settings = OdometrySettings.preset(method, "report", {"switched": switched})
    return ReportCloudOdometry(settings, T_drone_sensor)


def told(odometry, step, **other):
    """Make an odometry find the given step for every scan."""
    fields = {"converged": True, "iterations": 1, "inliers": 100, **other}
    odometry.registered = lambda points: Aligned(step, **fields)


@pytest.mark.parametrize(
    ("method", "switched"),
    [*((method, ()) for method in CLOUDS), ("report-gicp", ("solver",)), ("report-gicp", ("covariances",))],
)
def test_the_correction_is_small_without_drift_and_pulls_a_shifted_prior_back(method, switched):
    odometry, shifted = clouds(method, *switched), pose((0.03, -0.02, 0.02))
    for k in range(3):
        odometry.update(corner(seed=k), pose())
    pulled = copy.deepcopy(odometry).update(corner(seed=9), shifted)
    assert np.linalg.norm(pulled.T_world_drone[:3, 3]) < 0.5 * np.linalg.norm(shifted[:3, 3])
    for k in range(3, 6):
        assert odometry.update(corner(seed=k), pose()).used
    np.testing.assert_allclose(odometry.correction, np.eye(4), atol=0.02)


def test_the_order_of_composition_matters_for_a_rotated_correction():
    first, second = pose((0.1, 0.0, 0.0), (0, 0, 0.2)), pose((0.0, 0.2, 0.0), (0, 0.1, 0))
    for switched, expected in (((), first @ second), (("order",), second @ first)):
        odometry = clouds("report-gicp", *switched)
        odometry.update(corner(), pose())
        for motion in (first, second):
            told(odometry, motion)
            odometry.update(corner(), pose())
        np.testing.assert_allclose(odometry.correction, expected, atol=1e-12)
    assert np.abs(first @ second - second @ first).max() > 0.01


@pytest.mark.parametrize(
    ("step", "reason"),
    [(pose((1.01, 0, 0)), "jump"), (pose(turn=(0, 0, 0.4)), "turn"), (np.eye(4), "too few pairs"),
     (pose((0.99, 0, 0), (0, 0, 0.39)), "")],
)  # fmt: skip
def test_a_step_beyond_a_gate_does_not_change_correction_and_map(step, reason):
    odometry = clouds()
    odometry.update(corner(), pose())
    told(odometry, pose((0.1, 0.0, 0.0)))
    odometry.update(corner(seed=1), pose())
    correction, points, open_gates = odometry.correction.copy(), odometry.map_points(), copy.deepcopy(odometry)
    told(odometry, step, converged=reason != "too few pairs")
    found = odometry.update(corner(seed=2), pose())
    assert found.used == (reason == "")
    assert reason in found.reason
    if reason:
        np.testing.assert_array_equal(odometry.correction, correction)
        np.testing.assert_array_equal(odometry.map_points(), points)
        np.testing.assert_array_equal(found.T_world_drone, correction)
    open_gates.switched = ("gates",)
    told(open_gates, step)
    assert open_gates.update(corner(seed=2), pose()).used


def test_three_dof_drops_the_rotation_but_maps_the_turned_cloud():
    odometry, motion = clouds("report-icp-3dof"), pose((0.05, 0.0, 0.1), (0.0, 0.1, 0.0))
    odometry.update(corner(), pose())
    told(odometry, motion)
    step = odometry.update(corner(seed=1), pose())
    np.testing.assert_array_equal(odometry.correction[:3, :3], np.eye(3))
    np.testing.assert_allclose(step.T_world_drone[:3, 3], motion[:3, 3], atol=1e-12)
    turned = corner(seed=1) @ motion[:3, :3].T + motion[:3, 3]
    expected = naive.voxel_grid(np.concatenate([corner(), turned]), 0.1)
    assert cKDTree(odometry.map_points()).query(expected)[0].max() < 1e-9


def test_an_old_voxel_has_the_weight_of_one_point():
    odometry = clouds()
    odometry.update(corner(), pose())
    told(odometry, np.eye(4))
    expected = corner()
    for seed in (1, 2):
        odometry.update(corner(seed=seed), pose())
        expected = naive.voxel_grid(np.concatenate([expected, corner(seed=seed)]), 0.1)
        assert len(odometry.map_points()) == len(expected)
        assert cKDTree(odometry.map_points()).query(expected)[0].max() < 1e-9


def test_placed_points_respect_box_floor_thinning_and_mount():
    points = np.array([[2.0, 0, 0], [2.01, 0, 0], [-0.2, 0, 0], [4.1, 0, 0], [2, 3.1, 0], [2, 0, -3.1], [np.nan] * 3])
    prior, mount = pose((0.0, 0.0, 0.2)), pose((0.07, 0.0, 0.04))
    placed = {}
    for switched in ((), ("thinning",), ("floor",), ("mount",)):
        odometry = clouds("report-gicp", *switched, T_drone_sensor=mount)
        odometry.update(points, prior)
        placed["".join(switched)] = odometry.map_points()
    np.testing.assert_allclose(placed[""], points[:2] + prior[:3, 3])
    np.testing.assert_allclose(placed["thinning"], [points[:2].mean(axis=0) + prior[:3, 3]])
    np.testing.assert_allclose(placed["mount"], points[:2] + prior[:3, 3] + mount[:3, 3])
    assert not len(placed["floor"])


def test_icp_stops_at_a_step_below_the_root_of_epsilon():
    # PCL compares epsilon with the squared step, so 1e-3 accepts the 3 cm that remain here after one step.
    target = Target(build_kdtree(corner(seed=1)))
    source = corner(seed=1) + np.array([0.025, 0.0, 0.0])
    once, more = icp_as_pcl(source, target, 0.5, 150, 1e-3), icp_as_pcl(source, target, 0.5, 150, 1e-9)
    assert once.converged
    assert once.iterations == 1 < more.iterations
    assert np.linalg.norm(more.T_target_source[:3, 3] + [0.025, 0, 0]) < 1e-3
    assert icp_as_pcl(source, target, 0.5, 150, 1e-9, mse_change_min=0.9).iterations == 2


@pytest.mark.parametrize("solve", ["icp", "gicp"])
def test_iterations_that_run_out_count_as_converged_and_too_few_pairs_do_not(solve):
    covariance, tree = regularised(neighbour_covariances(corner(seed=2))), build_kdtree(corner(seed=1))

    def found(source, iterations):
        if solve == "icp":
            return icp_as_pcl(source, Target(tree), 0.2, iterations, 1e-12)
        return gicp_as_pcl(source, covariance, Target.with_planes(tree), 0.2, iterations, 1e-12)

    assert found(corner(seed=2) + 0.05, 2).converged
    away = found(corner(seed=2) + 50.0, 5)
    assert not away.converged
    np.testing.assert_array_equal(away.T_target_source, np.eye(4))


@pytest.fixture
def paired():
    """Points, their correspondences and the metrics of planes of a GICP, in single precision."""
    rng = np.random.default_rng(4)
    source, covariance = corner(400, seed=3), regularised(neighbour_covariances(corner(400, seed=3)))
    moved = source @ pose(turn=(0.02, -0.01, 0.03))[:3, :3].T + [0.03, 0.01, -0.02] + rng.normal(0, 0.005, source.shape)
    return source.astype(np.float32), moved.astype(np.float32), pcl.pair_metrics(covariance, covariance, np.eye(3))


@pytest.mark.kernels
def test_cost_and_gradient_equal_numpy(paired):
    x, gradient, step = np.array([0.02, -0.03, 0.01, 0.05, -0.04, 0.1]), np.empty(6), 1e-6
    assert pcl.mean_cost(x, *paired, gradient) == pytest.approx(naive.gicp_cost(x, *paired), rel=1e-4)
    numeric = [
        (naive.gicp_cost(x + e, *paired) - naive.gicp_cost(x - e, *paired)) / (2 * step) for e in step * np.eye(6)
    ]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(pcl.euler_pose(x)[:3, :3], Rotation.from_euler("xyz", x[3:]).as_matrix(), atol=1e-12)


@pytest.mark.kernels
def test_the_minimum_equals_scipy_s_within_the_gradient_tolerance(paired):
    x = np.zeros(6)
    for _ in range(5):
        pcl.minimise(x, *paired)
    best = minimize(naive.gicp_cost, np.zeros(6), paired, method="BFGS", options={"gtol": 1e-8})
    assert naive.gicp_cost(np.zeros(6), *paired) > 10 * best.fun
    assert naive.gicp_cost(x, *paired) < 1.01 * best.fun
    np.testing.assert_allclose(x, best.x, atol=2e-3)


BARS = np.array(
    [([1.2, 0.5, 0.4], [1.2, 0.5, 1.4]), ([1.2, -0.5, 0.5], [1.2, 0.5, 1.5]), ([1.2, -0.5, 1.2], [1.2, 0.5, 1.2])]
)


@pytest.fixture
def segments(monkeypatch):
    """An odometry whose Hough transform finds `BARS`, translated by ``seen_at``, in every scan."""

    def make():
        odometry = ReportSegmentOdometry(OdometrySettings.preset("report-segments", "report"))
        odometry.seen_at = np.zeros(3)

        def found(points, hough):
            bars = BARS + odometry.seen_at
            return Segments(bars[:, 0], bars[:, 1], np.full(len(BARS), 60), np.full(len(BARS), 0.01)), 3

        monkeypatch.setattr(report_segments, "sorted_segments", found)
        return odometry

    return make


def rod(start, end, spacing_m=0.02, scatter_m=0.0, seed=0):
    """Points along a bar, drone frame."""
    count = int(np.linalg.norm(np.subtract(end, start)) / spacing_m)
    points = np.linspace(start, end, count)
    return points + np.random.default_rng(seed).normal(0, scatter_m, points.shape)


def cloud_of_rods(k):
    """Points of three bars, drone frame, as scan ``k`` of a sensor with noise sees them."""
    return np.concatenate([rod(start, end, scatter_m=0.005, seed=3 * k + b) for b, (start, end) in enumerate(BARS)])


def sort(points, **changes):
    settings = OdometrySettings.preset("report-segments", "report").hough.replace(**changes)
    return report_segments.sorted_segments(points, settings)[0]


def test_a_line_is_taken_whole_or_not_at_all():
    one = rod([1.2, -0.6, 0.5], [1.2, 0.6, 0.5])
    assert sort(one).length == pytest.approx([1.2], abs=1e-6)
    # A gap of 0.4 m along the line, beside the drone: its ends are equally far away, so the program does not see it.
    both = np.concatenate([rod([1.2, -0.8, 0.0], [1.2, -0.2, 0.0]), rod([1.2, 0.2, 0.0], [1.2, 0.8, 0.0])])
    assert sort(both).length == pytest.approx([1.6], abs=1e-6)
    # The same gap away from the foot of the perpendicular: nothing is cut, the whole line is dropped.
    apart = np.concatenate([rod([1.2, 0.1, 0.0], [1.2, 0.5, 0.0]), rod([1.2, 0.9, 0.0], [1.2, 1.4, 0.0])])
    assert not len(sort(apart))
    assert len(sort(apart, gap_max_m=0.5)) == 1


def test_lines_that_are_short_of_points_or_wide_are_dropped():
    sparse = rod([1.0, -0.9, 0.5], [1.0, 0.9, 0.5], spacing_m=0.11)
    assert len(sparse) == 16
    assert len(sort(sparse)) == 1
    assert not len(sort(sparse[:-1] * [1, 1.9, 1], gap_max_m=0.4)), "15 points on 3.2 m, fewer than five a metre"
    wide = rod([1.2, -0.3, 0.5], [1.2, 0.3, 0.5], scatter_m=0.03)
    assert not len(sort(wide)), "less than 99.5 % of its variance lies along it"
    assert len(sort(wide, pca_ratio_min=0.9)) == 1


def test_a_step_of_segments_is_half_the_mean_offset_across_and_counts_from_the_next_scan(segments):
    drift, odometry = np.array([0.1, 0.05, -0.04]), segments()
    odometry.update(corner(30), pose())
    first = odometry.update(corner(30), pose(drift))
    assert first.matches == len(odometry.map_segments()) == len(BARS)
    np.testing.assert_array_equal(first.T_world_drone[:3, 3], drift)  # nothing of this scan's own correction
    direction = (BARS[:, 1] - BARS[:, 0]) / np.linalg.norm(BARS[:, 1] - BARS[:, 0], axis=1)[:, None]
    across = drift - (direction @ drift)[:, None] * direction
    np.testing.assert_allclose(odometry.error, 0.5 * across.mean(axis=0), atol=1e-12)
    # Segments are mapped before the update, and hardly move their bars.
    np.testing.assert_allclose(odometry.bars.anchor[:, 0] - BARS[0, 0, 0], 0.01 * drift[0], atol=1e-12)
    assert np.linalg.norm(odometry.update(corner(30), pose(drift)).T_world_drone[:3, 3]) < 0.8 * np.linalg.norm(drift)


def test_runs_under_other_drifts_share_the_lines_of_their_scans(monkeypatch):
    scans = [cloud_of_rods(k) for k in range(3)]
    calls, found = [], report_segments.sorted_segments
    monkeypatch.setattr(report_segments, "sorted_segments", lambda *given: calls.append(1) or found(*given))

    def fly(shift_m):
        odometry = ReportSegmentOdometry(OdometrySettings.preset("report-segments", "report"))
        steps = [odometry.update(Scan(0.2 * k, scan), pose((0, shift_m * k, 1))) for k, scan in enumerate(scans)]
        assert len(odometry.map_segments()) == len(BARS)
        return [step.T_world_drone for step in steps], [step.seconds["hough"] for step in steps]

    alone = [fly(shift_m)[0] for shift_m in (0.0, 0.01)]
    calls.clear()
    with shared_segments():
        (still, still_s), (drifting, drifting_s) = fly(0.0), fly(0.01)
    assert len(calls) == len(scans)
    np.testing.assert_array_equal([still, drifting], alone)
    assert still_s == drifting_s


def test_segments_match_if_both_ends_are_near_and_they_overlap(segments):
    odometry = segments()
    odometry.update(corner(30), pose())
    for shift, matches in (((0.3, 0, 0), 3), ((0.34, 0, 0), 0), ((0.0, 0, 0.9), 1), ((0.0, 0, 1.1), 0)):
        seen = Segments(*(BARS + shift).transpose(1, 0, 2), np.full(3, 60), np.full(3, 0.01))
        assert len(copy.deepcopy(odometry.bars).insert(seen)) == matches, shift


def test_segments_on_the_floor_are_ignored(segments):
    odometry = segments()
    odometry.update(corner(30), pose((0.0, 0.0, -1.0)))
    assert len(odometry.map_segments()) == 2  # the horizontal one lies below 0.3 m, the others end above it


@pytest.mark.parametrize("method", [*CLOUDS, "report-segments"])
def test_an_empty_scan_does_not_change_the_correction(method):
    odometry = make_odometry(OdometrySettings.preset(method, "report"), np.eye(4))
    for scan in (np.full((4, 4, 3), np.nan), np.zeros((0, 3))):
        step = odometry.update(scan, pose((1.0, 2.0, 3.0)))
        assert not step.used
        np.testing.assert_array_equal(step.T_world_drone, pose((1.0, 2.0, 3.0)))
    assert len(odometry.map_points()) == len(odometry.map_segments()) == 0
