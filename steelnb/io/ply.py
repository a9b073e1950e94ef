"""Reader of the vertices of PLY files, after Greg Turk's description of the format."""

import codecs
import re
from pathlib import Path

import numpy as np

from steelnb.core.types import Array
from steelnb.io.column_names import AXIS, check_stated
from steelnb.io.encodings import plain_nan, rewritten
from steelnb.io.records import HEADER_MAX, is_whole, walked, xyz_of
from steelnb.io.text import Table

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
Element = tuple[str, int, list[list[str]]]
Type = str | tuple[str, str]
"""Name, count and properties of an element, in words; type of a property, as `_type` gives it."""
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_ply(path: Path) -> Array:
    """Vertices ``(N, 3)`` of a PLY file. Faces and other elements are skipped. Raises ValueError."""
    file = path.read_bytes()
    end = re.search(rb"^end_header[ \t]*(\r\n|\r|\n)", file[:HEADER_MAX], re.MULTILINE) or re.search(
        rb"\rend_header[ \t]*(\r)", file[:HEADER_MAX]
    )
    if not file.startswith((b"ply", codecs.BOM_UTF8 + b"ply")) or end is None:
        raise ValueError("no header; expected lines from ply to end_header")
    lines = [line.decode("ascii", "replace").split() for line in file[: end.end()].splitlines()]
    encoding = next((line[1] for line in lines if line[:1] == ["format"] and len(line) > 1), "none")
    if encoding not in ORDERS:
        raise ValueError(f"format {encoding[:40]}; expected one of {', '.join(ORDERS)}")
    order, data = ORDERS[encoding], memoryview(file)[end.end() :]
    check_stated(" ".join(line[1:]) for line in lines if line[:1] in (["comment"], ["obj_info"]))
    elements = _elements(lines)
    number = next((k for k, (name, *_) in enumerate(elements) if name == "vertex"), None)
    if number is None:
        raise ValueError("no element vertex in its header")
    _, count, properties = elements[number]
    names = ["_".join(words[3 if words[0] == "list" else 1 :]).lower() for words in properties]
    if not {*names} & {*"xyz"}:  # forms of the axes, as in tables
        names = [next((a for a in "xyz" if re.fullmatch(AXIS[0].format(a), name)), name) for name in names]
    if any(names.count(axis) != 1 for axis in "xyz"):
        raise ValueError(f"a vertex has {', '.join(names)[:80] or 'no properties'}; expected x, y and z once each")
    axes, is_last = [names.index(axis) for axis in "xyz"], number == len(elements) - 1
    types = [_type(words) for words in properties]
    if any(not isinstance(types[k], str) for k in axes):
        raise ValueError("x, y and z of its vertices are lists; expected a number each")
    if order:
        return _from_bytes(data, order, elements[: number + 1], axes, is_last)
    before = sum(count for _, count, _ in elements[:number])
    text = plain_nan(bytes(data))
    text = b"".join(text.splitlines(keepends=True)[before:]) if before else text
    fixed = next((k for k, each in enumerate(types) if not isinstance(each, str)), len(types))
    if fixed < len(types):
        if max(axes) > fixed:
            raise ValueError("x, y and z of its vertices follow a list; expected them before")
        text = re.sub(rb"^((?:\s*\S+){%d}).*$" % fixed, rb"\1", text, flags=re.MULTILINE)
    points = Table(text, fixed, first=len(lines) + before + 1).values(axes, None if is_last else count)
    if len(points) != count:
        raise ValueError(f"{len(points)} vertices; its header says {count}")
    return points


def _from_bytes(data: memoryview, order: str, elements: list[Element], axes: list[int], is_last: bool) -> Array:
    """Vertices ``(N, 3)`` of a binary file from the last of some ``elements``; ``axes``: numbers of the properties x, y
    and z; ``is_last``: whether it is the last of the file."""
    at, end, fields = 0, 0, None
    for _, count, properties in elements if len(data) else elements[-1:]:
        types, at = [_type(words) for words in properties], end
        plain = [order + each for each in types if isinstance(each, str)]
        sizes = [np.dtype(each).itemsize for each in plain]
        if len(plain) == len(types):
            fields, end = None, at + count * sum(sizes)
        else:
            fields, end = walked(data, at, count, order, types)
    if fields is None:
        found = xyz_of(data[at:], count, sum(sizes), [(plain[k], sum(sizes[:k])) for k in axes])
    else:
        bytes_of, found = np.frombuffer(data, np.uint8), np.empty((count, 3))
        for axis, k in enumerate(axes):
            kind = np.dtype(f"{order}{types[k]}")
            found[:, axis] = bytes_of[fields[:, k, None] + np.arange(kind.itemsize)].view(kind)[:, 0]
    if is_last and bytes(data[end:][: sum(sizes)]).strip():
        why = rewritten(data)
        raise ValueError(f"more bytes than those of {count} vertices of {sum(sizes)} bytes, as its header says{why}")
    return found


def _elements(lines: list[list[str]]) -> list[Element]:
    """Name, count and properties of each element."""
    elements: list[Element] = []
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


def _type(words: list[str]) -> Type:
    """NumPy's type of a property, or those of a list's length and of its items."""
    kinds = words[1:3] if words[0] == "list" else words[:1]
    if (
        not all(kind in TYPES for kind in kinds)
        or (len(kinds) > 1 and TYPES[kinds[0]][0] == "f")
        or len(words) <= (3 if words[0] == "list" else 1)
    ):
        raise ValueError(f"property {' '.join(words)[:60]!r}; expected one of {', '.join(TYPES)[:80]}, and a name")
    return TYPES[kinds[0]] if len(kinds) == 1 else (TYPES[kinds[0]], TYPES[kinds[1]])
