"""sensor_msgs/PointCloud2 ↔ points, with NumPy alone.

A message says where in each record its fields lie; the records are read where they are. What does not fit together is
refused before anything is allocated, so that a corrupt message costs no more memory than it has bytes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steelnb.datatypes import Array
from steelnb.errors import FileContentError

DATATYPES = {1: "INT8", 2: "UINT8", 3: "INT16", 4: "UINT16", 5: "INT32", 6: "UINT32", 7: "FLOAT32", 8: "FLOAT64"}
FLOATS = {7: "f4", 8: "f8"}


@dataclass(frozen=True)
class PointField:
    """One number, or ``count`` of them, ``offset`` bytes into each record."""

    name: str
    offset: int
    datatype: int
    count: int = 1


@dataclass(frozen=True)
class PointCloud2:
    """The message but for its header: ``height`` rows of ``width`` records of ``point_step`` bytes in ``data``."""

    height: int
    width: int
    fields: tuple[PointField, ...]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: NDArray[np.uint8]
    is_dense: bool


def encode_points(points: Array) -> PointCloud2:
    """Points ``(N, 3)`` or, organised, ``(H, W, 3)`` as float32 x, y, z without padding."""
    rows, columns = points.shape[:2] if points.ndim == 3 else (1, len(points))
    with np.errstate(over="ignore", invalid="ignore"):
        numbers = np.ascontiguousarray(points, dtype="<f4")
    dense = bool(np.isfinite(numbers).all())
    fields = tuple(PointField(axis, 4 * k, 7) for k, axis in enumerate("xyz"))
    return PointCloud2(rows, columns, fields, False, 12, 12 * columns, numbers.reshape(-1).view(np.uint8), dense)


def decode_points(message: Any) -> Array:
    """The points of a message with the attributes of `PointCloud2`: ``(H, W, 3)`` where it is organised, else
    ``(N, 3)``; float64, NaN rows where a coordinate is not finite, whatever ``is_dense`` says.

    Other fields, padding, and bytes behind the last row are ignored, and so is the ``row_step`` of a single row, which
    many drivers leave at zero. Raises `FileContentError` with the value that does not fit.
    """
    height, width = _whole(message, "height"), _whole(message, "width")
    step, row = _whole(message, "point_step"), _whole(message, "row_step")
    if height == 0 or width == 0:
        return np.zeros((0, 3))
    layout = _layout(message.fields, step, ">" if message.is_bigendian else "<")
    if height == 1:
        row = width * step
    if row < width * step:
        raise FileContentError(f"row_step {row}; expected at least {width * step} for {width} points of {step} bytes")
    data = _bytes(message.data)
    if len(data) < height * row:
        raise FileContentError(f"data of {len(data)} bytes; expected {height * row} for {height} rows of {row}")
    points = np.empty((height, width, 3))
    with np.errstate(invalid="ignore", over="ignore"):  # signalling NaN; sums of the largest numbers
        for k, (kind, offset) in enumerate(layout):
            points[..., k] = np.ndarray((height, width), kind, data, offset, (row, step))
        invalid = ~np.isfinite(points @ np.ones(3))
    if invalid.any():
        points[invalid] = np.nan
    return points if height > 1 and width > 1 else points.reshape(-1, 3)


def _layout(fields: Sequence[Any], step: int, order: str) -> list[tuple[str, int]]:
    """Type and offset of x, y and z in a record of ``step`` bytes."""
    layout = []
    names = [field.name for field in fields]
    for axis in "xyz":
        if names.count(axis) != 1:
            shown = ", ".join(map(str, names[:20])) or "none"
            raise FileContentError(f"fields {shown}; expected one {axis}")
        field = fields[names.index(axis)]
        if field.datatype not in FLOATS:
            named = DATATYPES.get(field.datatype, field.datatype)
            raise FileContentError(f"field {axis} of datatype {named}; expected FLOAT32 or FLOAT64")
        if _whole(field, "count") > 1:  # old drivers write 0 for 1
            raise FileContentError(f"field {axis} with count {field.count}; expected 1")
        layout.append((order + FLOATS[field.datatype], _whole(field, "offset")))
    spans = sorted((offset, offset + np.dtype(kind).itemsize) for kind, offset in layout)
    if spans[-1][1] > step:
        raise FileContentError(f"point_step {step}; expected at least {spans[-1][1]}, where its fields end")
    if any(start < end for (_, end), (start, _) in pairwise(spans)):
        raise FileContentError(f"x, y, z at bytes {[at for _, at in layout]}; expected fields that do not overlap")
    return layout


def _whole(holder: Any, name: str) -> int:
    value = getattr(holder, name)
    if not 0 <= value < 2**32:
        raise FileContentError(f"{name} {value}; expected a whole number from 0 to 2³² − 1")
    return int(value)


def _bytes(data: Any) -> NDArray[np.uint8]:
    return np.frombuffer(data, dtype=np.uint8) if len(data) else np.zeros(0, np.uint8)
