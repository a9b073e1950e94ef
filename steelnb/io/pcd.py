"""Reader of PCD files, after the format's description by the Point Cloud Library (version 0.7)."""

import struct
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import numpy as np

from steelnb.core.types import Array
from steelnb.io.column_names import check_stated
from steelnb.io.encodings import plain_nan, rewritten
from steelnb.io.lzf import lzf_unpacked
from steelnb.io.records import HEADER_MAX, is_whole, xyz_of
from steelnb.io.text import Table

LZF_RATIO_MAX = 88
"""A reference of three bytes copies at most 264 of them."""
KINDS = {("F", 4): "<f4", ("F", 8): "<f8"} | {(t, n): f"<{t.lower()}{n}" for t in "IU" for n in (1, 2, 4, 8)}


class Header(NamedTuple):
    """``columns`` of x, y and z in a line of ``width`` numbers; ``fields``: their types and offsets in a record of
    ``stride`` bytes; ``shape``: rows and columns, and ``points``, 0 if not given; ``encoding``: ``ascii``, ``binary``
    or ``binary_compressed``."""

    columns: list[int]
    width: int
    fields: list[tuple[str, int]]
    stride: int
    shape: tuple[int, int]
    points: int
    encoding: str

    def chosen(self, fits: int) -> int:
        """Number of points. If POINTS contradicts WIDTH and HEIGHT, the one that ``fits`` the data is right."""
        product = self.shape[0] * self.shape[1]
        counts = [n for n in (product, self.points) if n] or [0]
        if len(set(counts)) > 1 and fits not in counts:
            raise ValueError(f"POINTS {self.points}, but WIDTH × HEIGHT = {product}, and data of {fits} points")
        return fits if fits in counts else counts[0]


def read_pcd(path: Path) -> Array:
    """Points of a PCD file, ``(N, 3)``, or ``(H, W, 3)`` if it has several rows. Raises ValueError.

    The sensor's pose (VIEWPOINT) is not applied, as most programs store points in the sensor frame and do not set it.
    """
    file = path.read_bytes()
    header, data = _header(file)
    stride = header.stride
    if header.encoding == "ascii":
        line = file[: len(file) - len(data)].count(b"\n") + 1
        points = Table(plain_nan(bytes(data)), header.width, first=line).values(header.columns)
        if header.chosen(len(points)) != len(points):
            raise ValueError(f"{len(points)} lines of points; its header says {header.chosen(len(points))}")
    elif header.encoding == "binary":
        count = header.chosen(len(data) // max(stride, 1))
        points = xyz_of(data, count, stride, header.fields)
        more = len(data) - count * stride
        why = rewritten(data) if more else ""
        if (more >= stride or why) and any(data[count * stride :]):
            expected = f"expected {count} of {stride} bytes each, as its header says{why}"
            raise ValueError(f"{len(data)} bytes of points; {expected}")
    elif header.encoding == "binary_compressed":
        if len(data) < 8:
            raise ValueError("no data after its header")
        packed, size = struct.unpack_from("<II", data)
        count = header.chosen(size // max(stride, 1))
        if packed > len(data) - 8 or size > LZF_RATIO_MAX * packed or size != count * stride:
            held = f"{len(data) - 8} bytes hold {packed}, and {size} uncompressed"
            raise ValueError(f"{held}; expected {count} × {stride}")
        whole = lzf_unpacked(np.frombuffer(data, np.uint8, packed, 8), size).data
        # Each field of all points stands in one piece.
        axes = [xyz_of(whole[n * count :], count, int(kind[2:]), [(kind, 0)] * 3)[:, 0] for kind, n in header.fields]
        points = np.stack(axes, -1)
    else:
        raise ValueError(f"DATA {header.encoding[:40]}; expected ascii, binary or binary_compressed")
    rows, columns = header.shape
    return points.reshape((rows, columns, 3) if rows > 1 and rows * columns == len(points) else (-1, 3))


def _header(file: bytes) -> tuple[Header, memoryview]:
    """The header, and the data after it. Keywords may be in lower case, in any order; comments and blank lines are
    skipped."""
    words: dict[str, list[str]] = {}
    comments, begin = list[str](), 0
    while "DATA" not in words:
        end = file.find(b"\n", begin, HEADER_MAX) + 1
        line = file[begin : end or HEADER_MAX].decode("ascii", "replace").split()
        if not end and line[:1] != ["DATA"]:
            raise ValueError("no line DATA; expected the header of a PCD file")
        if line and line[0].startswith("#"):
            comments.append(" ".join(line).lstrip("# "))
        elif line:
            words[line[0].upper()] = line[1:]
        begin = end or len(file)
    check_stated(comments)
    fields = [name.lower() for name in words.get("FIELDS") or words.get("COLUMNS") or []]
    ones = ["1"] * len(fields)
    size, count = _numbers(words, "SIZE", len(fields)), _numbers({"COUNT": ones} | words, "COUNT", len(fields))
    types = [kind.upper() for kind in words.get("TYPE", [])]
    missing = [axis for axis in "xyz" if fields.count(axis) != 1]
    if missing or len(types) != len(fields):
        named, given = " ".join(fields)[:80], " ".join(types)[:40]
        raise ValueError(f"FIELDS {named}, TYPE {given}; expected x, y and z once each, and a type for each field")
    number = [fields.index(axis) for axis in "xyz"]
    kinds = [KINDS.get((types[k], size[k]), "") for k in number]
    if "" in kinds or [count[k] for k in number] != [1, 1, 1]:
        described = ", ".join(f"{types[k]} of {size[k]} bytes × {count[k]}" for k in number)
        raise ValueError(f"x, y and z are {described}; expected F of 4 or 8, I or U of 1, 2, 4 or 8, once each")
    one = {"WIDTH": ["0"], "HEIGHT": ["1"], "POINTS": ["0"], "DATA": [""]} | words
    (columns,), (rows,), (points,) = (_numbers(one, key, 1) for key in ("WIDTH", "HEIGHT", "POINTS"))
    before, offset = [0, *accumulate(count)], [0, *accumulate(n * each for n, each in zip(count, size, strict=True))]
    fields_xyz = [(kind, offset[k]) for kind, k in zip(kinds, number, strict=True)]
    encoding, data = (one["DATA"] or [""])[0].lower(), memoryview(file)[begin:]
    return Header(
        [before[k] for k in number], before[-1], fields_xyz, offset[-1], (rows, columns), points, encoding
    ), data


def _numbers(words: dict[str, list[str]], key: str, expected: int) -> list[int]:
    given = words.get(key, [])
    if len(given) != expected or not all(map(is_whole, given)):
        raise ValueError(f"{key} {' '.join(given)[:40]}; expected {expected} whole numbers")
    return [int(word) for word in given]
