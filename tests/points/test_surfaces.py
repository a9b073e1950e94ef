"""Surfaces of clouds: what is one, where it lies, and what is none."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.points.surfaces import Surfaces
from tests.lattice import lattice, scanned, sheet

CELL_M = 0.1


@pytest.mark.parametrize("turn_deg", [0.0, 20.0, 90.0])
@pytest.mark.parametrize("shift_m", [0.0, 40.0])
def test_a_sheet_is_one_surface_however_it_lies(turn_deg, shift_m):
    turn = Rotation.from_euler("xyz", [turn_deg, 0.3 * turn_deg, 11.0], degrees=True)
    points = turn.apply(sheet(4.0, 3.0)) + shift_m
    found = Surfaces.found_in(points, CELL_M)
    label = found.label_of(points)
    (surface,) = found.described(label)
    assert (label == 0).mean() > 0.99
    assert surface.points == np.count_nonzero(label == 0)
    assert abs(surface.normal @ turn.apply([0.0, 0.0, 1.0])) > np.cos(np.radians(1))
    np.testing.assert_allclose(surface.centre, turn.apply([2.0, 1.5, 0.0]) + shift_m, atol=0.05)
    assert 0.7 * 12 < surface.area_m2 < 1.1 * 12
    assert surface.rms_m < 0.02
    assert surface.is_level is (turn_deg < 30)


def test_surfaces_are_numbered_by_size_and_far_points_are_on_none():
    large, small = sheet(5.0, 4.0), sheet(2.0, 2.0, seed=1) + np.array([0.0, 0.0, 3.0])
    points = np.concatenate([small, large])
    found = Surfaces.found_in(points, CELL_M).grown(points, np.array([3, 3]))
    assert len(found) == 2
    assert (found.label_of(large) == 0).mean() > 0.99
    assert (found.label_of(small) == 1).mean() > 0.99
    assert (found.label_of(large + np.array([0.0, 0.0, 0.5])) == -1).all()
    assert len(found.label_of(np.zeros((0, 3)))) == 0


def test_a_curved_surface_is_one():
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(60_000, 3))
    ball = 2.0 * direction / np.linalg.norm(direction, axis=1)[:, None]
    found = Surfaces.found_in(ball, CELL_M)
    assert len(found) == 1
    assert (found.label_of(ball) == 0).mean() > 0.99
    assert found.described(found.label_of(ball))[0].rms_m > 0.5


def test_bars_of_a_lattice_and_scattered_points_are_no_surface():
    rng = np.random.default_rng(4)
    for cloud in (scanned(lattice(), 300, 0.12, 0.005), rng.uniform(0, 6, (20_000, 3)), sheet(0.3, 6.0)):
        found = Surfaces.found_in(cloud, CELL_M)
        assert len(found) == 0
        assert (found.label_of(cloud) == -1).all()
        assert found.described(found.label_of(cloud)) == []


def test_a_surface_continues_to_its_rim_and_over_patches_but_not_to_what_lies_beside_it():
    deck, patch = sheet(4.0, 3.0), sheet(0.3, 1.2, seed=1) + np.array([1.0, 3.0, 0.0])  # seen between two shadows
    beside, above = sheet(4.0, 0.1, seed=2) - [0.0, 0.35, 0.0], sheet(4.0, 0.1, seed=3) + np.array([0.0, 2.9, 0.3])
    points = np.concatenate([deck, patch, beside, above])
    found = Surfaces.found_in(points, CELL_M).grown(points, np.array([14]))
    assert len(found) == 1
    for cloud, is_on in ((deck, True), (patch, True), (beside, False), (above, False)):
        assert ((found.label_of(cloud) == 0) == is_on).mean() > 0.98
    nothing = Surfaces.found_in(beside, CELL_M).grown(beside, np.zeros(0, dtype=int))
    assert len(nothing) == 0
    assert (nothing.label_of(beside) == -1).all()
