"""Binary records of points, whose size is checked against the file before anything is allocated."""

from collections.abc import Sequence

import numpy as np

from steelnb.core.types import Array

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
