"""Large clouds: read in chunks, thinned to voxels, and segmented as if they had been read whole."""

from pathlib import Path

import numpy as np
import pytest

from steelnb.errors import DegenerateCloudError, EmptyCloudError, FileContentError, SteelnbError
from steelnb.preprocess import voxel_grid
from steelnb.recordings import thinning
from steelnb.recordings.las import write_las
from steelnb.recordings.points import write_pcd, write_ply
from steelnb.recordings.thinning import is_large, read_thinned
from steelnb.segment import segment_file, tube_radius
from tests.test_segment import lattice, scanned, score

UTM = np.array([299119.894, 2801406.927, 1949.952])
WRITERS = {"a.las": write_las, "a.laz": write_las, "a.ply": write_ply, "a.pcd": write_pcd}


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "FITS", 5000)
    monkeypatch.setattr(thinning, "VOXELS", 4000)
    monkeypatch.setattr(thinning, "CHUNK", 1000)
    monkeypatch.setattr(thinning, "WAITING", 3000)


def naive(points: np.ndarray, edge_m: float) -> dict[tuple[int, ...], tuple[np.ndarray, int]]:
    """Mean and number of the points in each voxel."""
    cells: dict[tuple[int, ...], list[np.ndarray]] = {}
    for point in points:
        cells.setdefault(tuple(np.floor(point / edge_m).astype(int).tolist()), []).append(point)
    return {cell: (np.mean(inside, axis=0), len(inside)) for cell, inside in cells.items()}


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("name", WRITERS)
def test_voxels_hold_the_means_of_their_points(tmp_path: Path, name: str) -> None:
    points = np.random.default_rng(0).uniform(-3, 3, (12_345, 3)).astype(np.float32).astype(np.float64)
    WRITERS[name](tmp_path / name, points)
    assert is_large(tmp_path / name)
    cloud = read_thinned(tmp_path / name)
    assert cloud.count is not None
    assert cloud.count.sum() == len(points)
    assert len(cloud) <= 4000
    assert cloud.thinned_m in 2.0 ** np.arange(-10, 5)
    np.testing.assert_allclose(np.average(cloud.points, axis=0, weights=cloud.count), points.mean(axis=0), atol=1e-5)
    expected = naive(points, cloud.thinned_m)
    assert len(expected) == pytest.approx(len(cloud), rel=0.002)  # LAS moves points across borders by 5 µm
    found = naive(cloud.points, cloud.thinned_m)
    same = [cell for cell in found if cell in expected and np.allclose(found[cell][0], expected[cell][0], atol=2e-5)]
    assert len(same) > 0.99 * len(cloud)


@pytest.mark.usefixtures("small")
def test_large_coordinates_are_shifted_and_invalid_points_counted(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    write_las(tmp_path / "a.las", rng.uniform(-3, 3, (9000, 3)) + UTM)
    cloud = read_thinned(tmp_path / "a.las")
    np.testing.assert_array_equal(cloud.origin, [299100, 2801400, 1900])
    np.testing.assert_allclose(cloud.points.mean(axis=0) + cloud.origin, UTM, atol=0.1)
    points = rng.uniform(-3, 3, (9000, 3))
    points[::9] = np.nan
    write_pcd(tmp_path / "a.pcd", points)
    cloud = read_thinned(tmp_path / "a.pcd")
    assert cloud.dropped_invalid == 1000
    assert cloud.count is not None
    assert cloud.count.sum() == 8000
    assert cloud.resolution_m == pytest.approx(2.0**-22)  # single precision below 4 m


@pytest.mark.usefixtures("small")
def test_wide_clouds_start_with_coarse_voxels(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(-8000, 8000, (6000, 3))
    write_ply(tmp_path / "a.ply", points)
    cloud = read_thinned(tmp_path / "a.ply")
    assert cloud.count is not None
    assert cloud.count.sum() == 6000
    assert len(cloud) <= 4000


@pytest.mark.usefixtures("small")
def test_broken_large_clouds_get_the_errors_of_small_ones(tmp_path: Path) -> None:
    points = np.zeros((6000, 3))
    write_pcd(tmp_path / "same.pcd", points)
    write_pcd(tmp_path / "nan.pcd", points * np.nan)
    write_pcd(tmp_path / "far.pcd", points + 1e20)
    for name, error in (("same", DegenerateCloudError), ("nan", EmptyCloudError), ("far", FileContentError)):
        with pytest.raises(error, match=f"{name}.pcd"):
            segment_file(tmp_path / f"{name}.pcd", tmp_path / "out")
    for name in WRITERS:
        WRITERS[name](tmp_path / name, np.random.default_rng(0).uniform(size=(6000, 3)))
        whole = (tmp_path / name).read_bytes()
        for share in (0.1, 0.5, 0.99):
            (tmp_path / name).write_bytes(whole[: int(share * len(whole))])
            with pytest.raises(SteelnbError, match=name):
                segment_file(tmp_path / name, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_text_and_what_cannot_be_read_is_not_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "FITS", 1)
    (tmp_path / "a.xyz").write_text("1 2 3\n4 5 6\n7 8 9\n")
    (tmp_path / "a.ply").write_text("ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nend_header\n")
    for name in ("a.xyz", "a.ply", "none.las"):
        assert not is_large(tmp_path / name)


def test_a_thinned_tower_has_the_bars_of_the_whole_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bars = lattice()
    path = tmp_path / "tower.laz"
    write_las(path, scanned(bars, 200, 0.07, 0.01))
    whole = segment_file(path, tmp_path / "whole")
    monkeypatch.setattr(thinning, "FITS", 1000)
    monkeypatch.setattr(thinning, "VOXELS", 100_000)
    monkeypatch.setattr(thinning, "CHUNK", 10_000)
    thin = segment_file(path, tmp_path / "thin")
    assert any("too many to hold" in line for line in thin.summary)
    assert not any("too many to hold" in line for line in whole.summary)
    assert thin.dx_m == pytest.approx(whole.dx_m, rel=0.1)
    assert thin.explained == pytest.approx(whole.explained, abs=0.02)
    assert thin.segments.length.sum() == pytest.approx(whole.segments.length.sum(), rel=0.03)
    right, seen = score(thin.segments, bars, 0.05)
    assert right > 0.97
    assert seen > 0.95
    assert thin.structure is not None
    right, seen = score(thin.structure.segments, bars, 0.05)
    assert right > 0.97
    assert seen > 0.95
    assert whole.structure is not None
    assert len(bars) <= len(thin.structure) < 1.1 * len(whole.structure)


def test_the_width_of_bars_decides_the_tube_of_a_thinned_cloud() -> None:
    rng = np.random.default_rng(0)
    close = lattice(6, 3.2, 1.6, 6)  # so close together that few places look straight
    points = voxel_grid(scanned(close, 1000, 0.1, 0.01), 0.02)
    assert tube_radius(points) < 0.03
    assert 0.07 < tube_radius(points, thinned=True) < 0.2
    noise = voxel_grid(rng.uniform(0, 3, (20_000, 3)), 0.05)
    assert tube_radius(noise, thinned=True) == tube_radius(noise)
