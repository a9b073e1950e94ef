"""Binary records of points, whose size is checked against the file before anything is allocated."""

import struct
from collections.abc import Sequence

import numpy as np

from steelnb.core.types import Array, IntArray

HEADER_MAX = 1 << 16
"""No text header is longer."""


def is_whole(word: str) -> bool:
    """Whether a word of a header is a whole number, of at most 18 digits."""
    return word.isascii() and word.isdigit() and len(word) < 19


def xyz_of(data: bytes | memoryview, count: int, stride: int, fields: Sequence[tuple[str, int]]) -> Array:
    """Points ``(count, 3)`` of records of ``stride`` bytes at the start of ``data``.

    ``fields``: type (as of NumPy) and offset in the record of x, y and z. Raises ValueError if the data are too short.
    """
    if not 0 < count * stride <= len(data):
        raise ValueError(f"{len(data)} bytes of points; expected {count} of {stride} bytes each, as its header says")
    types, offsets = zip(*fields, strict=True)
    record = np.dtype({"names": ["x", "y", "z"], "formats": types, "offsets": offsets, "itemsize": stride})
    table = np.frombuffer(data, record, count)
    points = np.empty((count, 3))
    for k, axis in enumerate("xyz"):
        points[:, k] = table[axis]
    return points


def walked(
    data: memoryview, at: int, count: int, order: str, types: Sequence[str | tuple[str, str]]
) -> tuple[IntArray, int]:
    """Where each field of records with lists begins ``(count, F)``, and where the records end.

    The records begin at ``at``. ``order``: of bytes; ``types``: of each field as of NumPy, or those of a list's length
    and of its items. Raises ValueError if the data are too short.
    """
    if count > (left := max(len(data) - at, 0)):  # each record has a byte or more
        raise ValueError(f"{left} bytes; expected {count} records with lists, as its header says")
    begin = np.empty((count, len(types)), dtype=np.int64)
    lengths = [None if isinstance(each, str) else struct.Struct(order + np.dtype(each[0]).char) for each in types]
    sizes = [np.dtype(each if isinstance(each, str) else each[1]).itemsize for each in types]
    for record in range(count):
        for field, (length, size) in enumerate(zip(lengths, sizes, strict=True)):
            begin[record, field] = at
            if length is None:
                at += size
            elif at + length.size <= len(data):
                items = length.unpack_from(data, at)[0]
                at += length.size + max(int(items), 0) * size
            if at > len(data) or (length is not None and at == begin[record, field]):
                raise ValueError(f"{len(data)} bytes end in record {record}; expected {count}, as its header says")
    return begin, at
