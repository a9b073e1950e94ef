"""Points of bars by voxel lookup, their choice for an adjustment, and the fit of sections."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.fusion.adjustment.problem import Bars
from steelnb.fusion.point_to_bar import BarVoxels, world_points
from steelnb.fusion.sections import fit, shapes
from steelnb.fusion.sections.fit import fit_sections
from steelnb.fusion.sections.histogram import HISTOGRAM, VIEWS, accumulate
from steelnb.fusion.sections.shapes import THICKNESS
from tests import naive
from tests.fusion.made import bars_of, random_bars, rigid


@pytest.mark.parametrize(("turn", "flange"), [(0, fit.FLANGES_M[1]), (5, fit.FLANGES_M[5]), (17, fit.FLANGES_M[9])])
def test_the_search_takes_the_same_steps_with_tables_as_with_outlines(turn, flange):
    rng = np.random.default_rng(turn)
    view = rng.integers(0, VIEWS, 200)
    angle = (view + 0.5) * 2 * math.pi / VIEWS - math.pi
    place = flange * ([0.4, -0.3] + 0.4 * rng.normal(size=(200, 2)))
    weight, zero = rng.uniform(0.5, 2.0, 200), np.zeros(200)
    cells = np.column_stack([place, weight, np.cos(angle), np.sin(angle), zero, view])
    rows = np.column_stack([-0.5 * flange + zero[:9], 0.6 * flange + zero[:9], cells[:9, 3:5], weight[:9], view[:9]])
    corner, normal = np.empty((6, 2)), np.empty((4, 5))
    shapes.angle_outline(2 * math.pi * turn / fit.TURNS, flange, THICKNESS, corner)
    exact = fit.section_step(cells, rows, corner, np.zeros(4), normal)
    total = cells[:, 2].sum()
    move = np.linalg.solve(normal[:2, :2] + 1e-3 * total * np.eye(2), normal[:2, 4]).clip(-0.03, 0.03)
    found = np.zeros(2)
    cost = fit._gauss_newton_by_table(cells, rows, fit.profiles(THICKNESS), flange, turn, found, 1)
    assert cost == pytest.approx(exact, rel=0.02)
    assert np.linalg.norm(move) > 0.02 * flange
    assert found == pytest.approx(move, abs=0.005 * flange)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 20))
def test_a_voxel_belongs_to_the_nearest_bar_unless_another_is_nearly_as_near(seed, n):
    rng = np.random.default_rng(seed)
    bars = random_bars(seed, n)
    at = np.concatenate([rng.uniform(-2.5, 2.5, (500, 3)), np.repeat(bars.middle, 30, axis=0)])
    at[500:] += rng.normal(scale=0.1, size=(30 * n, 3))
    at = (np.floor(at / 0.04) + 0.5) * 0.04  # centres of voxels
    expected = naive.nearest_bars(at, bars, 0.2, 0.05)
    assert np.count_nonzero(expected >= 0) > 0
    voxels = BarVoxels.around(bars, 0.2, 0.05, 0.04)
    np.testing.assert_array_equal(voxels.bar_of(at), expected)


def test_points_in_range_are_placed_in_the_world():
    rng, T = np.random.default_rng(1), rigid(1)
    points = np.concatenate([rng.uniform(-3, 3, (400, 3)), [[np.nan] * 3, [0, 0, 0], [9, 0, 0]]])
    found, weight, index = world_points(points, T, 4.0, T[2, 3])
    placed, expected, kept = naive.world_points(points, T, 4.0, T[2, 3])
    assert 100 < len(kept) < 300
    np.testing.assert_array_equal(index, kept)
    np.testing.assert_allclose(found, placed)
    np.testing.assert_allclose(weight, expected)


def near_face(corner, towards, rng, n):
    """Points ``(n, 2)`` on the faces of an outline that are seen from the direction ``towards (2,)``."""
    found = []
    while len(found) < n:
        beside = rng.uniform(-0.3, 0.3)
        front, *_ = shapes.front_face(shapes.ANGLE, corner, *towards, beside)
        if front > -1:
            found.append(front * towards + beside * np.array([-towards[1], towards[0]]))
    return np.array(found)


@pytest.mark.parametrize(("turn", "flange"), [(0.3, 0.045), (2.0, 0.07), (4.4, 0.12), (0.3, 0.12)])
def test_the_axis_of_an_angle_section_is_found_from_its_near_faces(flange, turn):
    # A bar along z, its centroid off the assumed axis, seen from three sides with range noise of 2 cm.
    rng, off = np.random.default_rng(5), np.array([0.012, -0.02])
    corner = shapes.outlines(np.array([shapes.ANGLE]), np.array([turn]), np.array([flange]), THICKNESS)[0]
    bar = bars_of([[0, 0, 0], [0, 0, 2]])
    across, histogram = shapes.frames(bar.direction), np.zeros((1, *HISTOGRAM))
    for view in np.radians([10, 80, 150]):
        towards = np.array([np.cos(view), np.sin(view)])
        seen = near_face(corner, towards, rng, 1000) + 0.02 * rng.standard_normal((1000, 1)) * towards
        points = (off + seen) @ across[0] + np.outer(rng.uniform(0, 2, 1000), [0, 0, 1])
        for point in points:  # each from 3 m away, level
            T = np.eye(4)
            T[:3, 3] = point + 3.0 * towards @ across[0]
            accumulate(
                point[None] - T[:3, 3], T, np.zeros(1, int), bar.start, bar.direction, bar.length,
                across, 0.05, histogram,
            )  # fmt: skip
    found = fit_sections(histogram, bar.length, THICKNESS)
    assert np.linalg.norm(found.centre[0] - off) < 0.005
    assert found.flange[0] == pytest.approx(flange, rel=0.12)
    assert np.abs(found.slope).max() < 0.006
    assert np.isnan(fit_sections(0 * histogram, bar.length, THICKNESS).flange[0])


def test_points_of_an_adjustment_are_chosen_without_regard_to_their_noise():
    # The nearer one of two bars takes the points of the other that noise brings near to it.
    rng, sigma_m, n = np.random.default_rng(0), 0.03, 16_000
    bars, turn, flange = bars_of([[0, 0, 0], [0, 0, 2]], [[0.13, 0, 0], [0.13, 0, 2]]), np.full(2, 0.3), np.full(2, 0.1)
    kind = np.full(2, shapes.ANGLE)
    across, corner = shapes.frames(bars.direction), shapes.outlines(kind, turn, flange, THICKNESS)
    sectioned = Bars(bars, across, kind, turn, flange)
    T = np.eye(4)
    T[:3, 3] = sensor = np.array([3.0, 0.5, 1.0])
    towards = across[0] @ (sensor * [1, 1, 0])
    at = near_face(corner[0], towards / np.linalg.norm(towards), rng, n) @ across[0]
    at[:, 2] += rng.uniform(0.2, 1.8, n)
    noise, ray = rng.standard_normal(n), at - sensor
    points = ray * (1 + sigma_m * noise / np.linalg.norm(ray, axis=1))[:, None]
    voxels = BarVoxels.around(bars, 0.144, 0.03, 0.04)
    first = voxels.bar_of(points + sensor) == 0
    none = np.zeros(first.sum(), dtype=np.int64)
    on_face = voxels.on_face(points[first], none, T, sectioned, 2.0, 0.06)
    chosen = noise[first][on_face]
    assert len(chosen) > 1000
    assert np.abs(chosen).max() <= 2.0 * 1.05  # the noise of a range grows with it
    assert abs(chosen.mean()) < 3 / np.sqrt(len(chosen))
    assert noise[first].mean() > 0.1
    assert not voxels.on_face(points[first], none, T, sectioned, 0.0, 0.06).any()
