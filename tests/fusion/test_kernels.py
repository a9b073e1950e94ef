"""Kernels of sections, points on bars and the chain of poses against their slow twins."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.fusion.adjustment import imu_factors
from steelnb.fusion.adjustment.factors import summed
from steelnb.fusion.adjustment.solver import Chain
from steelnb.fusion.point_to_bar import Observations, face_residuals
from steelnb.fusion.sections import shapes
from steelnb.fusion.sections.histogram import CELL_M, HISTOGRAM, accumulate, cells_of, merged_cells
from steelnb.points.ranges import SIGMA_M, SIGMA_SHARE
from tests import naive
from tests.fusion.made import random_bars, rigid

pytestmark = pytest.mark.kernels
SEEDS = st.integers(0, 10_000)
KINDS = {"unknown": shapes.UNKNOWN, "angle": shapes.ANGLE, "tube": shapes.TUBE, "plate": shapes.PLATE}


def section(name, rng):
    """Turn and flange of a random section, NaN where its kind has none."""
    turn, flange = rng.uniform(-3, 3), rng.uniform(0.03, 0.2)
    return {"angle": (turn, flange), "tube": (np.nan, flange), "plate": (turn, np.nan)}.get(name, (0.0, np.nan))


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.sampled_from(["angle", "tube", "plate"]), st.floats(0.04, 0.2))
def test_the_front_of_a_section_is_that_of_its_edges(seed, name, thickness):
    rng = np.random.default_rng(seed)
    turn, flange = section(name, rng)
    corner = shapes.outlines(np.array([KINDS[name]]), np.array([turn]), np.array([flange]), thickness)[0]
    if name == "angle":
        np.testing.assert_allclose(corner, naive.angle_outline(turn, flange, thickness), atol=1e-15)
    for view, share in rng.uniform(-1, 1, (40, 2)):
        towards, beside = np.array([np.cos(4 * view), np.sin(4 * view)]), share * (0.6 if name == "plate" else flange)
        height, slope, edge = shapes.front_face(KINDS[name], corner, *towards, beside)
        expected = naive.front_face(name, turn, flange, thickness, towards, beside)
        if expected[0] == -np.inf:
            assert height == -1e9
            continue
        assert (height, slope) == pytest.approx(expected, rel=1e-9, abs=1e-9)
        step = 1e-6  # the face moves along its normal when the thickness changes
        if name == "angle":
            thicker, thinner = (naive.angle_outline(turn, flange, thickness + s) for s in (step, -step))
            run = corner[edge] - corner[edge - 1]
            outwards = np.array([run[1], -run[0]]) / np.linalg.norm(run)
            growth = shapes.face_growth(KINDS[name], edge, flange, thickness)
            assert growth == pytest.approx((thicker - thinner)[edge] @ outwards / (2 * step), rel=1e-6, abs=1e-9)
        else:
            assert shapes.face_growth(KINDS[name], edge, flange, thickness) == 0.0


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.sampled_from(["angle", "tube"]))
def test_the_nearest_edge_is_the_nearest_corner_or_side(seed, name):
    rng = np.random.default_rng(seed)
    turn, flange = section(name, rng)
    corner = shapes.outlines(np.array([KINDS[name]]), np.array([turn]), np.array([flange]), shapes.THICKNESS)[0]
    view, beside = rng.uniform(-3, 3), rng.uniform(-0.3, 0.3)
    corners = naive.angle_outline(turn, flange, shapes.THICKNESS) @ [-np.sin(view), np.cos(view)]
    edges = corners if name == "angle" else np.array([-flange, flange]) / 2
    found = shapes.nearest_edge(KINDS[name], corner, np.cos(view), np.sin(view), beside)
    assert found == pytest.approx(edges[np.abs(edges - beside).argmin()])


@pytest.mark.parametrize("seed", range(5))
def test_residuals_are_distances_along_the_line_of_sight(seed):
    rng, bars, T = np.random.default_rng(seed), random_bars(seed, 8), rigid(seed + 1, 4.0)
    names = [*KINDS] * 2
    turn, flange = np.array([section(name, rng) for name in names]).T
    kind, across = np.array([KINDS[name] for name in names]), shapes.frames(bars.direction)
    bar = np.append(rng.integers(0, 8, 400), -1)
    near = bars.start[bar] + rng.uniform(-0.05, 1.05, (401, 1)) * (bars.end - bars.start)[bar]
    points = (near + 0.05 * rng.standard_normal((401, 3)) - T[:3, 3]) @ T[:3, :3]
    found = face_residuals(
        points,
        bar,
        T,
        bars.start,
        bars.direction,
        bars.length,
        across,
        kind,
        shapes.outlines(kind, turn, flange, shapes.THICKNESS),
    )
    np.testing.assert_allclose(found[3][:-1], (points @ T[:3, :3].T + T[:3, 3])[:-1], atol=1e-12)
    expected = np.full((401, 2), np.nan)
    for i, b in enumerate(bar[:-1]):
        if names[b] != "unknown":
            place, ray = naive.in_bar_frame(points[i], T, bars.start[b], bars.direction[b], across[b])
            expected[i] = naive.face_residual(
                place, ray, bars.length[b],
                lambda towards, beside, b=b: naive.front_face(names[b], turn[b], flange[b], 1 / 12, towards, beside),
                lambda range_m: max(SIGMA_M, SIGMA_SHARE * range_m),
            )  # fmt: skip
    np.testing.assert_allclose(found[0], expected[:, 0], atol=1e-9)
    on_face = np.isfinite(expected[:, 0])
    np.testing.assert_allclose(found[1][on_face], expected[on_face, 1], rtol=1e-9)
    assert {names[b] for b in bar[on_face]} >= {"angle", "tube"}  # a plate may face away


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_histograms_and_their_cells_are_counted_point_by_point(seed):
    rng, bars, T = np.random.default_rng(seed), random_bars(seed, 3), rigid(seed + 1, 4.0)
    across, bar = shapes.frames(bars.direction), rng.integers(0, 3, 300)
    near = bars.start[bar] + rng.uniform(0, 1, (300, 1)) * (bars.end - bars.start)[bar]
    points = (near + 0.03 * rng.standard_normal((300, 3)) - T[:3, 3]) @ T[:3, :3]
    found = np.zeros((3, *HISTOGRAM))
    accumulate(points, T, bar, bars.start, bars.direction, bars.length, across, 0.1, found)
    expected = naive.section_histogram(points, T, bar, bars, across, 0.1, HISTOGRAM, CELL_M)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    full = rng.integers(0, 6, HISTOGRAM[:3])[..., None] * rng.uniform(0.5, 2.0, HISTOGRAM)
    full[..., 0] = rng.integers(0, 6, HISTOGRAM[:3])
    full[full[..., 0] > 0, 1] += 0.5
    np.testing.assert_allclose(cells_of(full, 2.0), naive.section_cells(full, 2.0))
    np.testing.assert_allclose(merged_cells(full), naive.section_cells(full.sum(axis=0)[None], 0.0), atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_points_are_grouped_by_scan_and_bar_in_their_order(seed):
    rng = np.random.default_rng(seed)
    scans = [(k, rng.normal(size=(n, 3)), rng.integers(0, 5, n)) for k, n in enumerate(rng.integers(0, 60, 4))]
    found = Observations.gathered(scans)
    assert found.first[-1] == len(found.point) == sum(len(bar) for _, _, bar in scans)
    for p, (k, b) in enumerate(zip(found.pair_scan, found.pair_bar, strict=True)):
        expected = scans[k][1][scans[k][2] == b].astype(np.float32)
        assert len(expected)
        np.testing.assert_array_equal(found.point[found.first[p] : found.first[p + 1]], expected)
    values, group = rng.normal(size=(50, 3, 2)), rng.integers(0, 6, 50)
    np.testing.assert_allclose(summed(values, group, 6), naive.group_sums(values, group, 6), atol=1e-12)


@pytest.mark.parametrize("size", [4, 6, 15])
def test_a_chain_of_poses_is_solved_like_its_dense_matrix(size):
    rng = np.random.default_rng(size)
    beside = rng.normal(size=(6, size, size))
    diagonal = np.array([A @ A.T + 6 * size * np.eye(size) for A in rng.normal(size=(7, size, size))])
    columns = rng.normal(size=(7, size, 3))
    dense, chain = naive.block_tridiagonal(diagonal, beside), Chain.factored(diagonal, beside)
    L, flat = np.linalg.cholesky(dense), columns.reshape(-1, 3)
    forward = chain.forward(columns)
    np.testing.assert_allclose(forward.reshape(-1, 3), np.linalg.solve(L, flat), atol=1e-9)
    np.testing.assert_allclose(chain.backward(forward).reshape(-1, 3), np.linalg.solve(dense, flat), atol=1e-9)
    inverse = np.linalg.inv(dense).reshape(7, size, 7, size)[range(7), :, range(7)]
    np.testing.assert_allclose(chain.inverse_blocks(), inverse, atol=1e-9)


def test_the_centroid_is_that_of_two_rectangles_and_grows_with_the_thickness():
    for thickness in (0.04, 1 / 12, 0.2):
        corner = naive.angle_outline(0.0, 0.1, thickness)[0]
        assert shapes.centroid_m(0.1, 0.1 * thickness) == pytest.approx(-corner[0])
        by_difference = [shapes.centroid_m(1.0, thickness + s) for s in (1e-6, -1e-6)]
        assert shapes.centroid_growth(thickness) == pytest.approx(-np.diff(by_difference)[0] / 2e-6, rel=1e-6)


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_readings_are_integrated_reading_by_reading(seed):
    rng = np.random.default_rng(seed)
    at_s, stamp_s = np.sort(rng.uniform(0, 2, 200)), np.sort(rng.uniform(-0.1, 2.1, 9))
    force, rate, bias = rng.normal(size=(200, 3)), rng.normal(size=(200, 3)), 0.1 * rng.normal(size=(8, 6))
    found = imu_factors.integrated(at_s, force, rate, stamp_s, bias)
    for each, expected in zip(found, naive.integrated(at_s, force, rate, stamp_s, bias), strict=True):
        np.testing.assert_allclose(each, expected, atol=1e-9)
