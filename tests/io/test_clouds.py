"""Reading clouds of every format."""

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import open3d
import pytest
import trimesh

from steelnb.core.errors import InputError
from steelnb.io import read_cloud
from steelnb.io.clouds import read_points

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
        ("a.npy", b"\x93NUMPY", "not a NPY file of points"),
        ("a.e57", b"", r"ending '.e57'; expected one of .npy, .npz, .ply"),
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


def test_map_coordinates_in_single_precision_are_refused(tmp_path: Path) -> None:
    tower = np.random.default_rng(1).uniform(0, [3, 3, 16], (500, 3)) + np.array([456_789.0, 5_412_345.0, 100.0])
    np.save(tmp_path / "a.npy", tower.astype(np.float32))
    np.savetxt(tmp_path / "b.xyz", tower, fmt="%.1f")
    for name, step in (("a.npy", "x is around 456790 in steps of 0.0312"), ("b.xyz", "in steps of 0.1 m")):
        with pytest.raises(InputError, match=f"{name}: .*{step}.*; expected doubles"):
            read_cloud(tmp_path / name)
    np.savetxt(tmp_path / "c.xyz", tower, fmt="%.2f")
    assert len(read_cloud(tmp_path / "c.xyz")) == 500


def test_a_cloud_in_millimetres_is_refused_and_a_large_one_in_metres_is_read(tmp_path: Path) -> None:
    np.save(tmp_path / "tower.npy", 1000 * POINTS)
    with pytest.raises(InputError, match=r"tower.npy: a spacing of .* over .* looks like millimetres; expected"):
        read_cloud(tmp_path / "tower.npy")
    np.save(tmp_path / "tower.npy", 300 * POINTS)
    with pytest.raises(InputError, match="looks like centimetres or millimetres; expected metres"):
        read_cloud(tmp_path / "tower.npy")
    line = np.random.default_rng(1).uniform(0, [2000, 1, 1], (20_000, 3))  # of power, with points 0.2 m apart
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


@pytest.mark.parametrize(
    ("arrays", "read"),
    [
        ({"arr_0": POINTS}, POINTS), ({"a": POINTS.T}, POINTS), ({"frame": POINTS.reshape(20, 20, 3)}, None),
        ({"points": POINTS, "normals": POINTS + 1, "labels": np.arange(400)}, POINTS),
        ({"P": POINTS, "K": np.arange(9.0)}, POINTS),
        ({"x": POINTS[:, 0], "y": POINTS[:, 1], "z": POINTS[:, 2]}, POINTS),
        ({"a": POINTS, "b": POINTS}, r"arrays a \(400, 3\), b \(400, 3\); expected one of points"),
        ({"points": POINTS, "xyz": POINTS}, "arrays points .*; expected one"), ({}, "arrays none; expected one"),
        ({"a": np.array([{}], dtype=object)}, "not of numbers"), ({"a": np.float64(3)}, r"shape \(\); expected"),
    ],
)  # fmt: skip
def test_an_archive_of_arrays_has_one_of_points(arrays: Any, read: Any, tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    if isinstance(read, str):
        with pytest.raises(InputError, match=f"a.npz: not a NPZ file of points: .*{read}"):
            read_points(tmp_path / "a.npz")
    else:
        np.testing.assert_array_equal(read_points(tmp_path / "a.npz"), arrays["frame"] if read is None else read)


@pytest.mark.parametrize(
    ("shape", "read"),
    [
        ((3, 100), (100, 3)), ((4, 100), (100, 3)), ((100, 6), (100, 3)), ((3, 20, 30), (20, 30, 3)), ((4, 3), (4, 3)),
        ((1, 50, 4), (1, 50, 3)), ((3, 3), None), ((3, 4), None), ((4, 16), None), ((100, 64), None), ((20, 30), None),
        ((3, 10, 10), None), ((3, 10, 3), (3, 10, 3)), ((2, 100), None), ((0, 3), None), ((7,), None),
        ((2, 2, 2, 3), None),
    ],
)  # fmt: skip
def test_arrays_are_read_if_their_shape_is_clear(
    shape: tuple[int, ...], read: tuple[int, ...] | None, tmp_path: Path
) -> None:
    values = np.random.default_rng(0).normal(size=shape)
    np.save(tmp_path / "a.npy", values)
    if read is None:
        with pytest.raises(InputError, match=r"a.npy: not a NPY file of points: (an array of shape|no points)"):
            read_points(tmp_path / "a.npy")
        return
    expected = values if values.shape[-1] <= 16 else np.moveaxis(values, 0, -1)
    np.testing.assert_array_equal(read_points(tmp_path / "a.npy"), expected[..., :3])


def test_arrays_with_names_are_read_and_other_types_refused(tmp_path: Path) -> None:
    named = np.array([(3, 1, 2, 9), (6, 4, 5, 9)], dtype=[("z", "f4"), ("x", "f4"), ("y", "f8"), ("intensity", "u1")])
    np.save(tmp_path / "a.npy", named)
    np.testing.assert_array_equal(read_points(tmp_path / "a.npy"), [[1, 2, 3], [4, 5, 6]])
    np.save(tmp_path / "a.npy", np.array([(1, 2, 3), (4, 5, 6)], dtype=[(axis, "f4") for axis in "XYZ"]))
    np.testing.assert_array_equal(read_points(tmp_path / "a.npy"), [[1, 2, 3], [4, 5, 6]])
    np.save(tmp_path / "a.npy", np.column_stack([np.arange(400.0), POINTS]))
    with pytest.raises(InputError, match="first column counts the lines in steps of 1"):
        read_points(tmp_path / "a.npy")
    pairs = np.zeros(4, dtype=[(axis, "f4", 2) for axis in "xyz"])
    for other in (
        named[["x", "y"]],
        pairs,
        POINTS + 1j,
        POINTS > 0,
        POINTS.astype(str),
        np.array([POINTS, None], object),
    ):
        np.save(tmp_path / "a.npy", other, allow_pickle=True)
        with pytest.raises(InputError, match=r"a.npy: not a NPY file of points: "):
            read_points(tmp_path / "a.npy")


NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
ROW, COLUMN = np.divmod(np.arange(400), 7)


@pytest.mark.parametrize("name", ["a.npy", "a.xyz", "a.csv"])
@pytest.mark.parametrize(
    ("columns", "what"),
    [
        ((ROW, COLUMN, POINTS, ROW % 3), "holds whole numbers"), ((COLUMN, POINTS), "holds whole numbers"),
        ((ROW, COLUMN, 7 * COLUMN, POINTS), "holds whole numbers"), ((1.7e9 + 0.1 * ROW, POINTS), "is around 1.7e.09"),
        ((np.sort(POINTS[:, 0]), POINTS), ""), ((0 * ROW, POINTS), ""), ((ROW, COLUMN, 9 - ROW, NORMALS), ""),
        ((ROW, COLUMN, 3 + POINTS[:, 2], NORMALS), ""), ((ROW, COLUMN, ROW - COLUMN, POINTS), ""),
        ((ROW, POINTS[:, :2], COLUMN), ""), ((POINTS, ROW, ROW, ROW), ""),
    ],
)  # fmt: skip
def test_columns_before_x_y_and_z_are_not_taken_for_them(name: str, columns: tuple, what: str, tmp_path: Path) -> None:
    path = save(tmp_path / name, np.column_stack(columns))
    if not what:
        assert len(read_points(path)) == 400
        return
    with pytest.raises(InputError, match=rf"{name}: .*its first column {what}.*; expected x, y and z first, or names"):
        read_points(path)


def test_a_few_points_kilometres_away_are_left_out_and_counted(tmp_path: Path) -> None:
    survey = np.array([299_100.0, 5_801_400.0, 120.0])
    for name, points, strays in (
        ("zeros", np.concatenate([POINTS + survey, np.zeros((2, 3))]), 1),  # equal ones are duplicates
        ("far", np.concatenate([POINTS, [[1e5, 0, 0], [0, -2e4, 0]]]), 2),
        ("a kilometre", np.concatenate([POINTS, [[1e3, 0, 0]]]), 0),
    ):
        np.save(tmp_path / f"{name}.npy", points)
        cloud = read_cloud(tmp_path / f"{name}.npy")
        assert cloud.strays == strays
        assert len(cloud) + cloud.duplicates + strays == len(points)
        assert np.ptp(cloud.points, axis=0).max() < 2e3


@pytest.mark.parametrize(
    ("value", "survey", "left_out"),
    [
        (-9999, 0, True), (-999, 0, True), (32767, 120, True), (0, 299_100, True), (0, 30, False), (-7777, 0, False),
        (999, 1000, False),
    ],
)  # fmt: skip
def test_a_coordinate_that_stands_for_no_return_is_left_out(
    value: float, survey: float, left_out: bool, tmp_path: Path
) -> None:
    missing = np.column_stack([POINTS[:40, :2] + survey, np.full(40, value)])
    np.save(tmp_path / "a.npy", np.concatenate([1.5 * POINTS + survey, missing]))
    cloud = read_cloud(tmp_path / "a.npy")
    assert (len(cloud), cloud.strays) == ((400, 40) if left_out else (440, 0))


def test_too_many_points_far_from_all_others_are_named(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.concatenate([POINTS, POINTS[:40] + 50_000]))
    with pytest.raises(InputError, match=r"a.npy: 40 of 440 points are more than 10 km from most; expected one site"):
        read_cloud(tmp_path / "a.npy")


def test_a_folder_is_no_file_of_points(tmp_path: Path) -> None:
    for name in ("scans", "scans.ply"):
        (tmp_path / name).mkdir()
        with pytest.raises(InputError, match="a folder; expected a file of points"):
            read_points(tmp_path / name)
