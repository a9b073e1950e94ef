"""Reading clouds: every format gives the same points, and every broken file is refused by name."""

import struct
from pathlib import Path

import numpy as np
import pytest

from steelnb.errors import (
    DegenerateCloudError,
    EmptyCloudError,
    FileContentError,
    FileMissingError,
    SteelnbError,
    UnsupportedFormatError,
)
from steelnb.recordings import read_cloud

UTM = np.array([299119.894, 2801406.927, 1949.952])


def made_up(count: int = 200, seed: int = 0) -> np.ndarray:
    """Points ``(count, 3)`` around a UTM coordinate, to the millimetre."""
    rng = np.random.default_rng(seed)
    return np.round(UTM + rng.normal(scale=5, size=(count, 3)), 3)


def as_lines(points: np.ndarray, separator: str = " ", end: str = "\n") -> str:
    return "".join(separator.join(f"{v:.3f}" for v in point) + end for point in points)


def ply(points: np.ndarray, encoding: str) -> bytes:
    names = "property double x\nproperty double y\nproperty double z\nproperty uchar red\n"
    header = f"ply\nformat {encoding} 1.0\ncomment made up\nelement vertex {len(points)}\n{names}"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    if encoding == "ascii":
        return (header + as_lines(np.column_stack([points, np.full(len(points), 7)])) + "3 0 1 2\n").encode()
    order = "<" if "little" in encoding else ">"
    records = b"".join(struct.pack(f"{order}dddB", *point, 7) for point in points)
    return header.encode() + records + struct.pack(f"{order}Biii", 3, 0, 1, 2)


def pcd(points: np.ndarray, encoding: str) -> bytes:
    """With four bytes of padding before the coordinates, as PCL writes them."""
    header = "# .PCD v0.7\nVERSION 0.7\nFIELDS _ x y z\nSIZE 1 8 8 8\nTYPE U F F F\nCOUNT 4 1 1 1\n"
    header += f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {encoding}\n"
    if encoding == "ascii":
        return (header + as_lines(np.column_stack([np.zeros((len(points), 4)), points]))).encode()
    if encoding == "binary":
        return header.encode() + b"".join(struct.pack("<4xddd", *point) for point in points)
    columns = bytes(4 * len(points)) + points.T.astype("<f8").tobytes()
    # LZF without compression: runs of up to 32 literal bytes, each after its length less one.
    packed = b"".join(bytes([len(run) - 1]) + run for run in (columns[k : k + 32] for k in range(0, len(columns), 32)))
    return header.encode() + struct.pack("<II", len(packed), len(columns)) + packed


def named_columns(points: np.ndarray) -> str:
    swapped = np.column_stack([points[:, 2], np.arange(len(points)), points[:, 0], points[:, 1]])
    return "Z [m];time;X [m];Y [m]\n" + as_lines(swapped, ";")


FORMATS = {
    "ascii.ply": lambda p: ply(p, "ascii"),
    "little.PLY": lambda p: ply(p, "binary_little_endian"),
    "big.ply": lambda p: ply(p, "binary_big_endian"),
    "crlf.ply": lambda p: ply(p, "ascii").replace(b"\n", b"\r\n"),
    "ascii.pcd": lambda p: pcd(p, "ascii"),
    "binary.pcd": lambda p: pcd(p, "binary"),
    "compressed.pcd": lambda p: pcd(p, "binary_compressed"),
    "blanks.xyz": lambda p: as_lines(p, "  ").encode(),
    "tabs.txt": lambda p: as_lines(p, "\t").encode(),
    "commas.txt": lambda p: as_lines(p, ",").encode(),
    "comma_blank.txt": lambda p: as_lines(p, ", ").encode(),
    "semicolons.csv": lambda p: as_lines(p, ";").encode(),
    "decimal_comma.csv": lambda p: as_lines(p, ";").replace(".", ",").encode(),
    "decimal_comma.txt": lambda p: as_lines(p, "\t").replace(".", ",").encode(),
    "trailing_comma.csv": lambda p: as_lines(p, ",", ",\n").encode(),
    "windows.csv": lambda p: b"\xef\xbb\xbfX,Y,Z\r\n" + as_lines(p, ",", "\r\n").encode(),
    "mixed_ends.xyz": lambda p: (as_lines(p[:50], end="\r\n") + as_lines(p[50:])).encode(),
    "named.csv": lambda p: named_columns(p).encode(),
    "unnamed_header.txt": lambda p: ("Easting Northing Height\n" + as_lines(p)).encode(),
    "cloudcompare.asc": lambda p: ("//X Y Z R\n" + as_lines(p, end=" 255\n")).encode(),
    "comments.xyz": lambda p: (
        "# made up\n\n" + as_lines(p[:9]) + "# more\n\n" + as_lines(p[9:], end=" # x\n")
    ).encode(),
    "leica.pts": lambda p: (f"{len(p)}\n" + as_lines(p, end=" -1024 10 20 30\n")).encode(),
    "no_last_end.xyz": lambda p: as_lines(p).rstrip("\n").encode(),
}


@pytest.fixture(params=FORMATS)
def saved(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, np.ndarray]:
    points = made_up()
    path = tmp_path / request.param
    path.write_bytes(FORMATS[request.param](points))
    return path, points


def test_every_format_gives_the_points_exactly(saved: tuple[Path, np.ndarray]) -> None:
    path, points = saved
    cloud = read_cloud(path)
    assert np.abs(cloud.points).max() < 100  # shifted
    np.testing.assert_allclose(cloud.points + cloud.origin, points, rtol=0, atol=1e-8)
    assert (cloud.dropped_invalid, cloud.dropped_duplicates) == (0, 0)
    assert cloud.resolution_m < 1e-8


def test_truncated_files_are_refused_or_end_at_a_line(saved: tuple[Path, np.ndarray]) -> None:
    path, points = saved
    whole = path.read_bytes()
    faces = len(whole) - whole.rfind(b"3 0 1 2") if path.name in ("ascii.ply", "crlf.ply") else 13
    counted = path.suffix.lower() in (".ply", ".pcd", ".pts")
    for share in np.linspace(0, 1, 40, endpoint=False):
        for extra in (0, 1, 3):
            cut = whole[: int(share * len(whole)) + extra]
            if path.suffix.lower() == ".ply" and len(cut) >= len(whole) - faces:
                continue  # only the face is gone
            path.write_bytes(cut)
            try:
                cloud = read_cloud(path)
            except SteelnbError:
                continue
            assert not counted
            assert len(cloud) <= len(points)  # cut at a line's end, or just before it
            np.testing.assert_allclose(cloud.points + cloud.origin, points[: len(cloud)], rtol=0, atol=1e-8)


def test_a_number_cut_short_is_not_taken_for_a_smaller_one(tmp_path: Path) -> None:
    path = tmp_path / "cut.xyz"
    text = as_lines(made_up()).rstrip("\n")
    for digits in range(1, 4):
        path.write_text(text[:-digits])
        with pytest.raises(FileContentError, match="no line end"):
            read_cloud(path)


def test_near_coordinates_are_not_shifted(tmp_path: Path) -> None:
    path = tmp_path / "site.xyz"
    path.write_text("1 2 3\n4 5 6\n")
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(cloud.origin, np.zeros(3))


def test_duplicates_and_invalid_points_are_dropped_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "dirty.csv"
    path.write_text("x,y,z\n1,2,3\nnan,0,0\n4,5,6\n1.0,2.0,3.0\n0,inf,0\n0,0,-NaN\n7,8,9\n")
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    assert (cloud.dropped_invalid, cloud.dropped_duplicates) == (3, 1)


def test_single_precision_utm_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "single.ply"
    points = made_up().astype("<f4")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_bytes(header.encode() + points.tobytes())
    assert read_cloud(path).resolution_m == 0.25


@pytest.mark.parametrize(
    ("name", "content", "error", "message"),
    [
        ("a.e57", "x", UnsupportedFormatError, r"'\.e57'; expected one of \.ply, \.pcd, \.las"),
        ("plain", "1 2 3\n", UnsupportedFormatError, "ending ''"),
        ("a.xyz", "", EmptyCloudError, "no line with a point"),
        ("a.csv", "x,y,z\n", EmptyCloudError, "no line with a point"),
        ("a.xyz", "nan nan nan\nnan 1 2\n", EmptyCloudError, "2 points, none finite"),
        ("a.xyz", "1 2 3\n1 2 3\n", DegenerateCloudError, "2 points, all at"),
        ("a.xyz", "1 2 3\n", DegenerateCloudError, "1 points"),
        ("a.xyz", "1 2 3\n4 5\n", FileContentError, "line 2: '4 5'"),
        ("a.xyz", "1 2 3\n4 five 6\n", FileContentError, "line 2: '4 five 6'"),
        ("a.csv", "x,y,z\n1,2,3\n1,,3\n", FileContentError, "line 3: '1,,3'"),
        ("a.csv", "x,y,z\n1,2\n", FileContentError, "line 2: '1,2'"),
        ("a.txt", "1 2 3\n4 5 1e20\n", FileContentError, "1e[+]20"),
        ("a.txt", "\0\1\2", FileContentError, "zero bytes"),
        ("a.pts", "3\n1 2 3\n4 5 6\n", FileContentError, "2 points, expected the 3"),
        ("a.ply", "nothing\n", FileContentError, "header does not end"),
        ("a.ply", "plx\nend_header\n", FileContentError, "expected 'ply'"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 2\nend_header\n", FileContentError, "expected x, y and z"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex -2\nend_header\n", FileContentError, "whole number"),
        ("a.ply", "ply\nformat ebcdic 1.0\nend_header\n", FileContentError, "format 'ebcdic'"),
        ("a.pcd", "FIELDS x y z\nSIZE 4 4 4\nDATA ascii\n", FileContentError, "of equal length"),
        ("a.pcd", "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 0\nDATA ascii\n", EmptyCloudError, "0 points"),
        ("a.pcd", "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 9\nDATA lzma\n", FileContentError, "'lzma'"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, name: str, content: str, error: type, message: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(error, match=message) as caught:
        read_cloud(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_header_that_promises_too_much_costs_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "huge.ply"
    path.write_bytes(ply(made_up(), "binary_little_endian").replace(b"vertex 200", b"vertex 999999999999"))
    with pytest.raises(FileContentError, match="999999999999 points"):
        read_cloud(path)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(FileMissingError, match="does not exist"):
        read_cloud(tmp_path / "none.ply")
    with pytest.raises(FileMissingError, match="a folder"):
        read_cloud(tmp_path)
