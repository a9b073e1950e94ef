"""The section of each bar: fits of circles and planes, and the choice between them and angle sections."""

import math
from dataclasses import replace

import numpy as np
import pytest

from steelnb.fusion import reconstruct
from steelnb.fusion.bars import Ridges, find_bars
from steelnb.fusion.mapped_scans import BarFitter, MappedScans
from steelnb.fusion.sections import fit, shapes
from steelnb.fusion.sections.histogram import VIEWS
from steelnb.metrics.segments import match_members
from steelnb.settings import StructureSettings
from steelnb.simulation import Tower
from steelnb.simulation.tower import mesh_members
from tests import naive
from tests.fusion.made import around, small_tower
from tests.lattice import build_tubes, with_plate

AXES = np.array([
    [[-0.7, -0.7, 0.3], [-0.7, -0.7, 3.4]], [[0.7, 0.6, 0.3], [0.7, 0.6, 3.4]], [[0.6, -0.8, 0.4], [0.8, -0.6, 3.3]],
    [[-0.7, -0.7, 2.6], [0.7, 0.6, 2.9]], [[-0.8, 0.8, 0.5], [0.7, 0.6, 1.5]],
])  # fmt: skip
SIDES = {"one side": 0.7, "all round": math.pi}
DECK = np.array([[-0.8, -0.6, 2.2], [0.8, -0.6, 2.2], [0.8, -0.3, 2.2], [-0.8, -0.3, 2.2]])


def offsets(found, tower) -> np.ndarray:
    """Distance of each axis to the middle of the bar found on it, metres, NaN for none."""
    match, result = match_members(found, tower.axes, distance_max_m=0.15), np.full(len(tower.axes), np.nan)
    for bar, member in enumerate(match.member.tolist()):
        start, end = tower.axes[member]
        result[member] = np.linalg.norm(np.cross(found.middle[bar] - start, end - start)) / np.linalg.norm(end - start)
    return result


@pytest.mark.parametrize(("radius_m", "side"), [(0.012, "one side"), (0.03, "all round"), (0.05, "one side")])
def test_the_axes_of_tubes_are_found_from_one_side_and_from_all(radius_m, side):
    tower, settings = build_tubes(AXES, radius_m), StructureSettings(adjust=False)
    flight = around(tower, 100, noise_m=0.01, seed=11, turn_rad=SIDES[side])
    T = flight.prior.T_world_drone
    plain, _ = find_bars(Ridges.of(MappedScans.mapped(flight.scans, T, settings).voxels))
    assert np.nanmedian(offsets(plain, tower)) > 0.2 * radius_m  # the bias to the near side
    found = reconstruct(flight.scans, T, settings=settings)
    off = offsets(found.segments, tower)
    assert len(found) == len(AXES)
    assert found.tube.all()
    assert off.max() < 0.004
    assert np.abs(found.width_m - 2 * radius_m).max() < 0.003
    assert np.isnan(found.opening).all()
    assert found.sigma_m.max() < 0.002


def test_tubes_take_part_in_an_adjustment():
    """Poses that drift by centimetres."""
    tower, rng = build_tubes(AXES, 0.05), np.random.default_rng(3)
    flight = around(tower, 160, noise_m=0.01, seed=12, turn_rad=math.pi)
    T = flight.prior.T_world_drone.copy()
    T[1:, :3, 3] += np.cumsum(0.002 * rng.standard_normal((len(T) - 1, 3)), axis=0)
    adjusted, plain = (reconstruct(flight.scans, T, None, StructureSettings(adjust=adjust)) for adjust in (True, False))
    assert adjusted.tube.all()
    assert offsets(adjusted.segments, tower).mean() < 0.5 * np.nanmean(offsets(plain.segments, tower))


@pytest.mark.parametrize("side", SIDES)
def test_angle_sections_beside_a_tube_are_not_round(side):
    """A clear tube beside the tower does not turn the others into tubes. In the middle it would be hidden."""
    tower, tube = small_tower(), build_tubes(np.array([[[-1.7, -0.4, 0.3], [-1.7, -0.4, 3.4]]]), 0.05)
    n = len(tower.joints)
    members = [*tower.members, replace(tube.members[0], joints=(n, n + 1))]
    joints = np.concatenate([tower.joints, tube.joints])
    both = Tower(joints, tuple(members), *mesh_members(joints, members), tower.settings)
    flight = around(both, 80, noise_m=0.01, seed=11, turn_rad=SIDES[side])
    found = reconstruct(flight.scans, flight.prior.T_world_drone, settings=StructureSettings(floor_m=0.1))
    assert len(found) > 15
    assert found.tube.sum() == 1
    assert np.linalg.norm(found.segments.middle[found.tube][0, :2] - [-1.7, -0.4]) < 0.01


def seen_arc(rng, radius_m: float, arc_rad: float, n: int = 300) -> np.ndarray:
    """Cells of a tube off its assumed axis, from the directions of an arc, with noise in depth of 4 mm."""
    view = rng.integers(0, max(1, round(arc_rad / 2 / np.pi * VIEWS)), n)
    angle = (view + 0.5) * 2 * np.pi / VIEWS - np.pi
    beside, along = radius_m * rng.uniform(-0.98, 0.98, n), rng.uniform(-0.5, 0.5, n)
    depth = np.sqrt(radius_m**2 - beside**2) + 0.004 * rng.standard_normal(n)
    towards, left = np.stack([np.cos(angle), np.sin(angle)]), np.stack([-np.sin(angle), np.cos(angle)])
    u, v = depth * towards + beside * left + np.array([[0.012], [-0.02]]) + np.array([[0.006], [-0.004]]) * along
    return np.column_stack([u, v, rng.uniform(0.5, 2.0, n), *towards, along, view])


def test_a_step_is_that_of_its_slow_twin():
    rng = np.random.default_rng(4)
    cells, place, normal = seen_arc(rng, 0.05, 3.0), np.array([0.02, -0.01, 0.003, 0.001, 0.04]), np.empty((5, 6))
    corner = shapes.outlines(np.array([shapes.TUBE]), np.array([np.nan]), 2 * place[4:], shapes.THICKNESS)[0]
    cost = fit.section_step(cells, np.empty((0, 6)), corner, place, normal)
    expected, matrix, vector = naive.circle_step(cells, place)
    assert cost == pytest.approx(expected)
    np.testing.assert_allclose(normal[:, :5], matrix, rtol=1e-6, atol=1e-6 * np.abs(matrix).max())
    np.testing.assert_allclose(normal[:, 5], vector, rtol=1e-6, atol=1e-6 * np.abs(vector).max())


def decked_tower():
    """A small tower with a deck, a plate without thickness, in its middle."""
    return with_plate(small_tower(), DECK[[0, 1, 3, 2]])


def deck_distance(segments) -> np.ndarray:
    """Height of the middle of each segment above the deck; NaN if it is beside it or half a metre away."""
    x, y, z = segments.middle.T
    above = (abs(x) < 0.7) & (DECK[0, 1] + 0.05 < y) & (y < DECK[2, 1] - 0.05) & (abs(z - DECK[0, 2]) < 0.5)
    return np.where(above, z - DECK[0, 2], np.nan)


def seen_plate(rng, turn_rad: float, thickness_m: float, n: int = 600) -> np.ndarray:
    """Cells of a plate 0.25 m wide whose front looks towards ``turn_rad``, a third of them on its back."""
    is_back = np.arange(n) % 3 == 0
    angle = turn_rad + rng.uniform(-1.0, 1.0, n) + math.pi * is_back
    view = np.floor((angle + math.pi) % (2 * math.pi) / (2 * math.pi) * VIEWS)
    angle = (view + 0.5) * 2 * math.pi / VIEWS - math.pi
    normal, left = np.array([np.cos(turn_rad), np.sin(turn_rad)]), np.array([-np.sin(turn_rad), np.cos(turn_rad)])
    along, beside, depth = rng.uniform(-0.5, 0.5, n), rng.uniform(-0.125, 0.125, n), 0.003 * rng.standard_normal(n)
    place = np.outer(depth - thickness_m * is_back + 0.02 * along + 0.03, normal) + np.outer(beside, left)
    return np.column_stack([place, rng.uniform(0.5, 2.0, n), np.cos(angle), np.sin(angle), along, view])


@pytest.mark.parametrize(("turn_rad", "thickness_m"), [(-2.0, 0.0), (0.4, 0.02), (3.0, 0.02)])
def test_planes_follow_the_front_of_a_plate_whatever_its_thickness(turn_rad, thickness_m):
    cells = seen_plate(np.random.default_rng(3), turn_rad, thickness_m)
    cost, width, middle, normal = fit.fit_planes(cells)
    front = np.array([math.cos(turn_rad), math.sin(turn_rad), -0.02]) / math.hypot(1.0, 0.02)
    assert normal @ front > math.cos(0.005)
    assert front @ middle == pytest.approx(0.03, abs=0.0005)
    assert width == pytest.approx(0.25, rel=0.05)
    assert math.sqrt(cost / cells[:, 2].sum()) == pytest.approx(0.003, rel=0.1)


@pytest.mark.parametrize("noise_m", [0.0, 0.003])
def test_points_across_a_line_are_no_plate_that_it_lies_in(noise_m):
    rng = np.random.default_rng(4)
    cells = seen_plate(rng, 0.4, 0.0)
    cells[:, :2], cells[:, 5] = rng.uniform(-0.2, 0.2, (len(cells), 2)), noise_m * rng.standard_normal(len(cells))
    assert fit.fit_planes(cells)[0] == np.inf


@pytest.mark.parametrize("turn_rad", [1.5, math.pi])
def test_a_deck_is_told_from_bars(turn_rad):
    settings, flight = StructureSettings(floor_m=0.1), around(decked_tower(), 100, 0.01, 11, turn_rad)
    T = flight.prior.T_world_drone
    fitted = BarFitter(MappedScans.mapped(flight.scans, T, settings)).find_and_fit(2)
    bars, is_plate = fitted.bars, fitted.bars.kind == shapes.PLATE
    height = deck_distance(bars.segments)
    assert is_plate.any()
    assert (is_plate == np.isfinite(height)).all()
    assert abs(height[is_plate]).max() < 0.003
    normal = np.einsum("kb,bkx->bx", [np.cos(bars.turn), np.sin(bars.turn)], bars.across)[is_plate]
    assert abs(normal[:, 2]).min() > math.cos(0.03)
    found = reconstruct(flight.scans, T, settings=settings)
    assert len(found) > 15
    assert np.isnan(deck_distance(found.segments)).all()
    assert found.tube is None
