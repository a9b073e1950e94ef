"""Folders of clouds: round trips in every form, other people's layouts, and whatever can be wrong with them."""

from pathlib import Path

import numpy as np
import open3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.errors import (
    ExtrinsicsError,
    FileContentError,
    FileMissingError,
    OutputError,
    RecordingError,
    SteelnbError,
    TopicError,
    UnsupportedFormatError,
)
from steelnb.recordings.formats import Choice, open_recording, save_recording
from steelnb.recordings.points import WRITERS, read_points, write_npy, write_pcd, write_ply
from steelnb.recordings.stamps import name_of, stamps_of_names
from steelnb.recordings.trajectories import write_euroc, write_kitti, write_tum
from tests.recordings.folder_samples import COLUMNS, ROWS, finite, flown, pinhole

TOLERANCE_M = {"npy": 0.0, "ply": 5e-7, "pcd": 5e-7, "las": 5.1e-6, "laz": 5.1e-6}
IMAGES = ("npy", "pcd")


def laid_out(folder: Path, names: list[str], poses: int = 5) -> Path:
    """A folder with a cloud under each name, and as many poses, 0.1 s apart."""
    folder.mkdir()
    for k, name in enumerate(names):
        WRITERS[Path(name).suffix](folder / name, np.full((3, 3), float(k)))
    write_tum(folder / "poses.txt", flown(poses, 0.1, 10.0))
    return folder


@pytest.mark.parametrize("begin_s", [0.0, 1.6e9])
@pytest.mark.parametrize("form", TOLERANCE_M)
def test_round_trips_keep_scans_poses_mount_imu_and_truth(tmp_path: Path, form: str, begin_s: float) -> None:
    recording = pinhole(begin_s=begin_s, pictures=True)
    save_recording(tmp_path / "flight", recording, form)
    assert {path.name for path in tmp_path.iterdir()} == {"flight", "flight.truth.tum"}
    again = open_recording(tmp_path / "flight")
    np.testing.assert_allclose(again.scans.stamp_s, recording.scans.stamp_s, rtol=0, atol=1e-9)
    for scan, other in zip(recording.scans.walk(), again.scans.walk(), strict=True):
        if form in IMAGES:
            assert other.points.shape == (ROWS, COLUMNS, 3)
            np.testing.assert_array_equal(np.isnan(other.points), np.isnan(scan.points))
        np.testing.assert_allclose(finite(other.points), finite(scan.points), rtol=0, atol=TOLERANCE_M[form])
    assert recording.truth is not None
    assert again.truth is not None
    for one, other_trajectory in ((recording.poses, again.poses), (recording.truth, again.truth)):
        np.testing.assert_allclose(other_trajectory.stamp_s, one.stamp_s, rtol=0, atol=1e-9)
        np.testing.assert_allclose(other_trajectory.T_world_drone, one.T_world_drone, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.T_drone_sensor, recording.T_drone_sensor, rtol=0, atol=1e-12)
    assert recording.imu is not None
    assert again.imu is not None
    np.testing.assert_allclose(again.imu.stamp_s, recording.imu.stamp_s, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(again.imu.specific_force, recording.imu.specific_force)
    np.testing.assert_array_equal(again.imu.angular_rate, recording.imu.angular_rate)
    assert recording.pictures is not None
    assert again.pictures is not None
    for picture, other_picture in zip(recording.pictures.walk(), again.pictures.walk(), strict=True):
        np.testing.assert_array_equal(other_picture.pixels, picture.pixels)
    assert not +again.skipped
    wanted = np.array([False, True, False, False, True])
    np.testing.assert_allclose([scan.stamp_s for scan in again.scans.walk(wanted)], recording.scans.stamp_s[wanted])


@pytest.mark.parametrize("form", ["ply", "pcd"])
def test_open3d_reads_what_we_write(tmp_path: Path, form: str) -> None:
    recording = pinhole()
    save_recording(tmp_path / "flight", recording, form)
    files = sorted((tmp_path / "flight").glob(f"*.{form}"))
    for file, scan in zip(files, recording.scans.walk(), strict=True):
        cloud = open3d.io.read_point_cloud(str(file), remove_nan_points=True)
        np.testing.assert_allclose(np.asarray(cloud.points), finite(scan.points), rtol=0, atol=5e-7)


@pytest.mark.parametrize("form", TOLERANCE_M)
def test_scans_without_points_are_written_and_counted_when_read(tmp_path: Path, form: str) -> None:
    recording = pinhole(3)
    recording.scans.items[1].points[:] = np.nan  # type: ignore[attr-defined]
    save_recording(tmp_path / "flight", recording, form)
    again = open_recording(tmp_path / "flight")
    for _ in range(2):  # read twice, counted once
        assert [len(finite(scan.points)) > 0 for scan in again.scans.walk()] == [True, False, True]
    assert sum(again.skipped.values()) == 1
    assert set(+again.skipped) <= {"empty cloud", "no finite point"}


def test_broken_and_missing_files_are_counted_skips(tmp_path: Path) -> None:
    folder = laid_out(tmp_path / "a", [f"{k}.ply" for k in range(5)])
    whole = (folder / "1.ply").read_bytes()
    (folder / "1.ply").write_bytes(whole[:-5])
    (folder / "3.ply").write_bytes(b"")
    recording = open_recording(folder)
    (folder / "4.ply").unlink()
    assert [len(scan.points) for scan in recording.scans.walk()] == [3, 0, 3, 0, 0]
    assert recording.skipped == {"unreadable file": 2, "missing file": 1}
    assert "1.ply" in recording.facts["first unreadable file"]
    assert len(recording.flight().scans) == 5


@pytest.mark.parametrize("name", ["stamps.csv", "timestamps.txt", "times.txt"])
def test_stamps_from_a_file(tmp_path: Path, name: str) -> None:
    folder = laid_out(tmp_path / "a", ["scan9.npy", "scan10.npy", "scan11.npy"])
    (folder / name).write_text("#stamp\n10.0\n10.1\n10.3\n")
    recording = open_recording(folder)
    np.testing.assert_array_equal(recording.scans.stamp_s, [10.0, 10.1, 10.3])
    assert [scan.points[0, 0] for scan in recording.scans.walk()] == [0, 1, 2]  # 9 before 10
    (folder / name).write_text("10.0,scan11.npy\n10.1,scan9.npy\n10.4,scan10.npy\n")
    recording = open_recording(folder)
    assert [scan.points[0, 0] for scan in recording.scans.walk()] == [0, 1]  # 10.1, 10.4; then 10.0 is late
    assert recording.skipped == {"time ran backwards": 1}
    (folder / name).write_text("10.0\n10.1\n")
    with pytest.raises(RecordingError, match="2 stamps; expected the 3"):
        open_recording(folder)


def test_stamps_from_names_and_from_the_trajectory(tmp_path: Path) -> None:
    folder = laid_out(tmp_path / "named", ["cloud_10.05.pcd", "cloud_9.95.pcd"])
    np.testing.assert_array_equal(open_recording(folder).scans.stamp_s, [9.95, 10.05])
    folder = laid_out(tmp_path / "nanoseconds", ["10100000000000000000.npy"])
    assert open_recording(folder).scans.stamp_s[0] == 1.01e10
    folder = laid_out(tmp_path / "counted", [f"{k}.npy" for k in range(5)])
    np.testing.assert_allclose(open_recording(folder).scans.stamp_s, 10 + 0.1 * np.arange(5))
    folder = laid_out(tmp_path / "fewer", [f"{k}.npy" for k in range(4)])
    with pytest.raises(RecordingError, match="4 clouds without stamps, 5 poses"):
        open_recording(folder)
    assert stamps_of_names([name_of(s) for s in (0.0, 12.2, 1.6e9)]).tolist() == [0.0, 12.2, 1.6e9]  # type: ignore[union-attr]


def test_stamps_that_do_not_rise_are_left_out_and_counted(tmp_path: Path) -> None:
    folder = laid_out(tmp_path / "a", [f"{k}.npy" for k in range(6)])
    (folder / "times.txt").write_text("10\n10.1\n10.1\n9\nnan\n10.2\n")
    recording = open_recording(folder)
    np.testing.assert_array_equal(recording.scans.stamp_s, [10, 10.1, 10.2])
    assert recording.skipped == {"duplicate stamp": 1, "time ran backwards": 1, "stamp not finite": 1}


@pytest.mark.parametrize("write", [write_tum, write_euroc, write_kitti])
def test_the_trajectory_is_found_by_what_it_holds(tmp_path: Path, write) -> None:  # type: ignore[no-untyped-def]
    folder = laid_out(tmp_path / "a", [f"1{k}.5.npy" for k in range(5)])
    (folder / "poses.txt").unlink()
    write(folder / "odometry.csv", flown(5, 1.0, 10.5))
    (folder / "notes.txt").write_text("flown by hand\n")
    recording = open_recording(folder)
    np.testing.assert_allclose(recording.poses.T_world_drone, flown(5, 1.0, 10.5).T_world_drone, atol=1e-9)
    assert len(recording.flight().scans) == 5
    write_tum(folder / "other.txt", flown(9, 1.0))
    with pytest.raises(TopicError, match=r"odometry\.csv, other\.txt"):
        open_recording(folder)
    assert len(open_recording(folder, Choice(poses="other.txt")).poses) == 9
    assert len(open_recording(folder, Choice(poses=str(folder / "other.txt"))).poses) == 9


def test_a_truth_beside_or_named_is_never_the_poses(tmp_path: Path) -> None:
    folder = laid_out(tmp_path / "a", [f"1{k}.5.npy" for k in range(5)])
    assert open_recording(folder).truth is None
    write_tum(folder / "groundtruth.txt", flown(7, 1.0))
    recording = open_recording(folder)
    assert (len(recording.poses), len(recording.truth or ())) == (5, 7)
    write_tum(tmp_path / "a.truth.tum", flown(8, 1.0))
    assert len(open_recording(folder).truth or ()) == 8
    assert len(open_recording(folder, Choice(truth="groundtruth.txt")).truth or ()) == 7
    (folder / "poses.txt").unlink()
    (tmp_path / "a.truth.tum").unlink()
    recording = open_recording(folder)
    assert recording.facts["poses"] == "true poses"
    assert recording.truth is recording.poses


def test_sub_folders_and_patterns_choose_the_clouds(tmp_path: Path) -> None:
    folder = laid_out(tmp_path / "a", [])
    laid_out(folder / "left", ["10.0.ply", "10.1.ply"])
    assert len(open_recording(folder).scans.stamp_s) == 2
    laid_out(folder / "right", ["10.0.npy", "10.1.npy", "10.2.npy", "10.0.pcd"])
    with pytest.raises(TopicError, match="clouds in left, right"):
        open_recording(folder)
    with pytest.raises(TopicError, match=r"\.npy, \.pcd"):
        open_recording(folder, Choice(scans="right"))
    assert len(open_recording(folder / "right", Choice(scans="*.npy")).scans.stamp_s) == 3
    with pytest.raises(TopicError, match="no folder 'up'; expected one of left, right"):
        open_recording(folder, Choice(scans="up"))
    with pytest.raises(RecordingError, match="no clouds"):
        open_recording(folder / "right", Choice(scans="*.laz"))


def test_what_is_missing_or_wrong_is_one_line(tmp_path: Path) -> None:
    folder = laid_out(tmp_path / "a", ["10.0.npy"])
    (folder / "settings.toml").write_text("[extrinsics]\nrotation_xyzw = [0, 0, 0, 0]\n")
    with pytest.raises(ExtrinsicsError):
        open_recording(folder)
    (folder / "settings.toml").unlink()
    (folder / "imu.csv").write_text("0,1,2\n")
    with pytest.raises(FileContentError, match=r"imu\.csv, line 1"):
        open_recording(folder)
    (folder / "imu.csv").unlink()
    (folder / "poses.txt").write_text("1 0 0 0 0 0 0 1\n2 0\n")
    with pytest.raises(FileContentError, match="line 2"):
        open_recording(folder)
    (folder / "poses.txt").write_text("nothing\n")
    with pytest.raises(RecordingError, match="no trajectory"):
        open_recording(folder)
    with pytest.raises(FileMissingError, match=r"none\.tum"):
        open_recording(folder, Choice(poses="none.tum"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(UnsupportedFormatError):
        open_recording(tmp_path / "empty")


def test_nothing_half_written_stays(tmp_path: Path) -> None:
    recording = pinhole()

    def full(points: np.ndarray) -> None:
        raise OSError(28, "No space left on device")

    recording.scans.items[3] = type("Broken", (), {"stamp_s": 0.6, "points": property(full)})()  # type: ignore[attr-defined]
    with pytest.raises(OutputError, match="No space left"):
        save_recording(tmp_path / "flight", recording, "ply")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OutputError):
        save_recording(Path("/proc/flight"), pinhole(), "npy")


@pytest.mark.parametrize(
    ("name", "array", "words"),
    [
        ("a", np.zeros(3), "shape"), ("a", np.zeros((3, 2)), "shape"), ("a", np.zeros((2, 2, 2, 3)), "shape"),
        ("a", np.array([["1", "2", "3"]]), "<U1"), ("a", np.zeros((2, 3), complex), "complex"),
    ],
)  # fmt: skip
def test_numpy_files_of_other_things_are_refused(tmp_path: Path, name: str, array: np.ndarray, words: str) -> None:
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(FileContentError, match=words):
        read_points(tmp_path / "a.npy")


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


def _whole(scratch: Path, ending: str) -> bytes:
    path = scratch / f"whole{ending}"
    {".npy": write_npy, ".ply": write_ply, ".pcd": write_pcd}[ending](path, np.arange(36.0).reshape(3, 4, 3))
    return path.read_bytes()


@settings(max_examples=4000, deadline=None)
@given(st.data(), st.sampled_from([".npy", ".ply", ".pcd"]))
def test_damaged_scans_give_points_or_an_error_of_ours(scratch: Path, data: st.DataObject, ending: str) -> None:
    content = bytearray(_whole(scratch, ending))
    for _ in range(data.draw(st.integers(0, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    (scratch / f"a{ending}").write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        points = read_points(scratch / f"a{ending}")
    except SteelnbError:
        return
    assert points.shape[-1] == 3
    assert points.nbytes < 1e6
