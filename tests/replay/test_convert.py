"""`steelnb convert` and `steelnb info`."""

import numpy as np
import pytest

from steelnb.errors import FileMissingError, OutputError, RecordingError, SettingsError, UnsupportedFormatError
from steelnb.recordings import read_cloud
from steelnb.recordings.formats import open_recording, save_recording
from steelnb.recordings.points import read_points
from steelnb.recordings.trajectories import read_trajectory, read_tum, write_tum
from steelnb.replay.convert import convert
from steelnb.replay.describe import describe_recording
from steelnb.replay.simulated import simulated_recording
from tests.replay.flights import made, settings, straight


@pytest.fixture(scope="module")
def recording():
    return simulated_recording(settings(duration_s=2.0), pictures=True)


def test_trajectories_go_round(tmp_path):
    poses = straight(1.7e9 + 0.2 * np.arange(9))
    write_tum(tmp_path / "a.tum", poses)
    for source, target in (("a.tum", "b.csv"), ("b.csv", "c.kitti"), ("c.kitti", "d.tum")):
        lines = convert(tmp_path / source, tmp_path / target)
        assert lines == (f"{tmp_path / target} written: 9 poses",)
    found = read_tum(tmp_path / "d.tum")
    np.testing.assert_allclose(found.stamp_s, poses.stamp_s, atol=1e-6)
    np.testing.assert_allclose(found.T_world_drone, poses.T_world_drone, atol=1e-9)


def test_poses_without_stamps_want_a_rate(tmp_path):
    write_tum(tmp_path / "a.tum", straight(0.2 * np.arange(9)))
    convert(tmp_path / "a.tum", tmp_path / "a.kitti")
    (tmp_path / "times.txt").unlink()
    with pytest.raises(RecordingError, match="a rate"):
        convert(tmp_path / "a.kitti", tmp_path / "b.tum")
    convert(tmp_path / "a.kitti", tmp_path / "b.tum", rate_hz=10.0)
    np.testing.assert_allclose(read_tum(tmp_path / "b.tum").stamp_s, 0.1 * np.arange(9))


@pytest.mark.parametrize(("ending", "tolerance_m"), [(".ply", 0), (".npy", 0), (".laz", 2e-5), (".las", 2e-5)])
def test_clouds_far_from_the_origin_keep_their_coordinates(tmp_path, ending, tolerance_m):
    points = np.array([500_000.125, 5_400_000.25, 300.5]) + np.random.default_rng(0).uniform(0, 10, (50, 3)).round(4)
    np.savetxt(tmp_path / "a.xyz", points, fmt="%.4f")
    lines = convert(tmp_path / "a.xyz", tmp_path / f"b{ending}")
    assert lines[-1].endswith("50 points")
    found = read_points(tmp_path / f"b{ending}")
    np.testing.assert_allclose(np.sort(found, axis=0), np.sort(points, axis=0), atol=tolerance_m + 1e-9)


def test_single_precision_far_from_the_origin_is_refused(tmp_path):
    np.savetxt(tmp_path / "a.xyz", np.array([[5e5, 5e6, 3.0], [5e5, 5e6, 4.0]]))
    with pytest.raises(UnsupportedFormatError, match="single precision"):
        convert(tmp_path / "a.xyz", tmp_path / "b.pcd")
    np.savetxt(tmp_path / "a.xyz", np.array([[5.0, 5, 3], [5, 5, 4]]))
    convert(tmp_path / "a.xyz", tmp_path / "b.pcd")
    assert len(read_cloud(tmp_path / "b.pcd")) == 2


def test_invalid_points_are_dropped_and_said(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[1.0, 2, 3], [np.nan, 0, 0], [4, 5, 6]]))
    convert(tmp_path / "a.npy", tmp_path / "b.ply")
    (tmp_path / "c.xyz").write_text("1 2 3\n1 2 3\n4 5 6\n")
    lines = convert(tmp_path / "c.xyz", tmp_path / "d.npy")
    assert lines[0] == "skipped   1 duplicates and 0 invalid points"
    for file in ("b.ply", "d.npy"):
        assert len(read_points(tmp_path / file)) == 2


def test_recordings_change_their_form_and_keep_what_they_hold(recording, tmp_path):
    save_recording(tmp_path / "a.bag", recording)
    shares = []
    lines = convert(tmp_path / "a.bag", tmp_path / "b.mcap", on_progress=shares.append)
    assert lines[-1] == f"{tmp_path / 'b.mcap'} written: 10 scans, and the truth as {tmp_path / 'b.truth.tum'}"
    assert shares[-1] == pytest.approx(1.0)
    found = open_recording(tmp_path / "b.mcap")
    for mine, theirs in zip(found.scans.walk(), recording.scans.walk(), strict=True):
        np.testing.assert_array_equal(mine.points, theirs.points.astype(np.float32))
    np.testing.assert_allclose(found.poses.T_world_drone, recording.poses.T_world_drone, atol=1e-12)
    lines = convert(tmp_path / "b.mcap", tmp_path / "poses.tum")
    assert lines[-1].endswith("251 poses as recorded")
    np.testing.assert_allclose(read_trajectory(tmp_path / "poses.tum").position, recording.poses.position, atol=1e-12)


@pytest.mark.parametrize(
    ("source", "target", "fault", "words"),
    [
        ("nothing", "b.tum", FileMissingError, "does not exist"),
        ("a.tum", "a.tum", OutputError, "exists already"),
        ("a.tum", "b.ply", UnsupportedFormatError, ".tum, .kitti, .csv"),
        ("a.xyz", "b.tum", UnsupportedFormatError, ".ply, .pcd"),
        ("a.xyz", "b.abc", UnsupportedFormatError, "'.abc'"),
        ("a.txt", "b.tum", UnsupportedFormatError, "no trajectory"),
    ],
)
def test_what_cannot_be_converted(tmp_path, source, target, fault, words):
    write_tum(tmp_path / "a.tum", straight(0.2 * np.arange(3)))
    for name in ("a.xyz", "a.txt"):
        (tmp_path / name).write_text("1 2 3\n4 5 6\n")
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    with pytest.raises(fault, match=words):
        convert(tmp_path / source, tmp_path / target)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_info_says_what_a_recording_holds(recording, tmp_path):
    save_recording(tmp_path / "a.mcap", recording)
    text = "\n".join(describe_recording(open_recording(tmp_path / "a.mcap")))
    for word in (
        "a.mcap: ROS 2 MCAP", "duration  1.8 s, scans from 0.000 to 1.800 s", "10 at 5 Hz, 90 x 120 organised",
        "/tof/points", "in 10 scans read", "251 at 125 Hz", "/odom", "10 of 10 scans have a pose",
        "truth     251 poses",
        "x 0.060, y 0.000, z 0.000 m", "imu       251 at 125 Hz", "pictures  2 at 1 Hz", "skipped   nothing",
    ):  # fmt: skip
        assert word in text, text
    quick = "\n".join(describe_recording(open_recording(tmp_path / "a.mcap"), quick=True))
    assert "in 1 scans read" in quick


def test_info_says_what_a_recording_lacks():
    poses = straight(np.array([0.0, 0.2, 0.4, 0.6, 1.4]))
    recording = made(lambda k: np.zeros((0, 3)) if k % 2 else np.full((2, 3), np.nan), poses=poses)
    recording.skipped["empty cloud"] = 4
    text = "\n".join(describe_recording(recording))
    for word in (
        "none with a point", "0 % of the points valid", "poses: 1 longer than 0.5 s, up to 0.8 s",
        "5 of 8 scans have a pose; the poses are from ", "truth     none", "skipped   4 empty cloud",
    ):  # fmt: skip
        assert word in text, text
    with pytest.raises(SettingsError, match="gap"):
        describe_recording(recording, gap_max_s=float("nan"))
