"""Reader of LAS files, and of LAZ files by lazrs, whose sizes are checked first (ASPRS LAS 1.0 to 1.4, LASzip 3.4)."""

import functools
import io
import itertools
import re
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from steelnb.core.types import Array
from steelnb.io.records import xyz_of

HEADER_MIN, RECORD_MIN = 227, (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
"""Minimum sizes of a header, and of a record of each point format."""
COMPRESSED, COUNT_IN_1_4 = 0xC0, 255
"""Bits of the point format that LASzip sets; size of a header with a count of 64 bits."""
FLAGS, WITHHELD = 15, (0x80, 0x04)
"""Byte of a record with the bit of points that are not to be used (LAS 1.1 to 1.4), and this bit in the formats up to 5
and from 6 on."""
OTHER_FLAGS = 0x60
"""The other two bits beside a class in the formats up to 5."""
POINTS_PER_BYTE_MAX = 100
"""Compressed points take a few bytes each."""
BLOCK = 1 << 20
LASZIP, VARIABLE, CHUNKED, LAYERED = (b"laszip encoded", 22204), 0xFFFFFFFF, 2, 3
"""Identification of LASzip's record in a header, its chunk size if chunks differ in size, and its compressors."""
SIZES = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Size in bytes, and number of layers, of each type of item; extra bytes have any size, and a layer each."""
FEET, UNIT_KEYS = {9002: "feet", 9003: "US survey feet"}, {3076: 3072, 4099: 4096}
"""Units that are not the metre; GeoTIFF's keys of the horizontal and the vertical one, each with that of the system's
code, by which `feet.txt` tells the unit if it is not given."""
LENGTH = re.compile(r'(?<!ANGLE)(?<!SCALE)UNIT\[\s*"([^"]+)"\s*,\s*([0-9.eE+-]+)')
GEOGRAPHIC, PROJECTED = re.compile("GEOGC|GEOGRAPHICCRS|GEODCRS|GEODETICCRS"), re.compile("PROJC|PROJECTEDCRS")
ANGLE = re.compile("deg|rad|grad|gon", re.IGNORECASE)
"""Units in a well-known text, its names of systems in degrees and in lengths, and names of units of angles."""


def read_las(path: Path) -> Array:
    """Points ``(N, 3)`` of a LAS or LAZ file; those that it withholds are NaN. Raises ValueError."""
    file = path.read_bytes()
    if len(file) < HEADER_MIN or not file.startswith(b"LASF"):
        raise ValueError(f"{len(file)} bytes that start with {file[:4]!r}; expected LASF and its header")
    size, begin, records, kind, stride, count = struct.unpack_from("<HIIBHI", file, 94)
    if file[25] >= 4 and min(size, len(file)) >= COUNT_IN_1_4:
        count = struct.unpack_from("<Q", file, 247)[0] or count
    scale, offset = np.frombuffer(file, "<f8", 6, 131).reshape(2, 3)
    form = kind & ~COMPRESSED
    if not HEADER_MIN <= size <= begin <= len(file) or form >= len(RECORD_MIN) or stride < RECORD_MIN[form]:
        raise ValueError(f"a header of {size} bytes, points of format {form} and {stride} bytes at {begin}")
    _check_metres(file, size, begin, records)
    if not np.isfinite(offset).all() or not (np.isfinite(scale) & (scale > 0)).all():
        raise ValueError(f"scales {scale.tolist()}, offsets {offset.tolist()}; expected finite numbers, scales above 0")
    # Behind the points stand waveforms (from LAS 1.3 on) or extended records (from 1.4 on).
    places = [at for at, minor in ((227, 3), (235, 4)) if file[25] >= minor and size >= at + 8]
    behind = [end for at in places if (end := struct.unpack_from("<Q", file, at)[0])]
    data = memoryview(file)[begin : min([*behind, len(file)])]
    if not kind & COMPRESSED and len(data) - count * stride >= stride:
        raise ValueError(f"{len(data) // stride} points; expected {count}, as its header says")
    points = _unpack(file, size, begin, records, stride, count) if kind & COMPRESSED else data
    xyz = xyz_of(points, count, stride, [("<i4", 0), ("<i4", 4), ("<i4", 8)])
    xyz *= scale
    xyz += offset
    if file[25] >= 1:
        flags = np.frombuffer(points, np.uint8)[: count * stride].reshape(count, stride)[:, FLAGS]
        is_withheld = flags & WITHHELD[form > 5] > 0
        are_classes = form < 6 and bool((flags & OTHER_FLAGS).any())  # some programs write classes up to 255 there
        xyz[is_withheld & (not are_classes and np.count_nonzero(is_withheld) < count / 2)] = np.nan
    return xyz


def _records(file: bytes, at: int, end: int, count: int, extended: bool = False) -> Iterator[tuple[bytes, int, bytes]]:
    """Author, number and content of each of the header's further records, or of the ``extended`` ones after the points,
    which are like them but for the size of their length."""
    form, size = ("<16sHQ", 60) if extended else ("<16sHH", 54)
    while count and at + size <= end:
        author, number, length = struct.unpack_from(form, file, at + 2)
        yield author.rstrip(b"\0"), number, file[at + size : at + size + length]
        at, count = at + size + length, count - 1


def _check_metres(file: bytes, at: int, end: int, count: int) -> None:
    """Raise ValueError if a coordinate system is given whose unit is not the metre."""
    after = struct.unpack_from("<QI", file, 235) if file[25] >= 4 and at >= COUNT_IN_1_4 else (0, 0)
    extended = _records(file, after[0], len(file), after[1], extended=True) if after[0] else ()
    for author, number, content in itertools.chain(_records(file, at, end, count), extended):
        unit = ""
        if author == b"LASF_Projection" and number == 34735:
            entries = struct.iter_unpack("<4H", content[8 : 8 + (max(len(content), 8) - 8) // 8 * 8])
            keys = {key: value for key, place, _, value in entries if not place}
            codes = [keys[code] for key, code in UNIT_KEYS.items() if key not in keys and keys.get(code) in _in_feet()]
            feet = [FEET[keys[key]] for key in UNIT_KEYS if keys.get(key) in FEET]
            feet += [f"another unit than the metre (EPSG {code})" for code in codes]
            unit = {2: "degrees", 3: "geocentric axes"}.get(keys.get(1024, 0), "".join(feet[:1]))
        elif author == b"LASF_Projection" and number == 2112:
            text = content.decode("utf-8", "replace")
            lengths = [(name, float(size)) for name, size in LENGTH.findall(text) if not ANGLE.match(name)]
            unit = next((name for name, size in lengths if abs(size - 1) > 1e-9), "")
            unit = "geocentric axes" if "GEOCCS" in text else unit
            unit = "degrees" if GEOGRAPHIC.search(text) and not PROJECTED.search(text) else unit
        if unit:
            raise ValueError(f"coordinates in {unit}, as its coordinate system says; expected metres")


@functools.cache
def _in_feet() -> frozenset[int]:
    """Codes of coordinate systems whose unit is not the metre."""
    lines = Path(__file__).with_name("feet.txt").read_text(encoding="ascii").splitlines()
    ranges = [word.partition("-") for line in lines if not line.startswith("#") for word in line.split()]
    return frozenset(code for low, _, high in ranges for code in range(int(low), int(high or low) + 1))


def _unpack(file: bytes, at: int, begin: int, records: int, stride: int, count: int) -> memoryview:
    """The records of compressed points. ``at``, ``begin``: where the header's further records and the points are."""
    import lazrs

    found = _records(file, at, begin, records)
    about = next((content for author, number, content in found if (author, number) == LASZIP), None)
    if about is None or len(about) < 34 or len(about) != 34 + 6 * about[32]:
        raise ValueError("compressed points, but no sound record of LASzip in its header")
    items = list(struct.iter_unpack("<HHH", about[34:]))
    compressor, chunk = struct.unpack_from("<H10xI", about)
    layers = sum(LAYERS.get(kind, size) for kind, size, _ in items) if compressor == LAYERED else None
    sound = all(SIZES.get(kind, size) == size and (kind > 9) == (compressor == LAYERED) for kind, size, _ in items)
    if not sound or compressor not in (CHUNKED, LAYERED) or sum(size for _, size, _ in items) != stride:
        raise ValueError(f"compressor {compressor} of items {items[:4]}; expected 2 or 3, and {stride} bytes a point")
    table = struct.unpack_from("<q", file, begin)[0] if begin + 8 <= len(file) else 0
    table = struct.unpack_from("<q", file, len(file) - 8)[0] if table == -1 else table
    chunks = struct.unpack_from("<4xI", file, table)[0] if begin + 8 <= table <= len(file) - 8 else 0
    most = len(file) // stride if chunk == VARIABLE else -(-count // max(chunk, 1))
    if not 0 < count <= POINTS_PER_BYTE_MAX * len(file) or not 0 < chunks <= min(most, len(file)):
        raise ValueError(f"truncated or damaged: {count} points, {chunks} blocks of them in {len(file)} bytes")
    unpacked, source = bytearray(), io.BytesIO(file)
    try:
        source.seek(begin)
        _check_chunks(file, begin + 8, table, lazrs.read_chunk_table(source, lazrs.LazVlr(about)), stride, layers)
        source.seek(begin)
        wanted = lazrs.SELECTIVE_DECOMPRESS_XY_RETURNS_CHANNEL | lazrs.SELECTIVE_DECOMPRESS_Z
        wanted |= lazrs.SELECTIVE_DECOMPRESS_FLAGS
        reader = lazrs.LasZipDecompressor(source, about, lazrs.DecompressionSelection(wanted))
        while len(unpacked) < count * stride:
            block = bytearray(min(BLOCK * stride, count * stride - len(unpacked)))
            reader.decompress_many(block)
            unpacked += block
    except BaseException as fault:  # a panic of Rust is no Exception
        if isinstance(fault, KeyboardInterrupt | SystemExit | MemoryError):
            raise
        raise ValueError(f"its compressed points are damaged, after {len(unpacked) // stride} of {count}") from None
    return memoryview(unpacked)


def _check_chunks(
    file: bytes, at: int, end: int, chunks: Sequence[tuple[int, int]], stride: int, layers: int | None
) -> None:
    """Raise ValueError if chunks, or layers of a chunk, are larger than what is there, as lazrs allocates them."""
    for _, size in chunks:
        held = stride
        if layers is not None:
            held += 4 * (layers + 1)
            if held <= size <= end - at:
                held += sum(struct.unpack_from(f"<{layers}I", file, at + stride + 4))
        if not held <= size <= end - at:
            raise ValueError
        at += size
