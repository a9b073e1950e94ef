"""Point files → coordinates, a chunk at a time: PLY (plyfile), LAS and LAZ (laspy), PCD, NPY and text (`text_points`).

`reading` is the boundary for what they raise.
"""

import io
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from steelnb.errors import FileContentError, UnsupportedFormatError
from steelnb.files import reading
from steelnb.io.text_points import TextLayout, sniff, text_chunks
from steelnb.libraries import import_open3d
from steelnb.types import Array

CHUNK = 1 << 20
_HEADER_BYTES = 1 << 16
_MOST_VLRS = 10_000
_LAYERS = {128 + 6: (9, 30), 128 + 7: (10, 36), 128 + 8: (11, 38), 128 + 9: (10, 59), 128 + 10: (12, 67)}
"""Compressed point formats in layers: how many, each extra byte being one more, and bytes of a point (LAS 1.4 R15)."""


@dataclass(frozen=True)
class PointFile:
    """Points of a file. ``chunks``: arrays ``(n, 3)``, read as they are iterated over; ``shape``: ``(H, W)`` of an
    organised cloud, else ``(-1,)``; ``step_m``: coarsest step between the coordinates of a LAS file, else 0."""

    chunks: Iterable[Array]
    shape: tuple[int, ...] = (-1,)
    step_m: float = 0.0


def open_points(path: Path) -> PointFile:
    """Open a point file; its ending decides on the format, in any case.

    Raises `FileMissingError`, `UnsupportedFormatError` and, now or while the chunks are read, `FileContentError`.
    """
    with reading(path, f"a {path.suffix[1:].upper()} file of points"):
        reader = READERS.get(path.suffix.lower())
        if reader is None:
            raise UnsupportedFormatError(f"{path}: ending {path.suffix!r}; expected one of {', '.join(READERS)}")
        file = reader(path)
    return PointFile(_guarded(path, file.chunks), file.shape, file.step_m)


def _guarded(path: Path, chunks: Iterable[Array]) -> Iterator[Array]:
    with reading(path, f"a {path.suffix[1:].upper()} file of points"):
        yield from chunks


def _read_text(path: Path) -> PointFile:
    return PointFile(text_chunks(path, sniff(path), CHUNK))


def _read_npy(path: Path) -> PointFile:
    values = np.load(path, mmap_mode="r", allow_pickle=False)
    good = isinstance(values, np.ndarray) and values.ndim in (2, 3) and values.shape[-1] >= 3
    if not good or values.dtype.kind not in "fiu":
        content = f"{values.dtype} of shape {values.shape}" if isinstance(values, np.ndarray) else "several arrays"
        raise FileContentError(f"{path}: {content}; expected numbers of shape (N, 3) or (H, W, 3)")
    points = values[..., :3].reshape(-1, 3)
    return PointFile((_float64(points[k : k + CHUNK]) for k in range(0, len(points), CHUNK)), values.shape[:-1])


def _read_ply(path: Path) -> PointFile:
    from plyfile import PlyData

    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
        head = io.BytesIO(header)
        ply = PlyData._parse_header(head)  # PlyData.read would read the faces too, one by one
        offset = head.tell()
    vertex = ply.elements[0] if ply.elements else None
    if vertex is None or vertex.name != "vertex":
        raise FileContentError(f"{path}: elements {[e.name for e in ply.elements]}; expected the vertices first")
    dtype = np.dtype(vertex.dtype("<" if ply.text else ply.byte_order))
    if dtype.hasobject:
        raise FileContentError(f"{path}: a list in the vertices; expected numbers alone")
    axes = _axes(path, list(dtype.names or ()))
    if ply.text:
        lines = header[:offset].count(b"\n")
        return PointFile(text_chunks(path, TextLayout(lines, columns=axes, rows=vertex.count), CHUNK))
    return PointFile(_records(path, dtype, axes, offset, vertex.count))


def _read_pcd(path: Path) -> PointFile:
    header: dict[str, list[str]] = {}
    lines = 0
    with path.open("rb") as file:
        while "DATA" not in header:
            words = file.readline(_HEADER_BYTES).decode("ascii", errors="replace").split()
            if file.tell() > _HEADER_BYTES or (not words and not file.peek(1)):
                raise FileContentError(f"{path}: its header does not end; expected a line that begins with DATA")
            lines += 1
            header |= {words[0]: words[1:]} if words else {}
        offset = file.tell()
    names = header.get("FIELDS", [])
    sizes, kinds = header.get("SIZE", []), header.get("TYPE", [])
    many = header.get("COUNT", ["1"] * len(names))
    if not names or not len(names) == len(sizes) == len(kinds) == len(many):
        raise FileContentError(f"{path}: expected FIELDS, SIZE, TYPE and COUNT of equal length in its header")
    # Names may repeat (PCL calls all its padding "_"), so the fields are numbered.
    fields = zip(kinds, sizes, many, strict=True)
    dtype = np.dtype([(f"f{k}", f"<{kind.lower()}{size}", (int(n),)) for k, (kind, size, n) in enumerate(fields)])
    columns, rows, count = (int(header.get(key, ["1"])[0]) for key in ("WIDTH", "HEIGHT", "POINTS"))
    count = count if "POINTS" in header else columns * rows
    shape = (rows, columns) if rows > 1 and rows * columns == count else (-1,)
    axes, encoding = _axes(path, names), " ".join(header["DATA"])
    if encoding == "binary":
        return PointFile(_records(path, dtype, axes, offset, count), shape)
    if encoding == "binary_compressed":
        return PointFile(_compressed(path, offset, count * dtype.itemsize, count), shape)
    if encoding != "ascii":
        raise FileContentError(f"{path}: DATA {encoding!r}; expected one of ascii, binary, binary_compressed")
    first = np.cumsum([0, *(int(n) for n in many)])
    layout = TextLayout(lines, columns=(int(first[axes[0]]), int(first[axes[1]]), int(first[axes[2]])), rows=count)
    return PointFile(text_chunks(path, layout, CHUNK), shape)


def _axes(path: Path, names: list[str]) -> tuple[int, int, int]:
    """Places of x, y and z among the fields."""
    if not all(axis in names for axis in "xyz"):
        raise FileContentError(f"{path}: its points have the fields {', '.join(names) or 'none'}; expected x, y and z")
    return names.index("x"), names.index("y"), names.index("z")


def _records(path: Path, dtype: np.dtype, axes: tuple[int, ...], offset: int, count: int) -> Iterator[Array]:
    """Coordinates in binary records; the one check that a PLY or PCD file is as long as its header promises."""
    size, expected = path.stat().st_size, offset + count * dtype.itemsize
    if count < 0 or expected > size:
        raise FileContentError(f"{path}: {size} bytes; expected {expected} for the {count} points of its header")
    for first in range(0, count, CHUNK):
        place = offset + first * dtype.itemsize
        yield _columns(np.fromfile(path, dtype, min(CHUNK, count - first), offset=place), axes)


def _columns(records: Any, axes: tuple[int, ...]) -> Array:
    names = records.dtype.names
    return np.stack([_float64(records[names[axis]]).reshape(len(records), -1)[:, 0] for axis in axes], axis=1)


def _float64(values: Any) -> Array:
    return np.asarray(values, dtype=np.float64)


def _compressed(path: Path, offset: int, size: int, count: int) -> Iterator[Array]:
    """Coordinates in a compressed PCD file, by Open3D, which would give zeros for one that is cut short."""
    o3d = import_open3d()
    with path.open("rb") as file:
        file.seek(offset)
        packed, plain = struct.unpack("<II", file.read(8))
    if plain != size or offset + 8 + packed > path.stat().st_size:
        raise FileContentError(f"{path}: cut short, or its compressed size is not that of {count} points")
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.t.io.read_point_cloud(path, format="pcd")
    found = cloud.point.positions.numpy() if "positions" in cloud.point else np.zeros((0, 3))
    if found.shape != (count, 3):
        raise FileContentError(f"{path}: {len(found)} points could be decompressed; expected {count}")
    yield _float64(found)


def _read_las(path: Path) -> PointFile:
    import laspy

    _refuse_damaged_las(path)
    with laspy.open(path, read_evlrs=False) as reader:
        step_m = float(np.max(reader.header.scales))
        if not np.isfinite([*reader.header.scales, *reader.header.offsets]).all():
            raise FileContentError(f"{path}: scales {reader.header.scales}; expected finite numbers")
    return PointFile(_las_chunks(path), step_m=step_m)


def _las_chunks(path: Path) -> Iterator[Array]:
    import laspy

    only = laspy.DecompressionSelection.base() | laspy.DecompressionSelection.Z
    options: dict[str, Any] = {"laz_backend": laspy.LazBackend.Lazrs, "decompression_selection": only}
    with laspy.open(path, read_evlrs=False, **options) as reader:  # a damaged header may promise billions of EVLRs
        header, left = reader.header, reader.header.point_count
        if left and header.are_points_compressed and reader.point_source.vlr.item_size() != header.point_format.size:
            raise FileContentError(f"{path}: its compressed points have another size than its header says")
        while left > 0:
            record = reader.read_points(min(CHUNK, left))
            if len(record) < min(CHUNK, left):
                raise FileContentError(f"{path}: cut short: {left - len(record)} points are missing")
            left -= len(record)
            with np.errstate(over="ignore", invalid="ignore"):
                yield np.stack([np.asarray(record.x), np.asarray(record.y), np.asarray(record.z)], axis=1)


def _refuse_damaged_las(path: Path) -> None:
    """Refuse numbers in a header that cost laspy time or memory, or on which lazrs aborts the process."""
    size = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(375)
        if header[:4] != b"LASF":
            raise FileContentError(f"{path}: begins with {header[:4]!r}; expected b'LASF'")
        header = header.ljust(375, b"\0")
        start, vlrs = struct.unpack_from("<II", header, 96)
        form, record, count = struct.unpack_from("<BHI", header, 104)
        if header[24:26] == b"\1\4":
            (count,) = struct.unpack_from("<Q", header, 247)
        least = record if form >= 128 else count * record
        if size < 227 or not record or vlrs > _MOST_VLRS or start + least * (count > 0) > size:
            raise FileContentError(
                f"{path}: {size} bytes; expected {count} points of {record} bytes from byte {start}, as in its header"
            )
        if form < 128:
            return
        file.seek(start)
        table = int.from_bytes(file.read(8), "little", signed=True)
        if table < 0:  # written by a program that could not go back: it stands at the end
            file.seek(-8, 2)
            table = int.from_bytes(file.read(8), "little", signed=True)
        file.seek(min(max(table, 0), size))
        chunks = int.from_bytes(file.read(8)[4:], "little")
        # The first point of each chunk stands there as it is.
        whole = start + 8 <= table <= size - 8 and chunks * record <= size
        if whole and form in _LAYERS:
            whole = _end_of_chunks(file, start + 8, table, chunks, record, _LAYERS[form]) == table
    if not whole:
        raise FileContentError(f"{path}: {chunks} chunks listed at byte {table} of {size}: cut short or damaged")


def _end_of_chunks(file: BinaryIO, begin: int, end: int, chunks: int, record: int, kind: tuple[int, int]) -> int:
    """Where the last chunk ends. A chunk is its first point, their number, the sizes of its layers, and these: lazrs
    takes as much memory as the sizes ask for. ``kind``: number of layers, and bytes of a record without extra ones."""
    layers = kind[0] + max(record - kind[1], 0)
    while begin < end and chunks > 0:
        file.seek(begin + record + 4)
        begin = file.tell() + 4 * layers + int(np.frombuffer(file.read(4 * layers), "<u4").sum(dtype=np.int64))
        chunks -= 1
    return begin


READERS = (
    {".ply": _read_ply, ".pcd": _read_pcd, ".las": _read_las, ".laz": _read_las}
    | dict.fromkeys((".xyz", ".txt", ".csv", ".pts", ".asc"), _read_text)
    | {".npy": _read_npy}
)
