"""`steelnb run`: what it leaves in its folder, and that it leaves nothing where it fails."""

import csv
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from steelnb.datatypes import Scan
from steelnb.errors import OutputError, RecordingError, SettingsError
from steelnb.exports import read_structure
from steelnb.recordings import read_cloud
from steelnb.recordings.trajectories import read_tum
from steelnb.replay.options import Options
from steelnb.replay.run import run_recording
from steelnb.replay.simulated import HeldScans, simulated_recording
from steelnb.replay.spool import Spool
from tests.replay.flights import lattice, made, settings

ALL = {
    "corrected.tum", "errors.png", "frames.csv", "map.ply", "map.png", "prior.tum", "recording.rrd", "segments.csv",
    "segments.json", "segments.obj", "segments.ply", "structure.json", "table.csv", "trajectories.png",
}  # fmt: skip


@pytest.fixture(scope="module")
def recording():
    return simulated_recording(settings(), pictures=True)


@pytest.fixture(scope="module")
def report(recording, tmp_path_factory):
    frames = []
    found = run_recording(
        recording, tmp_path_factory.mktemp("run") / "out", on_frame=lambda frame, _: frames.append(frame.index)
    )
    assert frames == list(range(40))
    return found


def test_a_run_leaves_everything_it_says(report):
    assert {file.name for file in report.folder.iterdir()} == ALL
    assert all(name in report.summary[-1] for name in ALL)
    assert all(file.stat().st_size > 0 for file in report.folder.iterdir())
    assert list(report.folder.parent.iterdir()) == [report.folder]


def test_its_files_hold_what_was_found(report):
    for name, expected in (("corrected", report.replayed.corrected), ("prior", report.replayed.prior)):
        found = read_tum(report.folder / f"{name}.tum")
        np.testing.assert_array_equal(found.stamp_s, expected.stamp_s)
        np.testing.assert_allclose(found.T_world_drone, expected.T_world_drone, atol=1e-12)
    cloud = read_cloud(report.folder / "map.ply")
    np.testing.assert_array_equal(cloud.points, report.replayed.points)
    built = read_structure(report.folder / "structure.json")
    assert len(built) == len(report.structure) > 3
    with (report.folder / "segments.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(built)  # the map of `best` is a cloud


def test_its_table_holds_the_numbers(report):
    with (report.folder / "table.csv").open() as file:
        rows = {row["quantity"]: row["value"] for row in csv.DictReader(file)}
    assert rows["frames"] == "40"
    assert rows["used"] == "39"
    assert rows["not used: first scan"] == "1"
    assert float(rows["corrected_ate_rmse_m"]) < 0.3 * float(rows["prior_ate_rmse_m"])
    assert float(rows["drift_removed_percent"]) > 70
    assert 0 <= float(rows["on_time_share"]) <= 1
    assert float(rows["frame_median_ms"]) <= float(rows["frame_p95_ms"]) <= float(rows["frame_max_ms"])
    with (report.folder / "frames.csv").open() as file:
        frames = list(csv.DictReader(file))
    assert [row["not_used"] for row in frames] == ["first scan"] + [""] * 39
    error = np.array([float(row["corrected_error_m"]) for row in frames])
    assert np.sqrt((error**2).mean()) == pytest.approx(float(rows["corrected_ate_rmse_m"]), abs=1e-4)


def test_methods_by_segments_write_their_own_map(recording, tmp_path):
    report = run_recording(recording, tmp_path / "out", Options("segments"), structure=False, viewer=False)
    assert {file.name for file in report.folder.iterdir()} == ALL - {"recording.rrd", "structure.json"}
    with (report.folder / "segments.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(report.replayed.segments) > 0


def test_without_truth_there_is_no_error_and_no_figure_of_it(recording, tmp_path):
    report = run_recording(replace(recording, truth=None), tmp_path / "out", structure=False, viewer=False)
    assert "errors.png" not in {file.name for file in report.folder.iterdir()}
    assert not any("ate" in name for name in report.numbers)
    assert "no truth" in "\n".join(report.summary)
    assert (report.folder / "frames.csv").read_text().splitlines()[1].endswith(",,")


def test_where_no_structure_is_found_the_reason_is_said(tmp_path):
    recording = made(lambda k: np.full((24, 18, 3), np.nan), skipped=Counter({"no finite point": 8}))
    report = run_recording(recording, tmp_path / "out")
    assert len(report.structure) == 0
    assert "without a return above the floor" in read_structure(report.folder / "structure.json").reason
    text = "\n".join(report.summary)
    assert "structure empty: 8 scans without a return" in text
    assert "8 no finite point" in text
    assert "8 too few points" in text
    assert report.numbers["skipped: no finite point"] == 8
    assert "map.png" not in {file.name for file in report.folder.iterdir()}
    assert read_tum(report.folder / "corrected.tum").stamp_s.shape == (8,)


def test_a_lone_scan_is_a_run(tmp_path):
    recording = made(lambda k: lattice(np.random.default_rng(k)), scans=1)
    report = run_recording(recording, tmp_path / "out", Options(noise="random-walk"))
    assert report.numbers["frames"] == 1
    assert "covers 1 scans" in "\n".join(report.summary)


def test_range_and_floor_reach_odometry_and_structure():
    options = Options(range_max_m=20.0, floor_m=-3.0, overrides={"preprocess.voxel_leaf_m": 0.2})
    crop = options.settings().preprocess
    assert (crop.x_max_m, crop.y_max_m, crop.z_max_m, crop.floor_m, crop.voxel_leaf_m) == (20, 20, 20, -3, 0.2)
    assert (options.structure().range_max_m, options.structure().floor_m) == (20, -3)
    assert Options("none").structure().adjust is False
    near = made(lambda k: lattice(np.random.default_rng(k), x_m=12.0))
    for given, used in ((Options(), 0), (options, 7)):
        assert run_count(near, given) == used


def run_count(recording, options) -> int:
    from steelnb.replay.course import course_of
    from steelnb.replay.offline import replay

    found = replay(course_of(recording).flight, options.settings())
    return sum(not reason for reason in found.reason)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (Options("bset"), "odometry = 'bset'"),
        (Options(sensor="lidar"), "sensor = 'lidar'"),
        (Options(noise="walk"), "unknown noise 'walk'"),
        (Options(seed=-1), "seed = -1"),
        (Options(range_max_m=-1.0), "x_max_m = -1.0"),
        (Options(overrides={"preprocess.leaf": 1}), "unknown setting 'preprocess.leaf'"),
        (Options(gap_max_s=0.0), "gap = 0.0"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_written(recording, tmp_path, options, words):
    with pytest.raises(SettingsError, match=words):
        run_recording(recording, tmp_path / "deep" / "out", options)
    assert list(tmp_path.iterdir()) == []


def failing(recording, fault: Exception):
    """The recording, whose source fails after ten scans."""

    def walk(wanted=None):
        for k, scan in enumerate(recording.scans.walk(wanted)):
            if k == 10:
                raise fault
            yield scan

    source = HeldScans([], recording.scans.stamp_s)
    source.walk = walk
    return replace(recording, scans=source)


@pytest.mark.parametrize("fault", [RecordingError("gone"), KeyboardInterrupt()])
def test_a_run_that_fails_leaves_nothing(recording, tmp_path, fault):
    with pytest.raises(type(fault)):
        run_recording(failing(recording, fault), tmp_path / "deep" / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_fails_leaves_what_was_there(recording, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "corrected.tum").write_text("old")
    with pytest.raises(RecordingError):
        run_recording(failing(recording, RecordingError("gone")), tmp_path / "out")
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["corrected.tum"]
    assert (tmp_path / "out" / "corrected.tum").read_text() == "old"


def test_a_full_disk_is_one_error_and_leaves_nothing(recording, tmp_path, monkeypatch):
    def full(self, k, scan):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Spool, "add", full)
    with pytest.raises(OutputError, match=r"out: cannot be written: No space left on device"):
        run_recording(recording, tmp_path / "out", viewer=False)
    assert list(tmp_path.iterdir()) == []


def test_spool_gives_back_every_scan(tmp_path):
    rng = np.random.default_rng(1)
    given = [rng.normal(size=shape).astype(np.float32) for shape in ((5, 4, 3), (0, 3), (7, 3), (1, 3))]
    given[0][0, 0] = np.nan
    with Spool(tmp_path / "scans", len(given)) as spool:
        for k, points in enumerate(given):
            spool.add(k, Scan(0.5 * k, points.astype(float)))
        assert len(spool) == 4
        for k in (3, 0, 2, 1, -1):
            np.testing.assert_array_equal(spool[k].points, given[k])
            assert spool[k].stamp_s == 0.5 * (k % 4)
        assert [scan.stamp_s for scan in spool[::2]] == [0.0, 1.0]
    assert not (tmp_path / "scans").exists()


def test_spool_keeps_to_its_room(tmp_path):
    points = np.zeros((100, 3))
    with Spool(Path(tmp_path / "scans"), 100, bytes_max=30_000) as spool:
        for k in range(100):
            spool.add(k, Scan(float(k), points))
        assert spool.number == list(range(0, 100, 4))
        assert (tmp_path / "scans").stat().st_size == 25 * 1200
