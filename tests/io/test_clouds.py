"""Reading clouds of every format, and folders of them as flights."""

from pathlib import Path

import laspy
import numpy as np
import open3d
import pytest
import trimesh

from steelnb.core.errors import InputError
from steelnb.io import read_cloud, read_flight, read_trajectory, read_truth, write_tum
from steelnb.io.clouds import read_points
from tests.io.samples import poses

FORMATS = (
    "a.npy", "binary.ply", "text.ply", "binary.pcd", "text.pcd", "compressed.pcd", "a.las", "a.laz", "a.xyz", "a.csv",
)  # fmt: skip
POINTS = np.round(np.random.default_rng(0).normal(size=(400, 3)), 3).astype(np.float32).astype(np.float64)


def save(path: Path, points: np.ndarray = POINTS) -> Path:
    ending, text = path.suffix, path.stem == "text"
    if ending == ".npy":
        np.save(path, points)
    elif ending == ".ply":
        path.write_bytes(trimesh.PointCloud(points).export(file_type="ply", encoding="ascii" if text else "binary"))
    elif ending == ".pcd":
        cloud = open3d.t.geometry.PointCloud(open3d.core.Tensor(points.astype(np.float32)))
        open3d.t.io.write_point_cloud(str(path), cloud, write_ascii=text, compressed=path.stem == "compressed")
    elif ending in (".las", ".laz"):
        file = laspy.create(point_format=6, file_version="1.4")
        file.header.scales = [1e-6] * 3
        file.x, file.y, file.z = points.T
        file.write(str(path))
    else:
        np.savetxt(path, points, fmt="%.9g", delimiter="," if ending == ".csv" else " ")
    return path


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_is_read_exactly_and_truncated_files_are_refused(name: str, tmp_path: Path) -> None:
    path = save(tmp_path / name)
    # LAS is rounded to its scale, text to nine digits.
    rounded = {".las": 5e-7, ".laz": 5e-7, ".xyz": 1e-8, ".csv": 1e-8}
    exact = rounded.get(path.suffix, 1e-7 if path.stem == "text" else 0.0)
    np.testing.assert_allclose(read_points(path), POINTS, rtol=0, atol=exact)
    if path.suffix not in (".xyz", ".csv"):  # these have no header with the number of points
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        with pytest.raises(InputError, match=rf"{path.name}: not a {path.suffix[1:].upper()} file of points: "):
            read_points(path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", b"", "not a PLY file of points"),
        ("a.pcd", b"nonsense", "not a PCD file of points"),
        ("a.laz", b"LASF" + bytes(400), "not a LAZ file of points"),
        ("a.npy", b"\x93NUMPY", "not a NPY file of points"),
        ("a.xyz", b"1 2 3\n4 five 6\n", "not a XYZ file of points"),
        ("a.csv", b"1 2\n", "not a CSV file of points: 2 numbers in line 1"),
        ("a.e57", b"", r"ending '.e57'; expected one of .npy, .ply"),
        ("a.txt", b"1 2 3\n1 2 3\nnan 1 2\n", "1 distinct finite points of 3; expected at least two"),
    ],
)
def test_invalid_files_are_named_in_the_error(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=rf"{name}: .*{message}") as refused:
        read_cloud(tmp_path / name)
    assert "\n" not in str(refused.value)


def test_invalid_and_duplicate_points_are_dropped_and_map_coordinates_shifted(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.concatenate([POINTS, POINTS[:5], [[np.nan, 0, 0], [0, np.inf, 0]]]))
    cloud = read_cloud(tmp_path / "a.npy")
    assert (len(cloud), cloud.duplicates, cloud.invalid) == (len(POINTS), 5, 2)
    assert not cloud.origin.any()
    np.save(tmp_path / "b.npy", POINTS + np.array([299_100.0, 2_801_400.0, 1_900.0]))
    far = read_cloud(tmp_path / "b.npy")
    np.testing.assert_array_equal(far.origin, [299_100.0, 2_801_400.0, 1_900.0])
    np.testing.assert_allclose(far.points, POINTS, atol=1e-6)


def test_a_cloud_in_millimetres_is_refused_and_a_large_one_in_metres_is_read(tmp_path: Path) -> None:
    np.save(tmp_path / "tower.npy", 1000 * POINTS)
    with pytest.raises(InputError, match=r"tower.npy: a spacing of .* over .* looks like millimetres; expected"):
        read_cloud(tmp_path / "tower.npy")
    line = np.random.default_rng(1).uniform(
        0, [2000, 1, 1], (20_000, 3)
    )  # a power line of 2 km with points 0.2 m apart
    np.save(tmp_path / "line.npy", line)
    assert len(read_cloud(tmp_path / "line.npy")) == 20_000


def test_scans_keep_their_rows_and_their_invalid_points(tmp_path: Path) -> None:
    rows = POINTS.reshape(20, 20, 3).copy()
    rows[3, 4, 1] = np.inf
    np.save(tmp_path / "a.npy", rows)
    read = read_points(tmp_path / "a.npy")
    assert read.shape == rows.shape
    assert np.isnan(read[3, 4]).all()
    assert np.isnan(read).sum() == 3


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Ten clouds, shifted by their numbers, and ten poses."""
    for k in range(10, 0, -1):
        np.save(tmp_path / f"scan{k}.npy", POINTS + k)
    write_tum(tmp_path / "trajectory.tum", poses(10))
    return tmp_path


def test_a_folder_of_clouds_is_sorted_by_the_numbers_in_the_names(folder: Path) -> None:
    write_tum(folder / "groundtruth.tum", poses(10, seed=5))
    flight = read_flight(folder)
    np.testing.assert_array_equal(flight.prior.stamp_s, poses(10).stamp_s)
    for k, scan in enumerate(flight.scans, 1):
        np.testing.assert_array_equal(scan.points, POINTS + k)
    np.testing.assert_allclose(read_truth(folder).T_world_drone, poses(10, seed=5).T_world_drone, atol=1e-12)
    assert read_truth(folder, truth="trajectory.tum") is not None


@pytest.mark.parametrize("begin_s", [0.0, 1_700_000_000.0])
def test_stamps_are_read_from_the_names(folder: Path, begin_s: float) -> None:
    for k in range(1, 11):
        stamp_s = begin_s + 0.2 * (k - 1)
        name = f"{round(stamp_s * 1e9):019d}" if begin_s else f"scan_{stamp_s:.3f}"
        (folder / f"scan{k}.npy").rename(folder / f"{name}.npy")
    write_tum(folder / "trajectory.tum", poses(40, step_s=0.05, begin_s=begin_s))
    flight = read_flight(folder)
    np.testing.assert_allclose(flight.prior.stamp_s, begin_s + 0.2 * np.arange(10), atol=1e-6)
    np.testing.assert_array_equal(flight.scans[9].points, POINTS + 10)


def test_a_broken_file_is_a_scan_with_a_fault(folder: Path) -> None:
    (folder / "scan3.npy").write_bytes(b"broken")
    faults = [scan.fault for scan in read_flight(folder).scans]
    assert [k for k, fault in enumerate(faults) if fault] == [2]
    assert "scan3.npy: not a NPY file of points" in faults[2]


def test_folders_without_one_trajectory_or_clouds_are_refused(folder: Path) -> None:
    write_tum(folder / "other.tum", poses(3))
    with pytest.raises(InputError, match=r"other.tum, trajectory.tum; expected one TUM file"):
        read_flight(folder)
    with pytest.raises(InputError, match=r"10 clouds, no stamps in their names, and 3 poses in other.tum"):
        read_flight(folder, poses="other.tum")
    assert len(read_flight(folder, poses="trajectory.tum")) == 10
    (folder / "sub").mkdir()
    with pytest.raises(InputError, match=r"sub: no clouds in it"):
        read_flight(folder, scans="sub")


def test_a_written_trajectory_is_read_by_us_and_by_evo(tmp_path: Path) -> None:
    from evo.tools.file_interface import read_tum_trajectory_file

    written = poses(20, begin_s=1_700_000_000.0)
    write_tum(tmp_path / "a.tum", written)
    read = read_trajectory(tmp_path / "a.tum")
    np.testing.assert_array_equal(read.stamp_s, written.stamp_s)
    np.testing.assert_allclose(read.T_world_drone, written.T_world_drone, atol=1e-12)
    np.testing.assert_allclose(read_tum_trajectory_file(str(tmp_path / "a.tum")).poses_se3, written.T_world_drone)


def test_invalid_poses_are_dropped_and_files_without_valid_poses_refused(tmp_path: Path) -> None:
    lines = ["# stamp x y z qx qy qz qw", "2 1 0 0 0 0 0 2", "1 0 0 0 0 0 0 1", "1 5 0 0 0 0 0 1", "3 nan 0 0 0 0 0 1"]
    (tmp_path / "a.tum").write_text("\n".join([*lines, "4 0 0 0 0 0 0 0"]))
    read = read_trajectory(tmp_path / "a.tum")
    np.testing.assert_array_equal(read.stamp_s, [1.0, 2.0])
    np.testing.assert_array_equal(read.position[:, 0], [0.0, 1.0])
    for content, message in (
        ("4 0 0 0 0 0 0 0", "1 poses, none valid"),
        ("1 2 3", "3 numbers per line"),
        ("a b", "TUM"),
    ):
        (tmp_path / "b.tum").write_text(content)
        with pytest.raises(InputError, match=message):
            read_trajectory(tmp_path / "b.tum")
