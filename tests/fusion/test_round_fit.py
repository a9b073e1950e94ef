"""Round tubes: the fit of a circle, and the choice between it and an angle section, on scans of simulated bars."""

import math
from dataclasses import replace

import numpy as np
import pytest

from steelnb.fusion import reconstruct, section_fit, sections
from steelnb.fusion.proposals import find_bars
from steelnb.fusion.reconstruct import MappedScans
from steelnb.metrics.members import match_members
from steelnb.settings import StructureSettings
from steelnb.simulation import Tower
from steelnb.simulation.sections import mesh_members
from tests import naive
from tests.fusion.made import around, small_tower
from tests.lattice import build_tubes

AXES = np.array([
    [[-0.7, -0.7, 0.3], [-0.7, -0.7, 3.4]], [[0.7, 0.6, 0.3], [0.7, 0.6, 3.4]], [[0.6, -0.8, 0.4], [0.8, -0.6, 3.3]],
    [[-0.7, -0.7, 2.6], [0.7, 0.6, 2.9]], [[-0.8, 0.8, 0.5], [0.7, 0.6, 1.5]],
])  # fmt: skip
SIDES = {"one side": 0.7, "all round": math.pi}


def offsets(found, tower) -> np.ndarray:
    """Distance of each axis to the middle of the bar found on it, metres, NaN for none."""
    match, result = match_members(found, tower.axes, distance_max_m=0.15), np.full(len(tower.axes), np.nan)
    for bar, member in enumerate(match.member.tolist()):
        start, end = tower.axes[member]
        result[member] = np.linalg.norm(np.cross(found.middle[bar] - start, end - start)) / np.linalg.norm(end - start)
    return result


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("radius_m", [0.012, 0.03, 0.05])
def test_the_axes_of_tubes_are_found_from_one_side_and_from_all(radius_m, side):
    tower, settings = build_tubes(AXES, radius_m), StructureSettings(adjust=False)
    flight = around(tower, 160, noise_m=0.01, seed=11, turn_rad=SIDES[side])
    T = flight.prior.T_world_drone
    plain, _ = find_bars(MappedScans.mapped(flight.scans, T, settings).voxels)
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
    """Poses that walk off by centimetres."""
    tower, rng = build_tubes(AXES, 0.05), np.random.default_rng(3)
    flight = around(tower, 160, noise_m=0.01, seed=12, turn_rad=math.pi)
    T = flight.prior.T_world_drone.copy()
    T[1:, :3, 3] += np.cumsum(0.002 * rng.standard_normal((len(T) - 1, 3)), axis=0)
    adjusted, plain = (reconstruct(flight.scans, T, None, StructureSettings(adjust=adjust)) for adjust in (True, False))
    assert adjusted.tube.all()
    assert offsets(adjusted.segments, tower).mean() < 0.5 * np.nanmean(offsets(plain.segments, tower))


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("tubes", [0, 1])
def test_angle_sections_are_not_round(tubes, side):
    """A clear tube beside the tower makes the others no tubes; one in its middle would be hidden."""
    tower = small_tower()
    joints, members = tower.joints, list(tower.members)
    if tubes:
        tube = build_tubes(np.array([[[-1.7, -0.4, 0.3], [-1.7, -0.4, 3.4]]]), 0.05)
        members.append(replace(tube.members[0], joints=(len(joints), len(joints) + 1)))
        joints = np.concatenate([joints, tube.joints])
    both = Tower(joints, tuple(members), *mesh_members(joints, members), tower.settings)
    flight = around(both, 120, noise_m=0.01, seed=11, turn_rad=SIDES[side])
    found = reconstruct(flight.scans, flight.prior.T_world_drone, settings=StructureSettings(floor_m=0.1))
    assert len(found) > 15
    if tubes:
        assert found.tube.sum() == 1
        assert np.linalg.norm(found.segments.middle[found.tube][0, :2] - [-1.7, -0.4]) < 0.01
    else:
        assert found.tube is None


def seen_arc(rng, radius_m: float, arc_rad: float, n: int = 300) -> np.ndarray:
    """Cells of a tube off its assumed axis, from the directions of an arc, with noise in depth of 4 mm."""
    view = rng.integers(0, max(1, round(arc_rad / 2 / np.pi * sections.VIEWS)), n)
    angle = (view + 0.5) * 2 * np.pi / sections.VIEWS - np.pi
    beside, along = radius_m * rng.uniform(-0.98, 0.98, n), rng.uniform(-0.5, 0.5, n)
    depth = np.sqrt(radius_m**2 - beside**2) + 0.004 * rng.standard_normal(n)
    towards, left = np.stack([np.cos(angle), np.sin(angle)]), np.stack([-np.sin(angle), np.cos(angle)])
    u, v = depth * towards + beside * left + np.array([[0.012], [-0.02]]) + np.array([[0.006], [-0.004]]) * along
    return np.column_stack([u, v, rng.uniform(0.5, 2.0, n), *towards, along, view])


def test_a_step_is_that_of_its_slow_twin():
    rng = np.random.default_rng(4)
    cells, place, normal = seen_arc(rng, 0.05, 3.0), np.array([0.02, -0.01, 0.003, 0.001, 0.04]), np.empty((5, 6))
    corner = sections.outlines(np.array([np.nan]), 2 * place[4:])[0]
    cost = section_fit.section_step(cells, np.empty((0, 6)), corner, place, normal)
    expected, matrix, vector = naive.circle_step(cells, place)
    assert cost == pytest.approx(expected)
    np.testing.assert_allclose(normal[:, :5], matrix, rtol=1e-6, atol=1e-6 * np.abs(matrix).max())
    np.testing.assert_allclose(normal[:, 5], vector, rtol=1e-6, atol=1e-6 * np.abs(vector).max())
