"""Headers of PLY files."""

from pathlib import Path

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.io.clouds import read_points

POINTS = np.arange(15.0).reshape(5, 3)
LINES = "\n".join(f"{x:g} {y:g} {z:g}" for x, y, z in POINTS).encode()
AXES = "property float x\nproperty float y\nproperty float z\n"
FACE = "element face 1\nproperty list uchar int vertex_indices\n"
VIEWS = "property list uchar ushort views\n"
CAMERA = "element camera 2\nproperty double focus\nproperty uchar kind\n"


def header(
    encoding: str = "binary_little_endian", count: str = "5", axes: str = AXES, before: str = "", after: str = ""
) -> bytes:
    lines = f"ply\nformat {encoding} 1.0\ncomment made\n{before}element vertex {count}\n{axes}{after}end_header\n"
    return lines.encode()


def records(order: str = "<", kind: str = "f4") -> bytes:
    return POINTS.astype(f"{order}{kind}").tobytes()


def viewed(first: bool = False) -> bytes:
    """Records with lists of one item, two, …, after or before x, y and z."""
    views = [bytes([k + 1]) + np.arange(k + 1, dtype="<u2").tobytes() for k in range(5)]
    points = [point.astype("<f4").tobytes() for point in POINTS]
    return b"".join(view + point if first else point + view for point, view in zip(points, views, strict=True))


def records_of(kind: str, more: str) -> bytes:
    table = np.zeros(5, [("xyz", f"<{kind}", 3), ("more", more)])
    table["xyz"] = POINTS
    return table.tobytes()


COLOURED = np.zeros(5, [("y", "<f8"), ("r", "u1"), ("z", "<i2"), ("x", "<f4")])
for number, name in enumerate("xyz"):
    COLOURED[name] = POINTS[:, number]


def test_missing_numbers_in_the_spelling_of_windows_are_nan(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(header("ascii") + LINES.replace(b"3 4 5", b"1.#QNAN -1.#IND 1.#INF"))
    assert np.isnan(read_points(tmp_path / "a.ply")).any(axis=1).sum() == 1


@pytest.mark.parametrize(
    "content",
    [
        header() + records(),
        header().replace(b"\n", b"\r\n") + records(),
        header("binary_big_endian") + records(">"),
        header(axes=AXES.replace("float", "float64")) + records(kind="f8"),
        header(axes="property double y\nproperty uchar red\nproperty short z\nproperty float X\n") + COLOURED.tobytes(),
        header(before=CAMERA, after=FACE) + bytes(18) + records() + b"\x03" + bytes(12),
        header() + records() + b"\n",
        header("ascii") + LINES,
        header("ascii") + LINES + b"\n\n",
        header("ascii", before=CAMERA, after=FACE) + b"1 2\n3 4\n" + LINES + b"\n3 0 1 2\n",
        header("ascii").replace(b"\n", b"\r") + LINES.replace(b"\n", b"\r"),
        b"\xef\xbb\xbf" + header("ascii") + LINES,
        header(before=FACE) + b"\x03" + bytes(12) + records(),
        header(before=FACE.replace(" 1", " 0")) + records(),
        header("binary_big_endian", before=FACE) + b"\x02" + bytes(8) + records(">"),
        header(axes=AXES + VIEWS) + viewed(),
        header(axes=VIEWS + AXES, after=FACE) + viewed(first=True) + b"\x03" + bytes(12),
        header("ascii", axes=AXES + VIEWS) + b"\n".join(line + b" 2 7 8" for line in LINES.splitlines()),
        header(axes=AXES + "property uchar gps time\n") + records_of("f4", "u1"),
        header(axes=AXES.replace("float ", "float position_")) + records(),
        header(axes=AXES.replace("float ", "float p") + "property uchar n_x\n") + records_of("f4", "u1"),
        header(before="comment units: m\ncomment units: mm of the colours\n") + records(),
    ],
)
def test_vertices_are_found_among_other_elements(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(content)
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply"), POINTS)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (header() + records()[:-1], "59 bytes of points; expected 5 of 12 bytes each"),
        (header(count="99999999999999") + records(), "expected 99999999999999 of 12 bytes"),
        (header() + records().replace(b"\0\0", b"\r\n\0"), "header says, and a carriage return before each line feed"),
        (header(count="4") + records(), "more bytes than those of 4 vertices of 12 bytes"),
        (header() + np.column_stack([POINTS, POINTS[:, 0]]).astype("<f4").tobytes(), "more bytes than those of 5"),
        (header(count="2") + LINES, "more bytes than those of 2 vertices"),
        (header("ascii", count="4") + LINES, "5 vertices; its header says 4"),
        (
            header(before="comment Units: US survey feet\n") + records(),
            "'Units: US survey feet' in its header; expected",
        ),
        (header(before="obj_info units feet\n") + records(), "'units feet' in its header; expected metres"),
        (header(count="0"), "expected 0 of 12 bytes"),
        (header(count="-5") + records(), "'element vertex -5' in its header; expected"),
        (header(before=FACE) + b"\x03" + bytes(12) + records()[:-1], "59 bytes of points; expected 5 of 12 bytes each"),
        (header(before=FACE) + b"\xff" + bytes(12), "13 bytes end in record 0; expected 1"),
        (header(before=FACE.replace(" 1", " 99999999999999")) + records(), "60 bytes; expected 99999999999999 records"),
        (header(axes=AXES + VIEWS) + viewed()[:-1], "94 bytes end in record 4; expected 5"),
        (header(axes=AXES + VIEWS, count="4") + viewed(), "more bytes than those of 4 vertices"),
        (header(axes="property list uchar float x\n" + AXES[17:]) + records(), "x, y and z of its vertices are lists"),
        (header(axes=AXES.replace("float y", "list half int y")) + records(), "property 'list half int y'"),
        (header(axes=AXES.replace("float y", "half y")) + records(), "property 'half y'"),
        (header(axes=AXES.replace(" y", " x")) + records(), "a vertex has x, x, z; expected x, y and z once each"),
        (header("utf8") + LINES, "format utf8; expected one of ascii"),
        (header("ascii") + LINES[:-10], "line 12 has 1 fields, '1'; expected 3|4 vertices; its header says 5"),
        (header().replace(b"vertex", b"face") + records(), "no element vertex"),
        (b"ply\n", "no header"),
    ],
)
def test_contradictions_are_refused(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(InputError, match=rf"a.ply: not a PLY file of points: .*({message})"):
        read_points(tmp_path / "a.ply")


@pytest.mark.parametrize(("encoding", "order"), [("binary_little_endian", ">"), ("binary_big_endian", "<")])
def test_bytes_in_another_order_than_stated_are_refused(tmp_path: Path, encoding: str, order: str) -> None:
    (tmp_path / "a.ply").write_bytes(header(encoding) + records(order))
    with pytest.raises(InputError, match=r"points that are not within 1e-30 to 1e.08 m"):
        read_points(tmp_path / "a.ply")
