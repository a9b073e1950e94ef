"""Reader of the vertices of PLY files, after Greg Turk's description of the format."""

import re
from pathlib import Path

import numpy as np

from steelnb.core.types import Array
from steelnb.io.encodings import plain_nan
from steelnb.io.records import HEADER_MAX, is_whole, xyz_of
from steelnb.io.text import Table

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_ply(path: Path) -> Array:
    """Vertices ``(N, 3)`` of a PLY file. Faces and other elements are skipped. Raises ValueError."""
    file = path.read_bytes()
    end = re.search(rb"^end_header[ \t]*(\r\n|\r|\n)", file[:HEADER_MAX], re.MULTILINE) or re.search(
        rb"\rend_header[ \t]*(\r)", file[:HEADER_MAX]
    )
    if not file.startswith(b"ply") or end is None:
        raise ValueError("no header; expected lines from ply to end_header")
    lines = [line.decode("ascii", "replace").split() for line in file[: end.end()].splitlines()]
    encoding = next((line[1] for line in lines if line[:1] == ["format"] and len(line) > 1), "none")
    if encoding not in ORDERS:
        raise ValueError(f"format {encoding[:40]}; expected one of {', '.join(ORDERS)}")
    order, data, before = ORDERS[encoding], memoryview(file)[end.end() :], 0
    elements = _elements(lines)
    for name, count, properties in elements:
        if name == "vertex":
            break
        if order:
            before += count * sum(np.dtype(_type(words)).itemsize for words in properties)
        else:
            before += count
    else:
        raise ValueError("no element vertex in its header")
    names = [words[-1].lower() for words in properties]
    types = [order + _type(words) for words in properties]
    if any(names.count(axis) != 1 for axis in "xyz"):
        raise ValueError(f"a vertex has {', '.join(names)[:80] or 'no properties'}; expected x, y and z once each")
    number, is_last = [names.index(axis) for axis in "xyz"], elements[-1][0] == "vertex"
    if order:
        sizes = [np.dtype(each).itemsize for each in types]
        after = bytes(data[before + count * sum(sizes) :][: sum(sizes)])
        if is_last and after.strip():
            raise ValueError(f"more bytes than those of {count} vertices of {sum(sizes)} bytes, as its header says")
        return xyz_of(data[min(before, len(data)) :], count, sum(sizes), [(types[k], sum(sizes[:k])) for k in number])
    text = plain_nan(bytes(data))
    if before:
        text = b"".join(text.splitlines(keepends=True)[before:])
    points = Table(text, len(names), first=len(lines) + before + 1).values(number, None if is_last else count)
    if len(points) != count:
        raise ValueError(f"{len(points)} vertices; its header says {count}")
    return points


def _elements(lines: list[list[str]]) -> list[tuple[str, int, list[list[str]]]]:
    """Name, count and properties of each element."""
    elements: list[tuple[str, int, list[list[str]]]] = []
    for line in lines:
        if line[:1] == ["element"]:
            if len(line) != 3 or not is_whole(line[2]):
                raise ValueError(f"{' '.join(line)[:60]!r} in its header; expected a name and a number")
            elements.append((line[1], int(line[2]), []))
        elif line[:1] == ["property"]:
            if not elements or len(line) < 3:
                raise ValueError(f"{' '.join(line)[:60]!r} in its header; expected a type and a name, after an element")
            elements[-1][2].append(line[1:])
    return elements


def _type(words: list[str]) -> str:
    """NumPy's type of a property. Lists, whose length differs, are read in no element up to the vertices."""
    if len(words) != 2 or words[0] not in TYPES:
        raise ValueError(f"property {' '.join(words)[:60]!r} at or before its vertices; expected one number")
    return TYPES[words[0]]
