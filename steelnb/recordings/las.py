"""LAS and LAZ files ↔ points, a chunk at a time, by laspy and lazrs; what they raise for broken files is wrapped."""

import contextlib
import errno
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from steelnb.datatypes import Array
from steelnb.errors import EmptyCloudError, FileContentError

CHUNK = 1 << 20
STEP_M = 1e-5
"""Of the numbers written: files hold whole multiples of a step."""
_HEADER_BYTES = 375
_MOST_VLRS = 10_000


def read_las(path: Path) -> Array:
    """Points ``(N, 3)`` of a LAS or LAZ file, all in memory; raises as `las_chunks`."""
    return np.concatenate(list(las_chunks(path)))  # no room for all at once: the header may promise anything


def las_chunks(path: Path, size: int = CHUNK) -> Iterator[Array]:
    """Points ``(n, 3)`` of a LAS or LAZ file in its own coordinates, metres, ``size`` at most at a time.

    Raises `EmptyCloudError` for a file that promises no points and `FileContentError` for one that is no LAS file, is
    cut short or is damaged.
    """
    with _opened(path) as reader:
        scale, offset = np.asarray(reader.header.scales), np.asarray(reader.header.offsets)
        left = reader.header.point_count
        while left > 0:
            record = reader.read_points(min(size, left))
            if len(record) < min(size, left):
                raise FileContentError(f"{path}: cut short: {left - len(record)} points are missing")
            left -= len(record)
            with np.errstate(over="ignore", invalid="ignore"):
                points = [np.asarray(record[axis]) * scale[k] + offset[k] for k, axis in enumerate("XYZ")]
            yield np.stack(points, axis=1)


def las_count(path: Path) -> int:
    """How many points the header promises; raises as `las_chunks`."""
    with _opened(path) as reader:
        return int(reader.header.point_count)


def las_step(path: Path) -> float:
    """The coarsest step between the coordinates that the file can hold, metres; raises as `las_chunks`."""
    with _opened(path) as reader:
        return float(np.max(reader.header.scales))


def write_las(path: Path, points: Array) -> None:
    """Write finite points ``(N, 3)``, LAZ if the ending says so, in steps of 10 µm or what the extent allows.

    Points that are not finite are left out: the format has no place for them. Raises OSError.
    """
    import laspy

    points = points.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.offsets = np.floor(points.mean(axis=0)) if len(points) else np.zeros(3)
    extent = np.abs(points - header.offsets).max(initial=0.0)
    header.scales = np.full(3, STEP_M * 10.0 ** max(0, np.ceil(np.log10(max(extent, 1.0) / (2e9 * STEP_M)))))
    try:
        with laspy.open(path, "w", header=header, do_compress=path.suffix.lower() == ".laz") as writer:
            for first in range(0, len(points), CHUNK):
                some = points[first : first + CHUNK]
                record = laspy.ScaleAwarePointRecord.zeros(len(some), header=header)
                record.x, record.y, record.z = some.T
                writer.write_points(record)
    except RuntimeError as fault:  # lazrs has no other way to tell of a full disk
        raise OSError(errno.EIO, f"{fault} (is the disk full?)") from None


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    import laspy

    _refuse_foreign(path)
    only = laspy.DecompressionSelection.base() | laspy.DecompressionSelection.Z
    try:
        with laspy.open(
            path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False, decompression_selection=only
        ) as reader:
            if not (np.isfinite(reader.header.scales).all() and np.isfinite(reader.header.offsets).all()):
                raise FileContentError(f"{path}: scale {reader.header.scales}; expected finite numbers")
            if reader.header.point_count < 1:
                raise EmptyCloudError(f"{path}: its header promises no points, expected at least two")
            if reader.header.are_points_compressed and (
                reader.point_source.vlr.item_size() != reader.header.point_format.size
            ):
                raise FileContentError(f"{path}: its compressed points have another size than its header says")
            yield reader
    except (FileContentError, EmptyCloudError, GeneratorExit, KeyboardInterrupt):
        raise
    except BaseException as fault:  # of laspy, of what lies beneath, and of Rust, whose panic is no Exception
        said = str(fault).splitlines()[0][:100] if str(fault) else type(fault).__name__
        raise FileContentError(f"{path}: no whole LAS file: {said}") from None


def _refuse_foreign(path: Path) -> None:
    """What laspy would stumble over: other files, and numbers in the header that cost time or memory."""
    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
    size = path.stat().st_size
    if header[:4] != b"LASF":
        raise FileContentError(f"{path}: begins with {header[:4]!r}; expected b'LASF'")
    if len(header) < 227:
        raise FileContentError(f"{path}: {size} bytes; expected a header of at least 227")

    def number(first: int, last: int) -> int:
        return int.from_bytes(header[first:last], "little")

    start, vlrs, record = number(96, 100), number(100, 104), number(105, 107)
    count = number(247, 255) if header[24:26] == b"\1\4" and len(header) >= 255 else number(107, 111)
    if start > size or vlrs > _MOST_VLRS or not record:
        raise FileContentError(f"{path}: points from byte {start} of {size}, {vlrs} notes before: cut short or damaged")
    if header[104] >= 128:
        _refuse_chunks(path, start, size, record)
    elif start + count * record > size:
        raise FileContentError(
            f"{path}: {size} bytes; expected {start + count * record} for the {count} points that its header promises"
        )


def _refuse_chunks(path: Path, start: int, size: int, record: int) -> None:
    """A number of chunks that the file cannot hold: lazrs would make room for them, and end the process."""
    with path.open("rb") as file:
        file.seek(start)
        table = int.from_bytes(file.read(8), "little", signed=True)
        if table < 0 and size >= 8:  # written by a program that could not go back: it stands at the end
            file.seek(size - 8)
            table = int.from_bytes(file.read(8), "little", signed=True)
        file.seek(min(max(table, 0), size))
        head = file.read(8)
    chunks = int.from_bytes(head[4:], "little")
    # The first point of each chunk stands there as it is.
    if not start + 8 <= table <= size - 8 or chunks * record > size:
        raise FileContentError(f"{path}: {chunks} chunks listed at byte {table} of {size}: cut short or damaged")
