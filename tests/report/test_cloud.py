"""`segment_file`: finds the bars of a made-up tower, few in noise, and leaves nothing half-written behind."""

import json
from pathlib import Path

import numpy as np
import open3d
import pandas as pd
import pytest
from scipy.spatial import cKDTree

from steelnb import cli
from steelnb.errors import InputError, SteelnbError
from steelnb.hough.blocks import segment_structure, within
from steelnb.hough.tube import point_spacing, tube_radius
from steelnb.io import clouds, point_files
from steelnb.io.structures import read_structure
from steelnb.points import voxel_grid
from steelnb.report.cloud import segment_file
from steelnb.types import Segments
from tests.lattice import lattice, scanned, thinned

FILES = {f"segments.{ending}" for ending in ("csv", "json", "obj", "ply", "png")} | {"structure.json", "structure.png"}
UTM = np.array([299100.0, 2801400.0, 1900.0])


def segments_of(points: np.ndarray) -> tuple[Segments, float]:
    dx = tube_radius(points)
    return segment_structure(voxel_grid(points, dx / np.sqrt(3)), dx), dx


def score(found: Segments, bars: np.ndarray, tolerance: float) -> tuple[float, float]:
    """Shares by length: of what was found that lies on a bar within 10°, and of the bars that were found."""
    axis = bars[:, 1] - bars[:, 0]
    length = np.linalg.norm(axis, axis=1)
    axis = axis / length[:, None]
    right, seen = 0.0, np.zeros((len(bars), 50), dtype=bool)
    for start, end, direction, extent in zip(found.start, found.end, found.direction, found.length, strict=True):
        away = start + np.linspace(0, 1, 60)[:, None, None] * (end - start) - bars[:, 0]
        along = np.einsum("skc,kc->sk", away, axis)
        across = np.linalg.norm(away - along[..., None] * axis, axis=2)
        on = (across < tolerance) & (along > -tolerance) & (along < length + tolerance)
        on &= np.abs(axis @ direction) > np.cos(np.radians(10))
        right += extent * on.any(axis=1).mean()
        for k in np.flatnonzero(on.any(axis=0)):
            place = (np.arange(50) + 0.5) / 50 * length[k]
            seen[k] |= (place >= along[on[:, k], k].min()) & (place <= along[on[:, k], k].max())
    return right / max(found.length.sum(), 1e-9), float((seen.mean(axis=1) * length).sum() / length.sum())


@pytest.fixture(scope="module")
def survey() -> np.ndarray:
    """A cloud like those of a drone's LiDAR: bars 0.1 m wide, noise 8 cm, points 0.17 m apart."""
    return thinned(scanned(lattice(), 120, 0.1, 0.08), 0.17)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    points = np.round(scanned(lattice(8, 4, 2, 3), 40, 0.06, 0.01), 3)
    path = tmp_path / "tower.xyz"
    np.savetxt(path, points, fmt="%.3f")
    return path


def test_bars_of_a_near_scan_are_found() -> None:
    found, dx = segments_of(scanned(lattice(), 100, 0.07, 0.01))
    right, seen = score(found, lattice(), 0.05)
    assert 0.05 < dx < 0.12
    assert right > 0.97
    assert seen > 0.95


def test_bars_of_a_coarse_survey_are_found(survey: np.ndarray) -> None:
    found, dx = segments_of(survey)
    right, seen = score(found, lattice(), 0.2)
    assert 0.2 < dx < 0.3
    assert right > 0.9
    assert seen > 0.8
    assert within(survey, found, dx).mean() > 0.75


def test_noise_holds_few_bars(survey: np.ndarray) -> None:
    rng = np.random.default_rng(1)
    uniform = rng.uniform(survey.min(axis=0), survey.max(axis=0), survey.shape)
    jittered = survey + rng.uniform(-1, 1, survey.shape)  # the tower's faces, without its bars
    dx = tube_radius(survey)
    for cloud in (uniform, jittered):
        found = segment_structure(voxel_grid(cloud, dx / np.sqrt(3)), dx)
        assert within(cloud, found, dx).mean() < 0.08


def test_the_tube_follows_the_spacing_of_thin_bars_and_the_width_of_wide_ones() -> None:
    thin = np.column_stack([np.arange(0, 50, 0.1), np.zeros((500, 2))])
    assert point_spacing(thin) == pytest.approx(0.2)
    assert tube_radius(thin) == pytest.approx(0.2)
    wide = [tube_radius(scanned(lattice(), per_m, 0.1, 0.01)) for per_m in (300, 1200)]
    assert wide[0] == pytest.approx(wide[1], rel=0.15)  # not finer because there are more points
    assert 0.06 < wide[0] < 0.15
    assert tube_radius(10 * thin) == pytest.approx(10 * tube_radius(thin))


def test_files_agree_with_the_report(saved: Path, tmp_path: Path) -> None:
    report = segment_file(saved, tmp_path / "out")
    bars = report.segments
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
    assert report.folder == tmp_path / "out"
    assert len(bars) > 20
    assert report.explained > 0.9
    table = pd.read_csv(tmp_path / "out" / "segments.csv")
    np.testing.assert_allclose(table[["start_x_m", "start_y_m", "start_z_m"]], bars.start, atol=1e-4)
    np.testing.assert_allclose(table[["end_x_m", "end_y_m", "end_z_m"]], bars.end, atol=1e-4)
    np.testing.assert_allclose(table["length_m"], bars.length, atol=1e-4)
    np.testing.assert_array_equal(table["count"], bars.count)
    document = json.loads((tmp_path / "out" / "segments.json").read_text())
    assert document["units"] == "metres"
    assert document["settings"]["dx_m"] == report.dx_m
    np.testing.assert_allclose([entry["end"] for entry in document["segments"]], bars.end, atol=1e-4)
    lines = open3d.io.read_line_set(str(tmp_path / "out" / "segments.ply"))
    ends = np.asarray(lines.points)[np.asarray(lines.lines)] + document["origin"]
    np.testing.assert_allclose(ends, np.stack([bars.start, bars.end], axis=1), atol=1e-4)
    words = [line.split() for line in (tmp_path / "out" / "segments.obj").read_text().splitlines()]
    vertices = np.array([w[1:] for w in words if w[0] == "v"], dtype=float)
    edges = sorted((int(w[1]), int(w[2])) for w in words if w[0] == "l")
    assert edges == [(2 * k + 1, 2 * k + 2) for k in range(len(bars))]
    np.testing.assert_allclose(vertices[0::2] + document["origin"], bars.start, atol=1e-4)
    assert any("segments" in line and str(len(bars)) in line for line in report.summary)


def test_large_coordinates_come_back_to_the_millimetre(saved: Path, tmp_path: Path) -> None:
    near = segment_file(saved, tmp_path / "near")
    far_path = tmp_path / "far.csv"
    np.savetxt(far_path, np.loadtxt(saved) + UTM, fmt="%.3f", delimiter=",")
    far = segment_file(far_path, tmp_path / "far")
    np.testing.assert_allclose(far.segments.start - UTM, near.segments.start, atol=1e-3)
    table = pd.read_csv(tmp_path / "far" / "segments.csv")
    np.testing.assert_allclose(table[["end_x_m", "end_y_m", "end_z_m"]] - UTM, near.segments.end, atol=1e-3)
    obj = (tmp_path / "far" / "segments.obj").read_text()
    assert "origin: add 299100.0 2801400.0 1900.0" in obj
    assert max(abs(float(v)) for line in obj.splitlines() if line[0] == "v" for v in line.split()[1:]) < 100


def test_the_same_file_gives_the_same_bytes(saved: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        segment_file(saved, tmp_path / name)
    for name in sorted(FILES):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_the_settings_are_used(saved: Path, tmp_path: Path) -> None:
    given = ["-o", str(tmp_path / "cli"), "--voxel", "0.05", "--dx", "0.2", "--min-votes", "30", "--no-structure"]
    assert cli.main(["segment", str(saved), *given]) == 0
    assert {path.name for path in (tmp_path / "cli").iterdir()} == FILES - {"structure.json", "structure.png"}
    found = json.loads((tmp_path / "cli" / "segments.json").read_text())
    assert found["settings"] == {"voxel_m": 0.05, "dx_m": 0.2, "min_votes": 30}
    assert min(segment["count"] for segment in found["segments"]) >= 30
    assert segment_file(saved, tmp_path / "out", voxel_m=0.2).dx_m == pytest.approx(0.2 * np.sqrt(3))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dx_m": 0.0}, "dx_m = 0.0: expected a length above 0"),
        ({"dx_m": float("nan")}, "dx_m = nan"),
        ({"dx_m": 1e9}, "dx_m = 1000000000.0"),
        ({"voxel_m": -0.1}, "voxel_m = -0.1"),
        ({"voxel_m": 1e-300}, "voxel_m = 1e-300"),
        ({"min_votes": 1}, "min_votes = 1: expected at least 2"),
    ],
)
def test_bad_settings_are_refused(saved: Path, tmp_path: Path, settings: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        segment_file(saved, tmp_path / "a" / "out", **settings)
    assert [path.name for path in tmp_path.iterdir()] == ["tower.xyz"]


def test_the_folder_is_named_after_the_cloud(saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert segment_file(saved).folder == Path("tower_segments")
    assert {path.name for path in (tmp_path / "here" / "tower_segments").iterdir()} == FILES


def test_a_second_run_replaces_its_files_and_no_others(saved: Path, tmp_path: Path) -> None:
    target = tmp_path / "out"
    segment_file(saved, target)
    (target / "notes.txt").write_text("mine\n")
    (target / "segments.csv").write_text("old\n")
    segment_file(saved, target)
    assert {path.name for path in target.iterdir()} == FILES | {"notes.txt"}
    assert (target / "notes.txt").read_text() == "mine\n"
    assert len((target / "segments.csv").read_text().splitlines()) > 20
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["out", "tower.xyz"]


@pytest.mark.parametrize("shape", ["two", "line", "plane", "upright", "scatter"])
def test_any_cloud_gets_an_answer(tmp_path: Path, shape: str) -> None:
    rng = np.random.default_rng(0)
    t = np.linspace(0, 30, 300)
    clouds = {
        "two": np.array([[0.0, 0, 0], [1, 2, 3]]),
        "line": np.column_stack([t, 0 * t, 0 * t]),
        "plane": np.column_stack([rng.uniform(0, 9, (300, 2)), 0 * t]),
        "upright": np.column_stack([0 * t, 0 * t, t]),
        "scatter": rng.uniform(0, 9, (300, 3)),
    }
    path = tmp_path / "cloud.csv"
    np.savetxt(path, clouds[shape], delimiter=",")
    try:
        report = segment_file(path, tmp_path / "out")
    except SteelnbError as fault:
        pytest.fail(str(fault))
    undrawn = set() if report.structure else {"structure.png"}
    assert {file.name for file in (tmp_path / "out").iterdir()} == FILES - undrawn
    if shape in ("line", "upright"):
        assert report.segments.length.max() == pytest.approx(30, abs=0.2)
        assert report.explained == 1.0
    if shape in ("two", "scatter"):
        assert report.explained < 0.2


def test_the_structure_of_a_cloud_ties_its_bars_at_joints_in_the_coordinates_of_the_file(tmp_path: Path) -> None:
    bars = lattice() + UTM
    path = tmp_path / "tower.csv"
    np.savetxt(path, scanned(bars, 100, 0.07, 0.01), delimiter=",", fmt="%.3f")
    report = segment_file(path, tmp_path / "out")
    assert report.structure is not None
    assert {file.name for file in (tmp_path / "out").iterdir()} == FILES
    written = read_structure(tmp_path / "out" / "structure.json")
    np.testing.assert_array_equal(written.joint, report.structure.joint)
    right, seen = score(written.segments, bars, 0.1)
    assert right > 0.95
    assert seen > 0.95
    # Corners of every level, and the crossings of the diagonals of each face and panel.
    corners = np.unique(np.round(bars.reshape(-1, 3), 6), axis=0)
    away = cKDTree(written.joint).query(corners)[0]
    assert (away < 0.1).mean() > 0.9
    assert any(line.startswith("structure ") and "joints" in line for line in report.summary)


def test_a_cloud_without_bars_has_an_empty_structure_that_says_why(tmp_path: Path) -> None:
    path = tmp_path / "noise.csv"
    np.savetxt(path, np.random.default_rng(0).uniform(0, 9, (300, 3)), delimiter=",")
    report = segment_file(path, tmp_path / "out")
    assert report.structure is not None
    assert len(report.structure) == len(read_structure(tmp_path / "out" / "structure.json")) == 0
    assert not (tmp_path / "out" / "structure.png").exists()
    assert f"structure empty: {report.structure.reason}" in report.summary
    assert read_structure(tmp_path / "out" / "structure.json").reason == report.structure.reason != ""
    assert segment_file(path, tmp_path / "fine", dx_m=1e-7, voxel_m=1e-7).structure is not None
    plain = segment_file(path, tmp_path / "plain", structure=False)
    assert plain.structure is None
    assert not (tmp_path / "plain" / "structure.json").exists()


def test_a_thinned_tower_has_the_bars_of_the_whole_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bars, path = lattice(), tmp_path / "tower.npy"
    np.save(path, scanned(bars, 200, 0.07, 0.01))
    whole = segment_file(path, tmp_path / "whole")
    for module, name, value in ((clouds, "FITS", 1000), (clouds, "VOXELS", 100_000), (point_files, "CHUNK", 10_000)):
        monkeypatch.setattr(module, name, value)
    thin = segment_file(path, tmp_path / "thin")
    assert any("too many to hold" in line for line in thin.summary)
    assert not any("too many to hold" in line for line in whole.summary)
    assert thin.dx_m == pytest.approx(whole.dx_m, rel=0.1)
    assert thin.explained == pytest.approx(whole.explained, abs=0.02)
    assert thin.segments.length.sum() == pytest.approx(whole.segments.length.sum(), rel=0.03)
    assert thin.structure is not None
    assert whole.structure is not None
    for segments in (thin.segments, thin.structure.segments):
        right, seen = score(segments, bars, 0.05)
        assert right > 0.97
        assert seen > 0.95
    assert len(bars) <= len(thin.structure) < 1.1 * len(whole.structure)


def test_the_width_of_bars_decides_the_tube_of_a_thinned_cloud() -> None:
    close = lattice(6, 3.2, 1.6, 6)  # so close together that few places look straight
    points = voxel_grid(scanned(close, 1000, 0.1, 0.01), 0.02)
    assert tube_radius(points) < 0.03
    assert 0.07 < tube_radius(points, thinned=True) < 0.2
    noise = voxel_grid(np.random.default_rng(0).uniform(0, 3, (20_000, 3)), 0.05)
    assert tube_radius(noise, thinned=True) == tube_radius(noise)
