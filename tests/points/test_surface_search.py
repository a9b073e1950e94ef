"""Ground and walls of which a spinning scanner has left separate lines."""

import numpy as np
import pytest

from steelnb.fusion.cloud_bars import bars_of_cloud
from steelnb.points.surfaces import line_directions, share_of_lattice, share_of_rows
from tests.lattice import lattice, scanned
from tests.scanner import seen

UP, AHEAD = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])


@pytest.mark.parametrize(("beams", "half_deg"), [(64, 22.5), (16, 15.0)])
def test_rings_on_the_ground_are_no_bars(beams, half_deg):
    mast = lattice(8.0, 2.0, 1.0, 4)
    ground = seen(beams, half_deg, stations=2)
    found = bars_of_cloud(np.concatenate([ground, scanned(mast, 400, 0.06, 0.005)]))
    assert (np.maximum(found.bars.start, found.bars.end)[:, 2] < 0.3).mean() < 0.05
    assert len(found.bars) > 0.9 * len(mast)
    assert found.surfaces[0].points > 0.9 * len(ground)


def test_rows_on_a_wall_are_no_bars():
    mast = lattice(8.0, 2.0, 1.0, 4)
    wall = seen(64, 22.5, wall_x=-14.0, far_m=20.0)
    found = bars_of_cloud(np.concatenate([wall, scanned(mast, 400, 0.06, 0.005)]))
    assert np.count_nonzero(found.bars.start[:, 0] < -13.5) <= 3
    assert len(found.bars) > 0.9 * len(mast)


def test_a_level_lattice_is_no_ground():
    """The bottom of a bridge: two chords, struts a metre apart, and diagonals."""
    x = np.arange(12.0)
    chords = [[[0, y, 0], [11, y, 0]] for y in (-1.0, 0.0, 1.0)]
    struts = [[[each, -1, 0], [each, 1, 0]] for each in x]
    diagonals = [[[each, y, 0], [each + 1, y + 1, 0]] for each in x[:-1] for y in (-1, 0)]
    bars = np.array([*chords, *struts, *diagonals], dtype=float)
    found = bars_of_cloud(scanned(bars, 200, 0.06, 0.005))
    assert found.surfaces == []
    assert len(found.bars) == len(chords) + len(struts) + len(x)  # diagonals in line are one


def test_directions_are_those_of_the_lines():
    rng = np.random.default_rng(0)
    along = np.arange(0.0, 10.0, 0.02)
    flat = np.zeros_like(along)
    ways = [(along, flat + k) for k in range(5)] + [(flat + k, along) for k in range(3)]
    grid = np.concatenate([np.column_stack([x, y, flat]) for x, y in ways])
    for points, normal in ((grid, UP), (grid[:, [2, 0, 1]], AHEAD)):
        lines = line_directions(points, normal, 0.25)
        assert abs(share_of_rows(lines) - 5 / 8) < 0.03
        assert share_of_lattice(lines) > 0.97
    rows = line_directions(grid[: 5 * len(along)], UP, 0.25)
    assert share_of_rows(rows) == 1.0
    turn = rng.uniform(0, 2 * np.pi, 20_000)
    ring = np.repeat(np.arange(2, 12), 2000)
    rings = line_directions(np.column_stack([ring * np.cos(turn), ring * np.sin(turn), 0 * turn]), UP, 0.25)
    assert 0.3 < share_of_lattice(rings) < 0.5
    assert share_of_rows(rings) < 0.35


def test_few_points_and_scattered_ones_have_no_lines():
    rng = np.random.default_rng(0)
    for points in (np.zeros((0, 3)), np.zeros((5, 3)), rng.uniform(0, 1, (300, 3)) * [1, 1, 0]):
        lines = line_directions(points, UP, 0.25)
        assert not lines.any()
        assert (share_of_rows(lines), share_of_lattice(lines)) == (0.0, 1.0)
