"""Folders of clouds and of depth images as others lay them out, and everything that can be wrong with them."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from steelnb.errors import InputError
from steelnb.io import read_flight, read_truth, write_tum
from steelnb.io.clouds import write_ply
from tests.io.samples import poses
from tests.io.test_clouds import by_laspy, by_pcl

CAMERA = "[intrinsics]\nfx = 500.0\nfy = 400.0\ncx = 319.5\ncy = 239.5\n"
# A camera that looks north (world y) from 2 m up: its x is east, its y down, its z north.
T_WORLD_OPTICAL = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 2], [0, 0, 0, 1.0]])
# The world of 7-Scenes has the axes of a camera held level, so this one is a metre above its origin.
T_LEVEL = np.array([[1, 0, 0, 0], [0, 1, 0, -1], [0, 0, 1, 0], [0, 0, 0, 1.0]])


WRITE = {".npy": np.save, ".ply": write_ply, ".pcd": by_pcl, ".las": by_laspy, ".laz": by_laspy}


def laid_out(folder: Path, names: list[str], count: int = 5) -> Path:
    """A folder with a cloud under each name, all of its numbers k + 1, and as many poses, 0.1 s apart from 10 s."""
    folder.mkdir()
    for k, name in enumerate(names):
        WRITE[Path(name).suffix](folder / name, np.full((3, 3), k + 1.0))
    write_tum(folder / "poses.txt", poses(count, 0.1, 10.0))
    return folder


def firsts(folder: Path) -> list[float]:
    return [scan.points[0, 0] for scan in read_flight(folder).scans]


@pytest.mark.parametrize("ending", WRITE)
def test_clouds_of_every_format_are_scans(tmp_path, ending):
    folder = laid_out(tmp_path / "a", [f"{k}{ending}" for k in (9, 10, 11, 12, 13)])
    (folder / "settings.toml").write_text("[extrinsics]\ntranslation_m = [0.1, 0, 0]\n")
    flight = read_flight(folder)
    assert [scan.points[0, 0] for scan in flight.scans] == pytest.approx([1, 2, 3, 4, 5])  # 9 before 10
    np.testing.assert_allclose(flight.prior.T_world_drone, poses(5).T_world_drone, atol=1e-12)
    assert flight.T_drone_sensor[0, 3] == 0.1
    assert (flight.name, flight.facts["form"], flight.skipped) == ("a", "folder of clouds", {})
    assert read_truth(folder) is None


def test_broken_and_missing_files_are_scans_with_a_fault(tmp_path):
    folder = laid_out(tmp_path / "a", [f"{k}.ply" for k in range(5)])
    (folder / "1.ply").write_bytes((folder / "1.ply").read_bytes()[:-5])
    (folder / "3.ply").write_bytes(b"")
    flight = read_flight(folder)
    (folder / "4.ply").unlink()
    for _ in range(2):
        scans = list(flight.scans)
        assert [len(scan.points) for scan in scans] == [3, 0, 3, 0, 0]
        faults = [scan.fault.partition(":")[0] for scan in scans]
        assert faults == ["", "unreadable scan", "", "unreadable scan", "missing file"]
        assert "1.ply" in scans[1].fault
    assert flight.skipped == {}


@pytest.mark.parametrize("name", ["stamps.csv", "timestamps.txt", "times.txt"])
def test_stamps_from_a_file(tmp_path, name):
    folder = laid_out(tmp_path / "a", ["scan9.npy", "scan10.npy", "scan11.npy"])
    (folder / name).write_text("#stamp\n10.0\n10.1\n10.3\n")
    np.testing.assert_allclose(read_flight(folder).prior.stamp_s, [10.0, 10.1, 10.3])
    (folder / name).write_text("10.0,scan11.npy\n10.1,scan9.npy\n10.4,scan10.npy\n")
    assert firsts(folder) == [1, 2]  # 10.1, 10.4; then 10.0 is late
    assert read_flight(folder).skipped == {"time ran backwards": 1}
    (folder / name).write_text("10.0\n10.1\n")
    with pytest.raises(InputError, match="2 stamps; expected 3"):
        read_flight(folder)
    (folder / name).write_text("10.0\nten\n10.2\n")
    with pytest.raises(InputError, match="not a file of stamps: could not convert string to float: 'ten'"):
        read_flight(folder)


def test_stamps_from_names_and_from_the_trajectory(tmp_path):
    folder = laid_out(tmp_path / "named", ["cloud_10.15.npy", "cloud_10.05.npy"])
    np.testing.assert_array_equal(read_flight(folder).prior.stamp_s, [10.05, 10.15])
    assert firsts(folder) == [2, 1]
    assert firsts(laid_out(tmp_path / "counted", [f"{k}.npy" for k in range(5)])) == [1, 2, 3, 4, 5]
    with pytest.raises(InputError, match="4 clouds without stamps, 5 poses"):
        read_flight(laid_out(tmp_path / "fewer", [f"{k}.npy" for k in range(4)]))


def test_trajectories_are_found_by_content_and_the_truth_by_name(tmp_path):
    folder = laid_out(tmp_path / "a", [f"{k}.npy" for k in range(5)])
    (folder / "notes.txt").write_text("flown by hand\n")
    write_tum(folder / "groundtruth.txt", poses(5, 0.1, 10.0, seed=1))
    assert read_flight(folder).facts["poses"].startswith("poses.txt")
    np.testing.assert_allclose(read_truth(folder).position, poses(5, seed=1).position)
    write_tum(tmp_path / "a.truth.tum", poses(5, 0.1, 10.0, seed=2))
    np.testing.assert_allclose(read_truth(folder).position, poses(5, seed=2).position)
    np.testing.assert_allclose(read_truth(folder, truth="poses.txt").position, poses(5).position)
    (folder / "other.tum").write_bytes((folder / "poses.txt").read_bytes())
    with pytest.raises(InputError, match=r"several files hold poses: other.tum, poses.txt"):
        read_flight(folder)
    assert len(read_flight(folder, poses="other.tum")) == 5
    with pytest.raises(InputError, match="no such file, here or in"):
        read_flight(folder, poses="gone.tum")
    for name in ("other.tum", "poses.txt"):
        (folder / name).unlink()
    assert read_flight(folder).facts["poses"].startswith("true poses")
    (folder / "groundtruth.txt").unlink()
    with pytest.raises(InputError, match="no trajectory"):
        read_flight(folder)


def test_sub_folders_and_endings_that_are_not_clear_are_listed(tmp_path):
    folder = laid_out(tmp_path / "a", [])
    laid_out(folder / "left", [f"{k}.npy" for k in range(5)])
    assert len(read_flight(folder)) == 5
    laid_out(folder / "right", [f"{k}.npy" for k in range(5)])
    with pytest.raises(InputError, match="clouds in left, right"):
        read_flight(folder)
    assert len(read_flight(folder, scans="right")) == 5
    with pytest.raises(InputError, match=r"no folder 'up' with clouds; expected one of left, right"):
        read_flight(folder, scans="up")
    write_ply(folder / "left" / "1.ply", np.ones((3, 3)))
    with pytest.raises(InputError, match=r"end with .npy, .ply"):
        read_flight(folder, scans="left")


def png(path: Path, depth: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(depth).save(path)


def tum(folder: Path, unit: float = 5000, size: tuple[int, int] = (480, 640)) -> Path:
    """Three images, 2 m deep everywhere but in a corner; poses of a camera that looks north, as TUM writes them."""
    lines = []
    for k in range(3):
        depth = np.full(size, 2 * unit, np.uint16)
        depth[0, 0] = 0
        png(folder / "depth" / f"{k}.png", depth)
        lines.append(f"{100 + 0.1 * k:.6f} depth/{k}.png")
    (folder / "depth.txt").write_text("# depth maps\n# timestamp filename\n" + "\n".join(lines) + "\n")
    quaternion = " ".join(map(repr, Rotation.from_matrix(T_WORLD_OPTICAL[:3, :3]).as_quat().tolist()))
    rows = [f"{99.95 + 0.1 * k} 0 0 2 {quaternion}" for k in range(5)]
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n")
    return folder


def scenes(folder: Path, frames: int = 4) -> Path:
    """7-Scenes: millimetres, poses beside, one pixel of each kind of nothing."""
    for k in range(frames):
        depth = np.full((480, 640), 2000, np.uint16)
        depth[0, 0], depth[0, 1] = 0, 65535
        png(folder / f"frame-{k:06d}.depth.png", depth)
        np.savetxt(folder / f"frame-{k:06d}.pose.txt", T_LEVEL, delimiter="\t ")
    return folder


def test_a_known_camera_sees_points_where_they_are(tmp_path):
    folder = tum(tmp_path / "a")
    (folder / "settings.toml").write_text(CAMERA)
    flight = read_flight(folder)
    points = flight.scans[0].points
    assert np.isnan(points[0, 0]).all()
    np.testing.assert_allclose(points[100, 639], [2, -2 * 319.5 / 500, 2 * 139.5 / 400])  # right is −y, up is z
    T_world_sensor = flight.prior.T_world_drone[0] @ flight.T_drone_sensor
    world = points[100, 639] @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3]
    np.testing.assert_allclose(world, [2 * 319.5 / 500, 2, 2 + 2 * 139.5 / 400], atol=1e-9)  # east, north, above
    np.testing.assert_allclose(read_truth(folder).position, [[0, 0, 2]] * 5, atol=1e-12)
    assert flight.facts["poses"].startswith("true poses, groundtruth.txt")


def test_a_mount_moves_poses_and_truth_to_the_drone(tmp_path):
    folder, mount = tum(tmp_path / "a"), tmp_path / "mount.toml"
    mount.write_text(CAMERA + "[extrinsics]\ntranslation_m = [0.1, 0.0, -0.05]\nrotation_rpy_deg = [0, 20, 90]\n")
    flight = read_flight(folder, settings=mount)
    T_world_sensor = flight.prior.T_world_drone @ flight.T_drone_sensor
    np.testing.assert_allclose(T_world_sensor[0, :3, 0], [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(T_world_sensor[0, :3, 3], [0, 0, 2], atol=1e-9)
    true = read_truth(folder, settings=mount).T_world_drone  # it stands still
    np.testing.assert_allclose(true[:3], flight.prior.T_world_drone, atol=1e-9)


def test_tum_sequences_have_published_intrinsics(tmp_path):
    for name, fx in (("rgbd_dataset_freiburg1_xyz", 517.3), ("rgbd_dataset_freiburg3_desk", 535.4), ("mine", 525)):
        assert f"fx {fx}" in read_flight(tum(tmp_path / name)).facts["intrinsics"]
    folder = tum(tmp_path / "other_size", size=(120, 160))
    with pytest.raises(InputError, match=r"160 × 120 pixels; expected 640 × 480, .* others want \[intrinsics\]"):
        read_flight(folder)
    (folder / "settings.toml").write_text(CAMERA)
    assert "settings.toml" in read_flight(folder).facts["intrinsics"]
    (folder / "settings.toml").write_text(CAMERA + "width = 320\nheight = 240\n")
    with pytest.raises(InputError, match="160 × 120 pixels; expected 320 × 240"):
        read_flight(folder)


def test_named_poses_leave_the_true_ones_to_judge_by(tmp_path):
    folder = tum(tmp_path / "a")
    write_tum(folder / "odometry.txt", poses(5, 0.1, 99.95))
    assert read_flight(folder, poses="odometry.txt").facts["poses"].startswith("odometry.txt")
    np.testing.assert_allclose(read_truth(folder).position, [[0, 0, 2]] * 5, atol=1e-12)
    (folder / "groundtruth.txt").unlink()
    assert read_truth(folder) is None
    with pytest.raises(InputError, match="no poses; expected"):
        read_flight(folder)


def test_seven_scenes(tmp_path):
    folder = scenes(tmp_path / "a")
    flight = read_flight(folder)
    points = flight.scans[1].points
    assert np.isnan(points[0, :2]).all()
    assert np.isfinite(points[0, 2:]).all()
    np.testing.assert_allclose(points[..., 0][1:], 2.0)
    np.testing.assert_allclose(flight.prior.stamp_s, np.arange(4) / 30)
    np.testing.assert_allclose(flight.prior.T_world_drone[0], [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]])
    np.testing.assert_allclose(read_truth(folder).T_world_drone, flight.prior.T_world_drone)
    (folder / "frame-000002.pose.txt").unlink()
    flight = read_flight(folder)
    assert len(flight) == 4  # the third pose is interpolated
    assert flight.skipped == {"missing pose file": 1}
    (folder / "frame-000001.pose.txt").write_text("1 2 3")
    with pytest.raises(InputError, match=r"frame-000001.pose.txt: not the 16 numbers"):
        read_flight(folder)


def test_colour_images_of_seven_scenes_are_those_of_a_camera(tmp_path):
    folder = scenes(tmp_path / "a")
    assert read_flight(folder).images is None
    assert read_flight(folder).facts["images"].startswith("none: no frame-000000.color.jpg")
    colours = np.full((480, 640, 3), (200, 100, 50), np.uint8)
    colours[:, 400:] = 30
    for k in (0, 2):
        Image.fromarray(colours).save(folder / f"frame-{k:06d}.color.jpg", quality=100)
    Image.fromarray(colours[:240]).save(folder / "frame-000003.color.png")
    flight = read_flight(folder)
    images = flight.images
    np.testing.assert_allclose(images.stamp_s, [0, 2 / 30, 3 / 30])
    assert [images.at(stamp_s) for stamp_s in flight.prior.stamp_s] == [0, None, 1, 2]
    np.testing.assert_array_equal(images.K, [[585, 0, 320], [0, 585, 240], [0, 0, 1]])
    np.testing.assert_array_equal(images.T_drone_camera, flight.T_drone_sensor)
    assert np.abs(images.images[1][:, :390] - 124.2).max() < 3  # 0.299 · 200 + 0.587 · 100 + 0.114 · 50
    assert np.abs(images.images[1][:, 410:] - 30.0).max() < 3
    assert images.images[2] is None  # of another size


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:200]), "not a 16-bit grey PNG"),
        (lambda path: png(path, np.zeros((480, 640), np.uint8)), "expected a 16-bit grey PNG"),
        (lambda path: png(path, np.ones((48, 64), np.uint16)), "64 × 48 pixels; expected 640 × 480"),
        (lambda path: png(path, np.zeros((480, 640), np.uint16)), "no finite point"),
        (Path.unlink, "missing file"),
    ],
)
def test_bad_images_are_scans_with_a_fault(tmp_path, spoil, says):
    folder = tum(tmp_path / "a")
    spoil(folder / "depth" / "1.png")
    scans = list(read_flight(folder).scans)
    assert [bool(scan.points.size) for scan in scans] == [True, False, True]
    assert says in scans[1].fault
