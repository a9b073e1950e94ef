"""`segment_file`: finds the bars of a made-up tower, few in noise, and leaves no partial output."""

import os
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pandas as pd
import pytest

from steelnb import cli
from steelnb.core.errors import InputError
from steelnb.fusion.cloud_bars import bars_of_cloud
from steelnb.hough.near_segments import within
from steelnb.metrics import score_segments
from steelnb.recording.segment import SegmentReport, segment_file
from tests.lattice import lattice, on_ground, scanned, thinned, tree

FILES = {"segments.csv", "segments.png"}
UTM = np.array([299100.0, 2801400.0, 1900.0])


def save_cloud(path: Path, points: np.ndarray) -> Path:
    np.savetxt(path, points, fmt="%.6f", delimiter=",")
    return path


LINE = np.linspace([0.0, 0, 0], [30.0, 0, 0], 300)


BARS = lattice(8, 4, 2, 3)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    points = np.round(scanned(BARS, 40, 0.06, 0.01), 3)
    path = tmp_path_factory.mktemp("saved") / "tower.xyz"
    np.savetxt(path, points, fmt="%.3f")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("found") / "out"


@pytest.fixture(scope="module")
def report(saved: Path, folder: Path) -> SegmentReport:
    return segment_file(saved, folder)


def test_bars_of_a_coarse_survey_are_found_and_its_faces_without_bars_hold_few() -> None:
    """A cloud like those of a drone's LiDAR: bars 0.1 m wide, noise 8 cm, points 0.17 m apart."""
    survey = thinned(scanned(lattice(), 120, 0.1, 0.08), 0.17)
    found = bars_of_cloud(survey)
    score = score_segments(found.bars, lattice())
    assert min(score.recall, score.precision) > 0.95
    assert score.offset_m.mean() < 0.05
    assert within(survey, found.bars, 0.25).mean() > 0.75
    jittered = survey + np.random.default_rng(1).uniform(-1, 1, survey.shape)
    assert within(jittered, bars_of_cloud(jittered).bars, 0.25).mean() < 0.08


def test_the_bars_of_a_near_scan_are_found_and_written(report: SegmentReport, folder: Path) -> None:
    bars = report.segments
    score = score_segments(bars, BARS)
    assert score.recall > 0.9
    assert score.precision > 0.95
    assert score.offset_m.max() < 0.02
    assert 0.05 < report.dx_m < 0.12
    assert report.explained > 0.9
    assert {path.name for path in folder.iterdir()} == FILES
    table = pd.read_csv(folder / "segments.csv")
    np.testing.assert_allclose(table[["start_x_m", "start_y_m", "start_z_m"]], bars.start, atol=1e-4)
    np.testing.assert_allclose(table[["end_x_m", "end_y_m", "end_z_m"]], bars.end, atol=1e-4)
    np.testing.assert_allclose(table["length_m"], bars.length, atol=1e-4)
    np.testing.assert_array_equal(table["count"], bars.count)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("steelnb.recording.segment.figure_bars", MagicMock())


@pytest.mark.usefixtures("undrawn")
def test_large_coordinates_come_back_to_the_millimetre(saved: Path, report: SegmentReport, tmp_path: Path) -> None:
    far_path = tmp_path / "far.csv"
    np.savetxt(far_path, np.loadtxt(saved) + UTM, fmt="%.3f", delimiter=",")
    far = segment_file(far_path, tmp_path / "far")
    np.testing.assert_allclose(far.segments.start - UTM, report.segments.start, atol=1e-3)
    table = pd.read_csv(tmp_path / "far" / "segments.csv")
    np.testing.assert_allclose(table[["end_x_m", "end_y_m", "end_z_m"]] - UTM, report.segments.end, atol=1e-3)


@pytest.mark.usefixtures("undrawn")
def test_the_settings_are_used(saved: Path, tmp_path: Path) -> None:
    found = segment_file(saved, tmp_path / "out", dx_m=0.1, confidence=40.0)
    assert found.dx_m == 0.1
    assert found.confidence.min() >= 40.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dx_m": 0.0}, "dx_m = 0.0: expected a length above 0"),
        ({"dx_m": float("nan")}, "dx_m = nan"),
        ({"dx_m": 1e9}, "dx_m = 1000000000.0"),
        ({"confidence": 0.0}, "confidence = 0.0: expected a number above 0"),
    ],
)
def test_bad_settings_are_refused(saved: Path, tmp_path: Path, settings: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        segment_file(saved, tmp_path / "a" / "out", **settings)
    assert not list(tmp_path.iterdir())


def test_a_second_run_writes_the_same_bytes(saved: Path, report: SegmentReport, folder: Path, tmp_path: Path) -> None:
    segment_file(saved, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == FILES
    for name in sorted(FILES):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()


def test_every_name_of_a_file_is_drawn_and_printed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    name = b"a$b_{\n\xff" + "塔.xyz".encode()  # a formula's sign, a control sign, no UTF-8, no sign of the font
    save_cloud(tmp_path / os.fsdecode(name), LINE)
    assert cli.main(["segment", str(tmp_path / os.fsdecode(name)), "-o", str(tmp_path / "out")]) == 0
    shown = capfd.readouterr()
    assert shown.err == ""
    assert shown.out.startswith("read      a$b_{��塔.xyz: ")
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES


@pytest.mark.parametrize("shape", ["two", "lines", "plane", "scatter"])
def test_any_cloud_gets_an_answer(tmp_path: Path, shape: str) -> None:
    rng = np.random.default_rng(0)
    clouds = {
        "two": np.array([[0.0, 0, 1], [1, 2, 3]]),
        "lines": np.concatenate([LINE, LINE[:, [2, 1, 0]] + [0.0, 20.0, 0.0]]),
        "plane": rng.uniform(0, [9, 9, 0], (300, 3)),
        "scatter": rng.uniform(0, 9, (300, 3)),
    }
    report = segment_file(save_cloud(tmp_path / "cloud.csv", clouds[shape]), tmp_path / "out")
    assert {file.name for file in (tmp_path / "out").iterdir()} == FILES
    if shape == "lines":
        np.testing.assert_allclose(report.segments.length, [30, 30], atol=0.2)
        assert report.explained == 1.0
    if shape in ("two", "scatter"):
        assert report.explained < 0.2


def test_a_cloud_of_few_points_is_told_that_they_are_few(tmp_path: Path) -> None:
    few = np.random.default_rng(1).uniform(0, 3, (10, 3))
    report = segment_file(save_cloud(tmp_path / "few.csv", few), tmp_path / "found")
    assert report.warnings == ("no bar found: the cloud has only 10 points",)


@pytest.mark.usefixtures("undrawn")
def test_lines_in_a_tree_are_kept_and_marked_if_all_are_asked_for(tmp_path: Path) -> None:
    cloud = save_cloud(tmp_path / "tree.csv", on_ground(tree(np.random.default_rng(3), 2.0, 0.0), 4.0))
    none = segment_file(cloud, tmp_path / "none")
    assert len(none.segments) == 0
    assert "--all" in none.warnings[0]
    every = segment_file(cloud, tmp_path / "all", keep_all=True)
    assert len(every.segments) > 5
    assert any(line.startswith("unsure") for line in every.summary)


@pytest.mark.usefixtures("undrawn")
def test_units_and_columns_are_stated_by_options_or_beside_the_cloud(tmp_path: Path) -> None:
    timed = np.column_stack([np.arange(len(LINE)), 1000 * LINE[:, [2, 1, 0]] + 1000.0])
    np.savetxt(cloud := tmp_path / "line.xyz", timed, fmt="%.3f")
    with pytest.raises(InputError, match="--columns"):
        segment_file(cloud, tmp_path / "out")
    assert cli.main(["segment", str(cloud), "--columns", "t,z,y,x", "--unit", "mm", "-o", str(tmp_path / "a")]) == 0
    (tmp_path / "recording.toml").write_text('unit = "mm"\ncolumns = ["t", "x", "y", "z"]\n')
    beside = segment_file(cloud, tmp_path / "b")
    np.testing.assert_allclose(pd.read_csv(tmp_path / "a" / "segments.csv")[["start_y_m", "end_y_m"]], 1, atol=0.01)
    np.testing.assert_allclose(np.abs(beside.segments.end - beside.segments.start), [[0, 0, 30]], atol=0.2)
    stated = segment_file(cloud, tmp_path / "c", columns=("t", "z", "y", "x"), unit="cm")
    np.testing.assert_allclose(np.abs(stated.segments.end - stated.segments.start), [[300, 0, 0]], atol=2)
    assert any("300 × 0 × 0 m" in line and "--unit" in line for line in stated.summary)
