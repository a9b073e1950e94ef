"""Clouds: files written by other programs give the same points, broken files get an error that names them."""

import random
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pandas as pd
import pytest
from plyfile import PlyData, PlyElement

from steelnb.errors import InputError, MissingExtraError, SteelnbError
from steelnb.io import clouds, point_files
from steelnb.io.clouds import read_cloud, read_points, write_ply

UTM = np.array([299119.894, 2801406.927, 1949.952])
COUNTED = (".ply", ".pcd", ".pts", ".las", ".laz", ".npy")
"""Endings of files that say how many points they hold."""


def made_up(count: int = 200) -> np.ndarray:
    """Points ``(count, 3)`` around a UTM coordinate, to the millimetre."""
    return np.round(UTM + np.random.default_rng(0).normal(scale=5, size=(count, 3)), 3)


def as_lines(points: np.ndarray, separator: str = " ", end: str = "\n") -> str:
    return "".join(separator.join(f"{v:.3f}" for v in point) + end for point in points)


def by_plyfile(path: Path, points: np.ndarray, text: bool = False, order: str = "<") -> None:
    """As a mesh, with a colour."""
    vertex = np.zeros(len(points), [*((axis, "f8") for axis in "xyz"), ("red", "u1")])
    vertex["x"], vertex["y"], vertex["z"] = points.T
    face = np.array([((0, 1, 2),)], [("vertex_indices", "i4", (3,))])
    parts = [PlyElement.describe(vertex, "vertex"), PlyElement.describe(face, "face")]
    PlyData(parts, text=text, byte_order=order, comments=["made up"]).write(str(path))


def by_laspy(path: Path, points: np.ndarray, version: str = "1.4", form: int = 7) -> None:
    header = laspy.LasHeader(point_format=form, version=version)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(np.nanmin(points, axis=0))
    file = laspy.LasData(header)
    file.x, file.y, file.z = points.T
    file.write(str(path))


def by_open3d(path: Path, points: np.ndarray, **options: bool) -> None:
    import open3d

    open3d.t.io.write_point_cloud(str(path), open3d.t.geometry.PointCloud(points), **options)


def by_pcl(path: Path, points: np.ndarray, rows: int = 1) -> None:
    """With four bytes of padding before the coordinates, as PCL writes them."""
    header = "# .PCD v0.7\nVERSION 0.7\nFIELDS _ x y z\nSIZE 1 4 4 4\nTYPE U F F F\nCOUNT 4 1 1 1\n"
    header += f"WIDTH {len(points) // rows}\nHEIGHT {rows}\nPOINTS {len(points)}\nDATA binary\n"
    path.write_bytes(header.encode() + b"".join(struct.pack("<4xfff", *point) for point in points))


def by_pandas(path: Path, points: np.ndarray, names: str = "xyz", **options) -> None:
    pd.DataFrame(points, columns=list(names)).to_csv(path, index=False, float_format="%.3f", **options)


def text(path: Path, content: str) -> None:
    path.write_bytes(content.encode())


FORMATS = {
    "ascii.ply": lambda f, p: by_plyfile(f, p, text=True),
    "little.PLY": by_plyfile,
    "big.ply": lambda f, p: by_plyfile(f, p, order=">"),
    "open3d.ply": by_open3d,
    "ascii.pcd": lambda f, p: by_open3d(f, p, write_ascii=True),
    "binary.pcd": by_open3d,
    "compressed.pcd": lambda f, p: by_open3d(f, p, compressed=True),
    "old.las": lambda f, p: by_laspy(f, p, "1.2", 0),
    "old.laz": lambda f, p: by_laspy(f, p, "1.2", 3),
    "new.las": lambda f, p: by_laspy(f, p, "1.4", 6),
    "new.laz": by_laspy,
    "numpy.npy": lambda f, p: np.save(f, np.column_stack([p, p])),
    "pandas.csv": by_pandas,
    "decimal_comma.csv": lambda f, p: by_pandas(f, p, sep=";", decimal=",", header=False),
    "decimal_comma.txt": lambda f, p: by_pandas(f, p, sep="\t", decimal=",", header=False),
    "windows.csv": lambda f, p: by_pandas(f, p, "XYZ", lineterminator="\r\n", encoding="utf-8-sig"),
    "swapped.csv": lambda f, p: text(f, "Z [m];time;X [m];Y [m]\n" + as_lines(p[:, [2, 0, 0, 1]], ";")),
    "trailing_comma.csv": lambda f, p: text(f, as_lines(p, ",", ",\n")),
    "blanks.xyz": lambda f, p: text(f, as_lines(p, "  ")),
    "comma_blank.txt": lambda f, p: text(f, as_lines(p, ", ")),
    "mixed_ends.xyz": lambda f, p: text(f, as_lines(p[:50], end="\r\n") + as_lines(p[50:])),
    "unnamed_header.txt": lambda f, p: text(f, "Easting Northing Height\n" + as_lines(p)),
    "cloudcompare.asc": lambda f, p: text(f, "//X Y Z R\n" + as_lines(p, end=" 255\n")),
    "comments.xyz": lambda f, p: text(f, "# 1\n\n" + as_lines(p[:9]) + "# 2\n" + as_lines(p[9:], end=" # x\n")),
    "leica.pts": lambda f, p: text(f, f"{len(p)}\n" + as_lines(p, end=" -1024 10 20 30\n")),
    "no_last_end.xyz": lambda f, p: text(f, as_lines(p).rstrip("\n")),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_points_exactly(name: str, tmp_path: Path) -> None:
    path, points = tmp_path / name, made_up()
    FORMATS[name](path, points)
    cloud = read_cloud(path)
    assert np.abs(cloud.points).max() < 100  # shifted
    atol = 0.51e-3 if "las" in name or "laz" in name else 1e-8
    np.testing.assert_allclose(cloud.points + cloud.origin, points, rtol=0, atol=atol)
    assert (cloud.dropped_invalid, cloud.dropped_duplicates) == (0, 0)
    assert cloud.resolution_m == pytest.approx(0.001) if path.suffix[1:3] == "la" else cloud.resolution_m < 1e-8


def attempt(read: Callable, path: Path):
    """What was read, or None, and the message of the error."""
    try:
        return read(path), ""
    except SteelnbError as fault:
        return None, str(fault)


@pytest.mark.parametrize("name", FORMATS)
def test_truncated_files_are_refused_or_end_at_a_line(name: str, tmp_path: Path) -> None:
    path, points = tmp_path / name, made_up()
    FORMATS[name](path, points)
    whole = path.read_bytes()
    if path.suffix.lower() == ".ply" and b"face" in whole:
        whole = whole[: whole.rfind(b"3 0 1 2") if name.startswith("ascii") else -13]  # the face is not read
    for share in np.linspace(0, 1, 25, endpoint=False):
        for extra in (0, 1, 3):
            path.write_bytes(whole[: int(share * len(whole)) + extra])
            cloud, message = attempt(read_cloud, path)
            assert cloud is not None or (str(path) in message and "\n" not in message)
            if cloud is None:
                continue
            assert path.suffix.lower() not in COUNTED
            # Cut at a line's end, or just before it.
            np.testing.assert_allclose(cloud.points + cloud.origin, points[: len(cloud)], rtol=0, atol=1e-8)


DAMAGED = ("ascii.ply", "big.ply", "ascii.pcd", "binary.pcd", "compressed.pcd", "old.las", "old.laz", "new.laz",
           "numpy.npy", "swapped.csv")  # fmt: skip


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_get_points_or_an_error_of_ours(name: str, tmp_path: Path) -> None:
    """600 random files in all; no mutation may end the process, as those of LAZ once did."""
    rng = random.Random(name)
    path = tmp_path / name
    FORMATS[name](path, made_up(500))
    whole = path.read_bytes()
    refused = 0
    for turn in range(60):
        damaged = bytearray(whole)
        for _ in range(rng.choice((1, 3, 12))):
            damaged[rng.randrange(min(500, len(whole)) if turn % 2 else len(whole))] = rng.randrange(256)
        path.write_bytes(damaged)
        points, message = attempt(read_points, path)
        assert str(path) in message if points is None else points.shape[-1] == 3
        refused += points is None
    assert 0 < refused < 60


def test_a_compressed_pcd_names_the_extra_that_reads_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    FORMATS["compressed.pcd"](tmp_path / "a.pcd", made_up())
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingExtraError, match=r"open3d is not installed: pip install 'steelnb\[sim\]'"):
        read_cloud(tmp_path / "a.pcd")


def test_invalid_points_and_repeats_are_dropped_and_near_coordinates_not_shifted(tmp_path: Path) -> None:
    path = tmp_path / "dirty.csv"
    path.write_text("x,y,z\n1,2,3\nnan,0,0\n4,5,6\n1.0,2.0,3.0\n0,inf,0\n0,0,-NaN\n7,8,9\n")
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    np.testing.assert_array_equal(cloud.origin, np.zeros(3))
    assert (cloud.dropped_invalid, cloud.dropped_duplicates) == (3, 1)


PCD = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\n"
HUGE = "ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\nproperty float x\nproperty float y\nproperty float z\nend_header\n"  # noqa: E501


@pytest.mark.parametrize(
    ("name", "content", "error", "message"),
    [
        ("a.e57", "x", InputError, r"'\.e57'; expected one of \.ply, \.pcd, \.las"),
        ("plain", "1 2 3\n", InputError, "ending ''"),
        ("a.xyz", "", InputError, "no line with a point"),
        ("a.csv", "x,y,z\n", InputError, "no line with a point"),
        ("a.xyz", "nan nan nan\nnan 1 2\n", InputError, "2 points, none finite"),
        ("a.xyz", "1 2 3\n1 2 3\n", InputError, "2 points, all at"),
        ("a.xyz", "1 2 3\n4 5\n", InputError, "not a XYZ file of points"),
        ("a.xyz", "1 2 3\n4 five 6\n", InputError, "could not convert string to float: 'five'"),
        ("a.csv", "x,y,z\n1,2,3\n1,,3\n", InputError, "could not convert"),
        ("a.csv", "x,y,z\n1,2\n", InputError, "a.csv"),
        ("a.txt", "1 2 3\n4 5 1e20\n", InputError, "1e[+]20"),
        ("a.txt", "\0\1\2", InputError, "zero bytes"),
        ("a.pts", "3\n1 2 3\n4 5 6\n", InputError, "2 points, expected the 3"),
        ("a.ply", "plx\nend_header\n", InputError, "expected 'ply'"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 2\nend_header\n", InputError, "expected x, y and z"),
        ("a.ply", "ply\nformat ascii 1.0\nend_header\n", InputError, "expected the vertices first"),
        ("a.ply", "ply\nformat ebcdic 1.0\nend_header\n", InputError, "format 'ebcdic'"),
        ("a.ply", HUGE, InputError, "999999999999 points"),
        ("a.pcd", "FIELDS x y z\nSIZE 4 4 4\nDATA ascii\n", InputError, "of equal length"),
        ("a.ply", "ply\n\nformat ascii 1.0\nelement vertex ²\nend_header\n", InputError, "a.ply"),
        ("a.pts", "²\n1 2 3\n4 5 6\n", InputError, "a.pts"),
        ("a.pcd", f"{PCD}COUNT 0 1 1\nPOINTS 1\nDATA binary\n123456789012", InputError, "a.pcd"),
        ("a.pcd", "VERSION 0.7\n", InputError, "header does not end"),
        ("a.pcd", f"{PCD}POINTS 0\nDATA ascii\n", InputError, "0 points"),
        ("a.pcd", f"{PCD}POINTS 9\nDATA lzma\n", InputError, "'lzma'"),
        ("a.pcd", f"{PCD}POINTS two\nDATA ascii\n", InputError, "'two'"),
        ("a.las", "ply\n", InputError, "begins with b'ply"),
        ("a.laz", "LASF", InputError, "4 bytes"),
        ("a.npy", "x", InputError, "not a NPY file"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, name: str, content: str, error: type, message: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(error, match=message) as caught:
        read_cloud(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file_folder_and_empty_las(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        read_cloud(tmp_path / "none.ply")
    with pytest.raises(InputError, match="a folder"):
        read_cloud(tmp_path)
    laspy.LasData(laspy.LasHeader(point_format=0, version="1.2")).write(str(tmp_path / "a.laz"))
    with pytest.raises(InputError, match="0 points"):
        read_cloud(tmp_path / "a.laz")


def test_scans_keep_their_rows_and_their_invalid_points(tmp_path: Path) -> None:
    scan = np.random.default_rng(0).normal(size=(4, 5, 3)).astype(np.float32).astype(float)
    scan[1, 2, 0] = np.nan
    expected = scan.copy()
    expected[1, 2] = np.nan
    np.save(tmp_path / "a.npy", scan)
    by_pcl(tmp_path / "a.pcd", scan.reshape(-1, 3), rows=4)
    for name in ("a.npy", "a.pcd"):
        np.testing.assert_array_equal(read_points(tmp_path / name), expected)
    write_ply(tmp_path / "a.ply", scan)
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply"), np.delete(scan.reshape(-1, 3), 7, axis=0))
    vertex = PlyData.read(tmp_path / "a.ply")["vertex"]
    assert (vertex.count, [p.val_dtype for p in vertex.properties]) == (19, ["f4", "f4", "f4"])


def test_single_precision_utm_is_noticed(tmp_path: Path) -> None:
    write_ply(tmp_path / "single.ply", made_up())
    assert read_cloud(tmp_path / "single.ply").resolution_m == 0.25


# Clouds too large for memory


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name, value in ((clouds, "FITS", 5000), (clouds, "VOXELS", 4000), (clouds, "WAITING", 3000),
                                (point_files, "CHUNK", 1000)):  # fmt: skip
        monkeypatch.setattr(module, name, value)


def naive(points: np.ndarray, edge_m: float) -> dict[tuple[int, ...], np.ndarray]:
    """Means of the points in each voxel."""
    cells: dict[tuple[int, ...], list[np.ndarray]] = {}
    for point in points:
        cells.setdefault(tuple(np.floor(point / edge_m).astype(int).tolist()), []).append(point)
    return {cell: np.mean(inside, axis=0) for cell, inside in cells.items()}


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("name", ["old.las", "new.laz", "little.PLY", "binary.pcd", "blanks.xyz"])
def test_large_clouds_come_as_the_means_of_voxels(tmp_path: Path, name: str) -> None:
    points = np.round(np.random.default_rng(0).uniform(-3, 3, (12_345, 3)), 3)
    FORMATS[name](tmp_path / name, points)
    cloud = read_cloud(tmp_path / name)
    assert cloud.count is not None
    assert cloud.count.sum() == len(points)
    assert len(cloud) <= 4000
    np.testing.assert_allclose(np.average(cloud.points, axis=0, weights=cloud.count), points.mean(axis=0), atol=1e-5)
    expected, found = naive(points, cloud.thinned_m), naive(cloud.points, cloud.thinned_m)
    assert len(expected) == pytest.approx(len(cloud), rel=0.002)  # LAS moves points across borders
    same = [cell for cell in found if cell in expected and np.allclose(found[cell], expected[cell], atol=2e-5)]
    assert len(same) > 0.99 * len(cloud)


@pytest.mark.usefixtures("small")
def test_large_clouds_are_shifted_and_their_faults_are_those_of_small_ones(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(-3, 3, (9000, 3))
    by_laspy(tmp_path / "a.las", points + UTM)
    cloud = read_cloud(tmp_path / "a.las")
    np.testing.assert_array_equal(cloud.origin, [299100, 2801400, 1900])
    np.testing.assert_allclose(cloud.points.mean(axis=0) + cloud.origin, UTM, atol=0.1)
    wide = 3000 * points
    wide[::9] = np.nan
    by_pcl(tmp_path / "a.pcd", wide)
    cloud = read_cloud(tmp_path / "a.pcd")
    assert cloud.count is not None
    assert (cloud.dropped_invalid, cloud.count.sum()) == (1000, 8000)
    assert cloud.resolution_m == 2.0**-10  # single precision between 8,192 and 16,384 m
    for content, error in ((0.0, InputError), (np.nan, InputError), (1e20, InputError)):
        by_pcl(tmp_path / "a.pcd", np.full((6000, 3), content))
        with pytest.raises(error, match=r"a\.pcd"):
            read_cloud(tmp_path / "a.pcd")
    for name in ("old.las", "new.laz", "big.ply", "binary.pcd"):
        FORMATS[name](tmp_path / name, points)
        whole = (tmp_path / name).read_bytes()
        for share in (0.1, 0.5, 0.99):
            (tmp_path / name).write_bytes(whole[: int(share * len(whole))])
            with pytest.raises(SteelnbError, match=name):
                read_cloud(tmp_path / name)
