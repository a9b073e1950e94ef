"""Lines along bars against lines in planar and volumetric regions."""

import numpy as np
import pytest

from steelnb.fusion.proposals import BLURRED_SHARE_MIN, find_bars
from steelnb.fusion.regions import dimensions, is_lattice, linear_share
from steelnb.fusion.scales import Scales
from steelnb.hough.blocks import segment_structure
from steelnb.points import VoxelMap, voxel_grid
from steelnb.settings import StructureSettings
from steelnb.types import Segments
from tests.fusion.made import bars_of
from tests.lattice import lattice, scanned, thinned


def passes_for_lattice(points: np.ndarray, tube: float) -> bool:
    return is_lattice(points, segment_structure(points, tube, 8, 5.0), tube, 8, 5.0)


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
    cube = np.random.default_rng(0).uniform(-1, 1, (60000, 3))
    along = bars_of([[-0.7, 0, 0], [0.7, 0, 0]])
    for flat, expected in (([1, 0, 0], 1), ([1, 1, 0], 2), ([1, 1, 1], 3)):
        assert dimensions(cube * flat, along, 0.1)[0] == pytest.approx(expected, abs=0.1)
    crossed = np.concatenate([cube * [1, 0, 0], *(cube[:, [1, 0, 2]] * [0, 1, 0] + [x, 0, 0] for x in (-0.5, 0.5))])
    assert dimensions(crossed, along, 0.1)[0] < 1.5
    assert linear_share(crossed, Segments.joined([along, bars_of([[0, 9, 0], [1, 9, 0]])]), 0.1) == 1.0
    assert linear_share(cube, along, 0.1) == linear_share(crossed, Segments.empty(), 0.1) == 0.0


@pytest.mark.parametrize("density", [4000, 10000])
@pytest.mark.parametrize("name", ["plane", "sphere", "noise", "pipe", "box"])
def test_lines_in_a_cloud_without_bars_lie_in_planar_or_volumetric_regions(name: str, density: int) -> None:
    points = clouds(density)[name]
    tube = 4 / np.sqrt(density)  # a few points in each
    grid = voxel_grid(points, tube / np.sqrt(3))
    found = segment_structure(grid, tube, 8, 5.0)
    assert len(found) > 10
    assert linear_share(grid, found, 2 * tube) < 0.05
    assert not passes_for_lattice(grid, tube)


@pytest.mark.parametrize(("panels", "tube"), [(5, 0.284), (10, 0.276)])
def test_a_lattice_is_known_where_bars_are_few_tubes_apart(panels: int, tube: float) -> None:
    # As a drone's LiDAR sees a tower from afar; the tubes are those of `steelnb segment`.
    points = thinned(scanned(lattice(15, 4, 2, panels), 120, 0.1, 0.08), 0.2)
    grid = voxel_grid(points, tube / np.sqrt(3))
    found = segment_structure(grid, tube, 8, 5.0)
    assert linear_share(grid, found, 2 * tube) < 0.5
    assert passes_for_lattice(grid, tube)
    spread = points + np.random.default_rng(3).uniform(-1, 1, points.shape)
    assert not passes_for_lattice(voxel_grid(spread, tube / np.sqrt(3)), tube)
    assert not passes_for_lattice(grid[:20], tube)


@pytest.mark.parametrize(("width_m", "refused"), [(3.2, False), (6.0, True)])
def test_a_map_that_is_to_be_sharpened_may_have_fewer_bars_but_not_next_to_none(width_m: float, refused: bool) -> None:
    settings = StructureSettings(floor_m=-1e6)
    box = 0.5 * width_m * clouds(40000)["box"] + [8, 0, 3]
    voxels = VoxelMap(Scales.at(settings.tube_m).voxel_m)
    voxels.insert(np.concatenate([scanned(lattice(6, 3, 2, 4), 60, 0.08, 0.01), box]))
    bars, reason = find_bars(voxels, settings, grids=1, linear_min=BLURRED_SHARE_MIN)
    assert ("planar or volumetric regions" in reason) == (len(bars) == 0) == refused
    assert not len(find_bars(voxels, settings, grids=1)[0])
