"""Headers of PCD files."""

from pathlib import Path

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.io.clouds import read_points
from steelnb.io.lzf import lzf_unpacked

POINTS = np.arange(18.0).reshape(6, 3)
LINES = "\n".join(f"{x:g} {y:g} {z:g}" for x, y, z in POINTS).encode()
PACKED = POINTS.astype("<f4").tobytes()


def header(data: str = "binary", **changed: str | None) -> bytes:
    """A header. Keywords are changed, or left out if None."""
    words = {"VERSION": "0.7", "FIELDS": "x y z", "SIZE": "4 4 4", "TYPE": "F F F", "COUNT": "1 1 1"}
    words |= {"WIDTH": "6", "HEIGHT": "1", "VIEWPOINT": "0 0 0 1 0 0 0", "POINTS": "6"}
    lines = [f"{key} {value}" for key, value in (words | changed).items() if value is not None]
    return "\n".join(["# .PCD v0.7", *lines, f"DATA {data}", ""]).encode()


@pytest.mark.parametrize(
    "content",
    [
        header() + PACKED,
        header().replace(b"\n", b"\r\n") + PACKED,
        header().lower() + PACKED,
        header().replace(b"WIDTH", b"# WIDTH 5\n\n  WIDTH") + PACKED,
        header(VIEWPOINT=None, COUNT=None) + PACKED + b"\n",
        header(POINTS=None) + PACKED,
        header(WIDTH=None, HEIGHT=None) + PACKED,
        header(WIDTH="5") + PACKED,
        header(POINTS="5") + PACKED,
        header(FIELDS="X Y Z", TYPE="f f f") + PACKED + bytes(100),
        header("ascii") + LINES,
        header("ascii") + LINES.replace(b"\n", b"\r\n") + b"\r\n \r\n\r\n",
        header("ASCII", POINTS=None) + LINES.replace(b"\n", b"\n# a comment\n\n"),
    ],
)
def test_headers_of_many_programs_give_the_same_points(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(content)
    np.testing.assert_array_equal(read_points(tmp_path / "a.pcd"), POINTS)


@pytest.mark.parametrize("kind", ["F4", "F8", "I1", "I2", "I4", "I8", "U1", "U2", "U4", "U8"])
@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_every_type_is_read_among_other_fields(kind: str, data: str, tmp_path: Path) -> None:
    """Padding of any size, fields of several elements, and z before x; compressed data are stored field by field."""
    names, kinds, counts = "_z_x_ny", ("U1", kind, "U4", kind, "F8", "F4", kind), (3, 1, 2, 1, 0, 3, 1)
    fields = list(zip(names, kinds, counts, strict=True))
    record = np.dtype([(f"{name}{k}", f"<{each.lower()}", (n,)) for k, (name, each, n) in enumerate(fields)])
    table = np.zeros(6, record)
    for name, axis in (("x3", 0), ("y6", 1), ("z1", 2)):
        table[name][:, 0] = POINTS[:, axis]
    body = table.tobytes()
    if data == "ascii":
        body = "\n".join(" ".join(f"{v:g}" for name in record.names for v in row[name]) for row in table).encode()
    elif data == "binary_compressed":
        plain = b"".join(table[name].tobytes() for name in record.names)
        # Literal runs of 32 bytes are LZF too.
        packed = b"".join(bytes([len(run) - 1]) + run for k in range(0, len(plain), 32) if (run := plain[k : k + 32]))
        body = np.array([len(packed), len(plain)], "<u4").tobytes() + packed
    head = header(
        data, FIELDS=" ".join(names), TYPE=" ".join(each[0] for each in kinds),
        SIZE=" ".join(each[1] for each in kinds), COUNT=" ".join(map(str, counts)), WIDTH="3", HEIGHT="2",
    )  # fmt: skip
    (tmp_path / "a.pcd").write_bytes(head + body)
    np.testing.assert_array_equal(read_points(tmp_path / "a.pcd"), POINTS.reshape(2, 3, 3))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"# unit = mm\n" + header() + PACKED, "'unit = mm' in its header; expected metres"),
        (header() + PACKED[:-1], "71 bytes of points; expected 6 of 12 bytes each"),
        (
            header() + PACKED.replace(b"\0\0", b"\r\n\0"),
            "as its header says, and a carriage return before each line feed",
        ),
        (header() + PACKED * 2, "144 bytes of points; expected 6 of 12 bytes each"),
        (header(WIDTH="99999999999999999", POINTS=None) + PACKED, "expected 99999999999999999 of 12 bytes each"),
        (header(COUNT="1 1 99999999999") + PACKED, "F of 4 bytes × 99999999999; expected"),
        (header(POINTS="7", WIDTH="8") + PACKED, "POINTS 7, but WIDTH × HEIGHT = 8, and data of 6 points"),
        (header(WIDTH="-6") + PACKED, "WIDTH -6; expected 1 whole"),
        (header(FIELDS="x y i") + PACKED, "FIELDS x y i, .*expected x, y and z once each"),
        (header(SIZE="4 4 2") + PACKED, "F of 2 bytes × 1; expected"),
        (header(TYPE=None) + PACKED, "TYPE ; expected"),
        (header(SIZE="4 4") + PACKED, "SIZE 4 4; expected 3"),
        (header("zip") + PACKED, "DATA zip; expected ascii, binary or binary_compressed"),
        (header("ascii") + LINES[:-8], "5 lines of points; its header says 6"),
        (header("ascii") + LINES.replace(b"3 4 5", b"3 4"), "line 13 has 2 fields, '3 4'; expected 3"),
        (header("binary_compressed") + b"\xff\xff\xff\xff\x48\0\0\0" + PACKED, "hold 4294967295, and 72 uncompressed"),
        (header("binary_compressed") + b"\x02\0\0\0\xff\xff\xff\xff" + PACKED, "and 4294967295 uncompressed"),
        (header("binary_compressed") + b"\x48\0\0\0\x48\0\0\0" + PACKED, "compressed data are damaged"),
        (b"VERSION 0.7\n", "no line DATA"),
    ],
)
def test_contradictions_are_refused(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(content)
    with pytest.raises(InputError, match=rf"a.pcd: not a PCD file of points: .*{message}"):
        read_points(tmp_path / "a.pcd")


def test_lzf_repeats_stretches_that_overlap_and_refuses_damage() -> None:
    def unpack(*packed: int, size: int) -> bytes:
        return lzf_unpacked(np.array(packed, np.uint8), size).tobytes()

    assert unpack(1, 7, 8, 0x40, 1, 0, 9, size=7) == bytes([7, 8, 7, 8, 7, 8, 9])
    assert unpack(0, 5, 0xE0, 250, 0, size=260) == bytes([5] * 260)
    for packed, size in (
        ([3, 1, 2], 4), ([0, 5, 0x20, 1], 4), ([0, 5, 0xE0], 9), ([0, 5], 2), ([1, 5, 6], 1), ([0, 5, 0x20], 4),
    ):  # fmt: skip
        with pytest.raises(ValueError, match="compressed data are damaged"):
            unpack(*packed, size=size)
