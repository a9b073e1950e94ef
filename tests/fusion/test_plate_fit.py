"""Plates: the fit of planes, the choice between them and angle sections, and their face in an adjustment."""

import math
from dataclasses import replace

import numpy as np
import pytest

from steelnb.fusion import plate_fit, reconstruct, sections
from steelnb.fusion.reconstruct import MappedScans
from steelnb.settings import StructureSettings
from steelnb.simulation.sections import PLATE
from tests.fusion.made import around, small_tower

DECK = np.array([[-0.8, -0.6, 2.2], [0.8, -0.6, 2.2], [0.8, -0.3, 2.2], [-0.8, -0.3, 2.2]])


def decked_tower():
    """A small tower with a deck, a plate without thickness, in its middle."""
    tower = small_tower()
    corners = np.concatenate([tower.vertices, DECK])
    both = len(tower.vertices) + np.array([[0, 1, 2], [0, 2, 3]])
    return replace(
        tower, vertices=corners, triangles=np.concatenate([tower.triangles, both]),
        triangle_member=np.concatenate([tower.triangle_member, [PLATE, PLATE]]),
    )  # fmt: skip


def deck_distance(segments) -> np.ndarray:
    """Height of the middle of each segment above the deck; NaN if it is beside it or half a metre away."""
    x, y, z = segments.middle.T
    above = (abs(x) < 0.7) & (DECK[0, 1] + 0.05 < y) & (y < DECK[2, 1] - 0.05) & (abs(z - DECK[0, 2]) < 0.5)
    return np.where(above, z - DECK[0, 2], np.nan)


def seen_plate(rng, turn_rad: float, thickness_m: float, n: int = 600) -> np.ndarray:
    """Cells of a plate 0.25 m wide whose front looks towards ``turn_rad``, a third of them on its back."""
    is_back = np.arange(n) % 3 == 0
    angle = turn_rad + rng.uniform(-1.0, 1.0, n) + math.pi * is_back
    view = np.floor((angle + math.pi) % (2 * math.pi) / (2 * math.pi) * sections.VIEWS)
    angle = (view + 0.5) * 2 * math.pi / sections.VIEWS - math.pi
    normal, left = np.array([np.cos(turn_rad), np.sin(turn_rad)]), np.array([-np.sin(turn_rad), np.cos(turn_rad)])
    along, beside, depth = rng.uniform(-0.5, 0.5, n), rng.uniform(-0.125, 0.125, n), 0.003 * rng.standard_normal(n)
    place = np.outer(depth - thickness_m * is_back + 0.02 * along + 0.03, normal) + np.outer(beside, left)
    return np.column_stack([place, rng.uniform(0.5, 2.0, n), np.cos(angle), np.sin(angle), along, view])


@pytest.mark.parametrize("thickness_m", [0.0, 0.02])
@pytest.mark.parametrize("turn_rad", [-2.0, 0.4, 3.0])
def test_planes_follow_the_front_of_a_plate_whatever_its_thickness(turn_rad, thickness_m):
    cells = seen_plate(np.random.default_rng(3), turn_rad, thickness_m)
    cost, width, middle, normal = plate_fit.fit_planes(cells)
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
    assert plate_fit.fit_planes(cells)[0] == np.inf


def test_the_face_of_a_plate_is_seen_from_its_front_alone():
    turn = 0.7
    corner = sections.outlines(np.array([turn]), np.array([np.inf]))[0]
    normal, left = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
    u, v = 0.1 * left + 0.01 * normal  # a centimetre before the face
    for side in (1, -1):
        p, q = 3.0 * side * normal + 0.5 * left
        residual, *_ = sections.face_distance(u, v, 0.5, p, q, 0.0, corner, 1.0)
        expected = 0.01 * math.hypot(3.0, 0.5) / 3.0 if side == 1 else math.nan  # along the line of sight
        assert residual == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize("turn_rad", [1.5, math.pi])
def test_a_deck_is_told_from_bars(turn_rad):
    settings, flight = StructureSettings(floor_m=0.1), around(decked_tower(), 160, 0.01, 11, turn_rad)
    T = flight.prior.T_world_drone
    fitted, _ = MappedScans.mapped(flight.scans, T, settings).find_and_fit(2)
    bars, is_plate = fitted.bars, np.isinf(fitted.bars.flange)
    height = deck_distance(bars.segments)
    assert is_plate.any()
    assert (is_plate == np.isfinite(height)).all()
    assert abs(height[is_plate]).max() < 0.003
    normal = np.einsum("kb,bkx->bx", [np.cos(bars.turn), np.sin(bars.turn)], bars.across)[is_plate]
    assert abs(normal[:, 2]).min() > math.cos(0.03)
    found = reconstruct(flight.scans, T, settings=settings)
    assert len(found) > 15
    assert np.isnan(deck_distance(found.segments)).all()
