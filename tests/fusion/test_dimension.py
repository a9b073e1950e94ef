"""Lines along bars against lines through everything else."""

import numpy as np
import pytest

from steelnb.datatypes import Segments
from steelnb.fusion.dimension import dimensions, free_share, stands_out
from steelnb.hough.blocks import segment_structure
from steelnb.preprocess import voxel_grid
from steelnb.segment import tube_radius
from tests.test_segment import lattice, scanned, thinned


def line(start, end) -> Segments:
    return Segments(np.array([start], float), np.array([end], float), np.array([1]), np.array([0.0]))


def bars_stand_out(points: np.ndarray, tube: float) -> bool:
    return stands_out(points, segment_structure(points, tube, 8, 5.0), tube, 8, 5.0)


def clouds(n: int) -> dict[str, np.ndarray]:
    """Clouds without a line, 2 m wide."""
    rng = np.random.default_rng(1)
    cube, sphere, turn = rng.uniform(-1, 1, (n, 3)), rng.normal(size=(n, 3)), rng.uniform(0, 2 * np.pi, n)
    box, side = cube.copy(), rng.integers(0, 3, n)
    box[np.arange(n), side] = np.sign(box[np.arange(n), side])
    return {
        "plane": cube * [1, 1, 0.01], "sphere": sphere / np.linalg.norm(sphere, axis=1)[:, None], "noise": cube,
        "pipe": np.column_stack([np.cos(turn), np.sin(turn), 2 * cube[:, 2]]), "box": box,
    }  # fmt: skip


def test_a_line_a_plane_and_a_volume_have_1_2_and_3_dimensions() -> None:
    rng = np.random.default_rng(0)
    cube = rng.uniform(-1, 1, (60000, 3))
    along = line([-0.7, 0, 0], [0.7, 0, 0])
    for flat, expected in (([1, 0, 0], 1), ([1, 1, 0], 2), ([1, 1, 1], 3)):
        assert dimensions(cube * flat, along, 0.1)[0] == pytest.approx(expected, abs=0.1)
    crossed = np.concatenate([cube * [1, 0, 0], *(cube[:, [1, 0, 2]] * [0, 1, 0] + [x, 0, 0] for x in (-0.5, 0.5))])
    assert dimensions(crossed, along, 0.1)[0] < 1.5
    assert free_share(crossed, Segments.joined([along, line([0, 9, 0], [1, 9, 0])]), 0.1) == 1.0  # nothing there
    assert free_share(crossed, Segments.empty(), 0.1) == 0.0


@pytest.mark.parametrize("density", [4000, 20000])
@pytest.mark.parametrize("name", ["plane", "sphere", "noise", "pipe", "box"])
def test_lines_through_a_cloud_without_bars_do_not_run_free(name: str, density: int) -> None:
    points = clouds(density)[name]
    tube = 4 / np.sqrt(density)  # a few points in each
    thinned = voxel_grid(points, tube / np.sqrt(3))
    found = segment_structure(thinned, tube, 8, 5.0)
    assert len(found) > 10
    assert free_share(thinned, found, 2 * tube) < 0.05
    assert not bars_stand_out(thinned, tube)


@pytest.mark.parametrize("panels", [5, 10])
def test_bars_stand_out_where_they_are_few_tubes_apart(panels: int) -> None:
    # Like a drone's LiDAR sees a tower from afar.
    rng = np.random.default_rng(3)
    points = thinned(scanned(lattice(15, 4, 2, panels), 120, 0.1, 0.08), 0.2)
    tube = tube_radius(points)
    grid = voxel_grid(points, tube / np.sqrt(3))
    found = segment_structure(grid, tube, 8, 5.0)
    assert free_share(grid, found, 2 * tube) < 0.5
    assert bars_stand_out(grid, tube)
    spread = points + rng.uniform(-1, 1, points.shape)
    assert not bars_stand_out(voxel_grid(spread, tube / np.sqrt(3)), tube)
    assert not bars_stand_out(grid[:20], tube)
