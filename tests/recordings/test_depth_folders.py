"""Depth images: known cameras, round trips, the layouts of TUM RGB-D and 7-Scenes, and what can be wrong with them."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from steelnb.errors import FileContentError, FileMissingError, RecordingError, SettingsError, SteelnbError
from steelnb.recordings.depth_images import camera_of_scans, read_camera
from steelnb.recordings.formats import Choice, open_recording, save_recording
from steelnb.recordings.images import read_depth, write_png
from steelnb.recordings.trajectories import write_tum
from tests.recordings.folder_samples import COLUMNS, ROWS, finite, flown, pinhole

HALF_STEP_M = {"tum-rgbd": 0.0001, "7-scenes": 0.0005}
CAMERA = "[intrinsics]\nfx = 500.0\nfy = 400.0\ncx = 319.5\ncy = 239.5\n"
# A camera that looks north (world y) from 2 m up: its x is east, its y down, its z north.
T_WORLD_OPTICAL = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 2], [0, 0, 0, 1.0]])

# The world of 7-Scenes has the axes of a camera held level, so this one is a metre above its origin.
T_LEVEL = np.array([[1, 0, 0, 0], [0, 1, 0, -1], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def tum(folder: Path, unit: float = 5000, size: tuple[int, int] = (480, 640)) -> Path:
    """Three images, 2 m deep everywhere but in a corner; poses of a camera that looks north, as TUM writes them."""
    (folder / "depth").mkdir(parents=True)
    lines = []
    for k in range(3):
        depth = np.full(size, 2 * unit, np.uint16)
        depth[0, 0] = 0
        write_png(folder / "depth" / f"{k}.png", depth)
        lines.append(f"{100 + 0.1 * k:.6f} depth/{k}.png")
    (folder / "depth.txt").write_text("# depth maps\n# timestamp filename\n" + "\n".join(lines) + "\n")
    quaternion = " ".join(map(repr, Rotation.from_matrix(T_WORLD_OPTICAL[:3, :3]).as_quat().tolist()))
    poses = [f"{99.95 + 0.1 * k} 0 0 2 {quaternion}" for k in range(5)]
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(poses) + "\n")
    return folder


def scenes(folder: Path, frames: int = 4) -> Path:
    """7-Scenes: millimetres, poses beside, one pixel of each kind of nothing."""
    folder.mkdir()
    for k in range(frames):
        depth = np.full((480, 640), 2000, np.uint16)
        depth[0, 0], depth[0, 1] = 0, 65535
        write_png(folder / f"frame-{k:06d}.depth.png", depth)
        write_png(folder / f"frame-{k:06d}.color.png", np.full((480, 640, 3), (250, k, 3), np.uint8))
        np.savetxt(folder / f"frame-{k:06d}.pose.txt", T_LEVEL, delimiter="\t ")
    return folder


@pytest.mark.parametrize("form", HALF_STEP_M)
def test_round_trips_are_true_to_half_a_step_of_depth(tmp_path: Path, form: str) -> None:
    recording = pinhole(begin_s=1.6e9, pictures=True)
    save_recording(tmp_path / "flight", recording, form)
    again = open_recording(tmp_path / "flight")
    np.testing.assert_allclose(again.scans.stamp_s, recording.scans.stamp_s, rtol=0, atol=1e-9)
    for scan, other in zip(recording.scans.walk(), again.scans.walk(), strict=True):
        assert other.points.shape == (ROWS, COLUMNS, 3)
        np.testing.assert_array_equal(np.isnan(other.points), np.isnan(scan.points))
        off = np.abs(finite(other.points) - finite(scan.points))
        assert off[:, 0].max() <= 1.0001 * HALF_STEP_M[form]
        assert off.max() < 2 * HALF_STEP_M[form]  # aside, at the edges of a view of 117°
        assert off[:, 0].max() > 0.5 * HALF_STEP_M[form]
    np.testing.assert_allclose(again.poses.T_world_drone, recording.poses.T_world_drone, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.poses.stamp_s, recording.poses.stamp_s, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.T_drone_sensor, recording.T_drone_sensor, rtol=0, atol=1e-12)
    assert again.truth is not None
    assert recording.truth is not None
    np.testing.assert_allclose(again.truth.T_world_drone, recording.truth.T_world_drone, rtol=0, atol=1e-9)
    assert again.facts["poses"] == "trajectory.txt"
    assert again.imu is not None
    assert recording.imu is not None
    np.testing.assert_array_equal(again.imu.specific_force, recording.imu.specific_force)
    if form == "tum-rgbd":
        assert again.pictures is not None
        assert recording.pictures is not None
        for picture, other_picture in zip(recording.pictures.walk(), again.pictures.walk(), strict=True):
            np.testing.assert_array_equal(other_picture.pixels, picture.pixels)


def test_without_a_truth_what_we_wrote_has_none(tmp_path: Path) -> None:
    recording = pinhole()
    object.__setattr__(recording, "truth", None)
    for form in HALF_STEP_M:
        save_recording(tmp_path / form, recording, form)
        assert open_recording(tmp_path / form).truth is None


def test_a_known_camera_sees_points_where_they_are(tmp_path: Path) -> None:
    folder = tum(tmp_path / "a")
    (folder / "settings.toml").write_text(CAMERA)
    recording = open_recording(folder)
    (first, *_) = recording.scans.walk()
    assert np.isnan(first.points[0, 0]).all()
    np.testing.assert_allclose(first.points[100, 639], [2, -2 * 319.5 / 500, 2 * 139.5 / 400])  # right is −y, up is z
    np.testing.assert_allclose(recording.truth.position if recording.truth else 0, recording.poses.position)
    flight = recording.flight()
    assert len(flight.scans) == 3
    T_world_sensor = flight.prior.T_world_drone[0] @ flight.T_drone_sensor
    world = first.points[100, 639] @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3]
    np.testing.assert_allclose(world, [2 * 319.5 / 500, 2, 2 + 2 * 139.5 / 400], atol=1e-9)  # east, north, above


def test_extrinsics_move_the_poses_to_the_drone(tmp_path: Path) -> None:
    folder = tum(tmp_path / "a")
    mount = tmp_path / "mount.toml"
    mount.write_text(CAMERA + "[extrinsics]\ntranslation_m = [0.1, 0.0, -0.05]\nrotation_rpy_deg = [0, 20, 90]\n")
    recording = open_recording(folder, Choice(settings=mount))
    T_world_sensor = recording.poses.T_world_drone @ recording.T_drone_sensor
    np.testing.assert_allclose(T_world_sensor[0, :3, 0], [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(T_world_sensor[0, :3, 3], [0, 0, 2], atol=1e-9)


def test_tum_sequences_have_published_intrinsics(tmp_path: Path) -> None:
    for name, fx in (("rgbd_dataset_freiburg1_xyz", 517.3), ("rgbd_dataset_freiburg3_desk", 535.4), ("mine", 525)):
        recording = open_recording(tum(tmp_path / name))
        assert f"fx {fx}" in recording.facts["intrinsics"]
        assert "published default" in recording.facts["intrinsics"]
        assert recording.facts["poses"] == "true poses"
        assert recording.truth is recording.poses
        assert len(recording.flight().scans) == 3
    folder = tum(tmp_path / "other_size", size=(120, 160))
    with pytest.raises(SettingsError, match="no intrinsics for images of 160 × 120 pixels"):
        open_recording(folder)
    (folder / "camera.txt").write_text("# fx fy cx cy\n130 130 80 60 160 120\n")
    assert "camera.txt" in open_recording(folder).facts["intrinsics"]
    (folder / "camera.txt").write_text("130 130 80 60 320 240\n")
    with pytest.raises(SettingsError, match="320 × 240 pixels; expected the images' 160 × 120"):
        open_recording(folder)


def test_poses_named_beside_true_ones_leave_these_to_judge_by(tmp_path: Path) -> None:
    folder = tum(tmp_path / "a")
    write_tum(folder / "odometry.txt", flown(5, 0.1, 99.95))
    recording = open_recording(folder, Choice(poses="odometry.txt"))
    assert recording.facts["poses"] == "odometry.txt"
    assert recording.truth is not None
    np.testing.assert_allclose(recording.truth.position, np.tile([0, 0, 2], (5, 1)), atol=1e-9)
    assert np.abs(recording.poses.position - recording.truth.position).max() > 1


def test_seven_scenes(tmp_path: Path) -> None:
    recording = open_recording(scenes(tmp_path / "seq-01"))
    np.testing.assert_allclose(recording.scans.stamp_s, np.arange(4) / 30)
    assert recording.truth is recording.poses
    assert "fx 585" in recording.facts["intrinsics"]
    scan = next(recording.scans.walk())
    assert np.isnan(scan.points[0, :2]).all()
    np.testing.assert_allclose(scan.points[240, 0], [2, 2 * 320 / 585, 0])
    np.testing.assert_allclose(recording.poses.T_world_drone[0, :3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(recording.poses.position, np.tile([0, 0, 1], (4, 1)), atol=1e-12)  # z is up
    assert recording.pictures is not None
    assert [picture.pixels[0, 0].tolist() for picture in recording.pictures.walk()] == [[250, k, 3] for k in range(4)]


def test_the_poses_beside_the_frames_are_those_at_their_stamps(tmp_path: Path) -> None:
    recording = pinhole()
    save_recording(tmp_path / "flight", recording, "7-scenes")
    for name in ("trajectory.txt", "timestamps.txt"):
        (tmp_path / "flight" / name).unlink()
    again = open_recording(tmp_path / "flight")
    np.testing.assert_allclose(again.poses.T_world_drone, recording.flight().prior.T_world_drone, rtol=0, atol=1e-9)


def test_frames_without_a_pose_or_with_a_broken_one(tmp_path: Path) -> None:
    folder = scenes(tmp_path / "a", 5)
    (folder / "frame-000001.pose.txt").unlink()
    np.savetxt(folder / "frame-000002.pose.txt", np.full((4, 4), np.inf))
    np.savetxt(folder / "frame-000003.pose.txt", np.zeros((4, 4)))
    recording = open_recording(folder)
    assert len(recording.poses) == 2
    assert len(recording.scans.stamp_s) == 5
    assert recording.skipped == {"missing pose file": 1, "pose not finite": 1, "pose whose matrix is no rotation": 1}
    (folder / "frame-000003.pose.txt").write_text("1 0 0 0\n0 1 0\n")
    with pytest.raises(FileContentError, match=r"frame-000003\.pose\.txt, line 2"):
        open_recording(folder)


def test_broken_images_are_counted_skips(tmp_path: Path) -> None:
    folder = tum(tmp_path / "a")
    whole = (folder / "depth" / "0.png").read_bytes()
    (folder / "depth" / "0.png").write_bytes(whole[: len(whole) // 2])
    (folder / "depth" / "1.png").unlink()
    recording = open_recording(folder)
    assert [scan.points.shape for scan in recording.scans.walk()] == [(0, 3), (0, 3), (480, 640, 3)]
    assert recording.skipped == {"unreadable file": 1, "missing file": 1}
    Image.new("RGB", (640, 480)).save(folder / "depth" / "1.png")
    Image.new("I;16", (64, 48)).save(folder / "depth" / "0.png")
    recording = open_recording(folder, Choice(settings=_settings(tmp_path)))
    assert recording.facts["images"] == "64 × 48"
    write_png(folder / "depth" / "2.png", np.zeros((480, 640), np.uint16))
    recording = open_recording(folder, Choice(settings=_settings(tmp_path)))
    for _ in range(2):
        assert [len(finite(scan.points)) for scan in recording.scans.walk()] == [0, 0, 0]
    assert recording.skipped == {"unreadable file": 1, "no finite point": 2}


def _settings(tmp_path: Path) -> Path:
    path = tmp_path / "camera.toml"
    path.write_text(CAMERA)
    return path


def test_what_is_missing_is_one_line(tmp_path: Path) -> None:
    folder = tum(tmp_path / "a")
    text = (folder / "depth.txt").read_text()
    (folder / "depth.txt").write_text(text + "100.5\n")
    with pytest.raises(FileContentError, match="without a file"):
        open_recording(folder)
    (folder / "depth.txt").write_text(text + "soon depth/3.png\n")
    with pytest.raises(FileContentError, match=r"line 6: 'soon depth/3\.png'"):
        open_recording(folder)
    (folder / "depth.txt").write_text("# none\n")
    with pytest.raises(SteelnbError, match="lists no images"):
        open_recording(folder)
    (folder / "depth.txt").write_text(text)
    (folder / "groundtruth.txt").unlink()
    with pytest.raises(RecordingError, match="no poses"):
        open_recording(folder)
    with pytest.raises(FileMissingError, match=r"none\.toml"):
        open_recording(folder, Choice(settings=tmp_path / "none.toml"))


def test_scans_that_no_camera_took_are_not_written_as_images(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for points in (5 + rng.normal(size=(ROWS, COLUMNS, 3)), rng.normal(size=(100, 3))):
        recording = pinhole(1)
        object.__setattr__(recording.scans.items[0], "points", points)  # type: ignore[attr-defined]
        with pytest.raises(RecordingError, match="pinhole"):
            save_recording(tmp_path / "flight", recording, "tum-rgbd")
    assert list(tmp_path.iterdir()) == []


def test_points_too_far_for_sixteen_bits_are_counted(tmp_path: Path) -> None:
    recording = pinhole(1)
    points = recording.scans.items[0].points  # type: ignore[attr-defined]
    points[0] *= 20.0 / np.nanmin(points[0, :, 0])
    far = len(finite(points[0]))
    save_recording(tmp_path / "flight", recording, "tum-rgbd")
    assert recording.skipped == {"point beyond 13.1 m, not written": far}
    (scan,) = open_recording(tmp_path / "flight").scans.walk()
    assert len(finite(scan.points)) == len(finite(points)) - far


def test_the_camera_is_that_of_the_points() -> None:
    camera = camera_of_scans(Path("a"), pinhole(2).scans)
    assert camera.width == COLUMNS
    assert camera.fx == pytest.approx(COLUMNS / 2 / np.tan(1.02))
    assert (camera.cx, camera.cy) == (pytest.approx(COLUMNS / 2 - 0.5), pytest.approx(ROWS / 2 - 0.5))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 2 3", "3 numbers"),
        ("a b c d", "line 1"),
        ("0 1 2 3", "fx = 0"),
        ("1 1 nan 3", "cx = nan"),
        ("", "0 numbers"),
    ],
)
def test_bad_cameras_are_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "camera.txt").write_text(text)
    with pytest.raises(SettingsError, match=words):
        read_camera(tmp_path / "camera.txt")
    (tmp_path / "camera.txt").write_text("500 0 320\n0 510 240\n0 0 1\n")
    camera = read_camera(tmp_path / "camera.txt")
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500, 510, 320, 240)


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fuzz")
    write_png(folder / "whole.png", np.arange(70, dtype=np.uint16).reshape(7, 10) * 900)
    return folder


@settings(max_examples=3000, deadline=None)
@given(st.data())
def test_damaged_images_give_depths_or_an_error_of_ours(scratch: Path, data: st.DataObject) -> None:
    content = bytearray((scratch / "whole.png").read_bytes())
    for _ in range(data.draw(st.integers(0, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    (scratch / "a.png").write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        depth = read_depth(scratch / "a.png")
    except SteelnbError:
        return
    assert depth.dtype == np.uint16
    assert depth.ndim == 2
