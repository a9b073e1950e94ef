"""Points of PLY and PCD files, and the refusal of those that are cut short.

The file is read here and not by Open3D because Open3D 0.19 and 0.20 only warn about a truncated file and then return a
cloud of full length, whose missing points are zeros; and their PCD reader returns zeros for coordinates of 8 bytes.
Only the decompression of PCD is left to Open3D, whose tensor reader keeps 8 bytes.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from steelnb.datatypes import Array
from steelnb.errors import EmptyCloudError, FileContentError
from steelnb.recordings.text import TextLayout, read_lines

_HEADER_BYTES = 1 << 20
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_ORDER = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_PCD_TYPES = {
    (kind, size): f"<{kind.lower()}{size}" for kind in "FIU" for size in ("1", "2", "4", "8") if kind + size != "F1"
}


@dataclass(frozen=True)
class PointLayout:
    """Where the points of a file are: ``count`` records of ``fields`` (name, numpy type, how many) after ``offset``
    bytes or, in text, after ``lines`` lines. More than one of ``rows`` make
    them an image."""

    encoding: Literal["ascii", "binary", "compressed"]
    fields: tuple[tuple[str, str, int], ...]
    count: int
    offset: int
    lines: int
    rows: int = 1

    @property
    def dtype(self) -> np.dtype:
        # Names may repeat (PCD calls all its padding "_"), so the fields are numbered.
        return np.dtype([(f"f{k}", kind, (many,)) for k, (_, kind, many) in enumerate(self.fields)])


def read_ply(path: Path) -> Array:
    """Points ``(N, 3)`` of a PLY file, ASCII or binary of either byte order. Raises `FileContentError`."""
    return _read(path, _ply_layout(path))


def read_pcd(path: Path) -> Array:
    """Points ``(N, 3)`` of a PCD file, ASCII, binary or compressed. Raises `FileContentError`."""
    return _read(path, _pcd_layout(path))


def read_pcd_image(path: Path) -> Array:
    """As `read_pcd`, but ``(H, W, 3)`` where the header tells of more than one row."""
    layout = _pcd_layout(path)
    points = _read(path, layout)
    return points.reshape(layout.rows, -1, 3) if layout.rows > 1 else points


def binary_chunks(path: Path, size: int) -> Iterator[Array] | None:
    """Points ``(n, 3)`` of a binary PLY or PCD file, ``size`` at most at a time; None for one of another encoding."""
    layout = _layout(path)
    if layout.encoding != "binary":
        return None
    return _chunks(path, layout, size)


def point_count(path: Path) -> int:
    """How many points the header of a PLY or PCD file promises. Raises `FileContentError`."""
    return _layout(path).count


def _layout(path: Path) -> PointLayout:
    return (_ply_layout if path.suffix.lower() == ".ply" else _pcd_layout)(path)


def _chunks(path: Path, layout: PointLayout, size: int) -> Iterator[Array]:
    axes = _axes(path, layout)
    _refuse_short(path, layout)
    for first in range(0, layout.count, size):
        place = layout.offset + first * layout.dtype.itemsize
        yield _coordinates(np.fromfile(path, layout.dtype, min(size, layout.count - first), offset=place), axes)


def _read(path: Path, layout: PointLayout) -> Array:
    axes = _axes(path, layout)
    if layout.encoding == "ascii":
        before = [sum(many for _, _, many in layout.fields[:axis]) for axis in axes]
        return read_lines(path, TextLayout(layout.lines, None, ".", (before[0], before[1], before[2]), layout.count))
    if layout.encoding == "compressed":
        return _decompressed(path, layout, path.stat().st_size - layout.offset)
    _refuse_short(path, layout)
    return _coordinates(np.fromfile(path, layout.dtype, layout.count, offset=layout.offset), axes)


def _axes(path: Path, layout: PointLayout) -> list[int]:
    """Which of the fields are x, y and z."""
    names = [name for name, _, _ in layout.fields]
    if not all(axis in names for axis in "xyz"):
        raise FileContentError(f"{path}: its points have the fields {', '.join(names) or 'none'}; expected x, y and z")
    if layout.count < 1:
        raise EmptyCloudError(f"{path}: its header promises {layout.count} points, expected at least two")
    return [names.index(axis) for axis in "xyz"]


def _refuse_short(path: Path, layout: PointLayout) -> None:
    size, expected = path.stat().st_size, layout.offset + layout.count * layout.dtype.itemsize
    if expected > size:
        raise FileContentError(
            f"{path}: {size} bytes; expected {expected} for the {layout.count} points that its header promises"
        )


def _coordinates(records: NDArray, axes: list[int]) -> Array:
    return np.stack([records[f"f{axis}"][:, 0].astype(np.float64) for axis in axes], axis=1)


def _decompressed(path: Path, layout: PointLayout, bytes_left: int) -> Array:
    with path.open("rb") as file:
        file.seek(layout.offset)
        sizes = np.frombuffer(file.read(8), "<u4")
    if len(sizes) < 2 or sizes[0] + 8 > bytes_left or sizes[1] != layout.count * layout.dtype.itemsize:
        raise FileContentError(f"{path}: cut short, or its compressed size is not that of {layout.count} points")
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.t.io.read_point_cloud(path)
    points = cloud.point.positions.numpy() if "positions" in cloud.point else np.zeros((0, 3))
    if len(points) != layout.count:
        raise FileContentError(f"{path}: {len(points)} points, expected the {layout.count} that its header promises")
    return np.asarray(points, dtype=np.float64)


def _header(path: Path, last: str) -> tuple[list[list[str]], int]:
    """The words of each header line up to the one that starts with ``last``, and how many bytes the lines take."""
    with path.open("rb") as file:
        data = file.read(_HEADER_BYTES)
    lines: list[list[str]] = []
    offset = 0
    while (end := data.find(b"\n", offset)) >= 0:
        lines.append(data[offset:end].decode("ascii", errors="replace").split())
        offset = end + 1
        if lines[-1][:1] == [last]:
            return lines, offset
    raise FileContentError(f"{path}: its header does not end; expected a line that begins with {last}")


def _ply_layout(path: Path) -> PointLayout:
    header, offset = _header(path, "end_header")
    if header[0] != ["ply"]:
        raise FileContentError(f"{path}: begins with {' '.join(header[0])[:20]!r}; expected 'ply'")
    encoding = next((words[1] for words in header if words[0] == "format" and len(words) > 1), "")
    if encoding not in _PLY_ORDER:
        raise FileContentError(f"{path}: format {encoding!r}; expected one of {', '.join(_PLY_ORDER)}")
    element, count, lines = "", 0, len(header)
    fields: list[tuple[str, str, int]] = []
    for words in header:
        where = f"{path}: {' '.join(words)!r}"
        match words:
            case ["element", "vertex", number]:
                element, count = "vertex", _whole(where, number)
            case ["element", name, number]:
                if element != "vertex" and not fields:
                    # Lines can be skipped; elements of unknown length cannot.
                    if encoding != "ascii" and _whole(where, number):
                        raise FileContentError(f"{where} before the vertices; expected the vertices first")
                    lines += _whole(where, number)
                element = name
            case ["property", "list", *_] if element == "vertex":
                raise FileContentError(f"{where} in the vertices; expected no list there")
            case ["property", kind, name] if element == "vertex":
                if kind not in _PLY_TYPES:
                    raise FileContentError(f"{where}; expected a type out of {', '.join(_PLY_TYPES)}")
                fields.append((name, _PLY_ORDER[encoding] + _PLY_TYPES[kind], 1))
    return PointLayout("ascii" if encoding == "ascii" else "binary", tuple(fields), count, offset, lines)


def _pcd_layout(path: Path) -> PointLayout:
    header, offset = _header(path, "DATA")
    entry = {words[0]: words[1:] for words in header if words}
    names = entry.get("FIELDS", [])
    sizes, kinds, many = (entry.get(key, []) for key in ("SIZE", "TYPE", "COUNT"))
    many = many or ["1"] * len(names)
    if not names or not len(names) == len(sizes) == len(kinds) == len(many):
        raise FileContentError(f"{path}: expected FIELDS, SIZE, TYPE and COUNT of equal length in its header")
    fields = []
    for name, size, kind, number in zip(names, sizes, kinds, many, strict=True):
        if (kind, size) not in _PCD_TYPES:
            raise FileContentError(
                f"{path}: field {name!r} has type {kind!r} and size {size!r}; expected F 4, F 8, ..."
            )
        fields.append((name, _PCD_TYPES[kind, size], _whole(f"{path}: COUNT {number!r}", number, 10**4)))
    size_of = {
        key: _whole(f"{path}: {key}", " ".join(entry[key])) for key in ("POINTS", "WIDTH", "HEIGHT") if key in entry
    }
    count = size_of.get("POINTS", size_of.get("WIDTH", 0) * size_of.get("HEIGHT", 1))
    rows = size_of.get("HEIGHT", 1) if size_of.get("WIDTH", 0) * size_of.get("HEIGHT", 1) == count else 1
    encodings: dict[str, Literal["ascii", "binary", "compressed"]]
    encodings = {"ascii": "ascii", "binary": "binary", "binary_compressed": "compressed"}
    encoding = " ".join(entry["DATA"])
    if encoding not in encodings:
        raise FileContentError(f"{path}: DATA {encoding!r}; expected one of {', '.join(encodings)}")
    return PointLayout(encodings[encoding], tuple(fields), count, offset, len(header), rows)


def _whole(where: str, number: str, most: int = 10**12) -> int:
    if not (number.isascii() and number.isdigit() and len(number) < 20 and int(number) <= most):
        raise FileContentError(f"{where}; expected a whole number up to {most:.0e}, got {number!r}")
    return int(number)
