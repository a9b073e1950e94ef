"""Where the numbers of a PointCloud2 or of a depth image are in its bytes.

A driver's sizes are checked against the data before they are used. What has one sensible reading is read that way and
noted; anything else is an `InputError` of that message.
"""

from typing import Any, NamedTuple

import numpy as np

from steelnb.core.errors import InputError

POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Datatypes of PointField."""
DEPTHS = {"16UC1": "u2", "32FC1": "f4", "64FC1": "f8", "mono16": "u2", "Z16": "u2", "16SC1": "i2", "32SC1": "i4"}
"""Encodings of depth images, the first three by REP 118; some drivers have other names and types of integers."""
PLAUSIBLE_M = 1e-4, 1e7
"""Bounds of most coordinates, UTM included. Bytes in the wrong order give any power of ten."""
CERTAIN, DOUBTS = 0.48, 8.0
"""Values with at most the doubt `CERTAIN` (`_doubt`) are believed. The other byte order is taken only if the flagged
one is more than `DOUBTS` times as doubtful."""
ORDER = {"<": "little-endian", ">": "big-endian"}
PADDING_MAX = 64
"""Bytes that a driver may add to a row to align the next."""
SMOOTHER = 0.5
"""Points are read with another size than stated if neighbours in a row are then nearer to each other by this factor."""


class Layout(NamedTuple):
    """How the bytes of a message are read: ``shape`` rows × columns, ``strides`` in bytes, ``order`` of the bytes, and
    ``notes`` on what contradicts the message."""

    shape: tuple[int, int]
    strides: tuple[int, int]
    order: str
    notes: tuple[str, ...]


def cloud_layout(message: Any) -> Layout:
    """Layout of a PointCloud2. Raises `InputError`."""
    fields = xyz_fields(message)
    size, rows, columns, step = (int(n) for n in (len(message.data), message.height, message.width, message.point_step))
    needed = max(field.offset + _bytes(field) for field in fields)
    notes = []
    if not rows * columns:
        if not size:
            return Layout((0, 0), (step, step), "<", ())
        if (rows + columns) * step != size or step < needed:
            raise InputError(f"{size} bytes of data in {rows} × {columns} points")
        notes.append(f"{rows} × {columns} points are read as {rows + columns}")
        rows, columns = 1, rows + columns
    if step < needed:
        if size % (rows * columns) or size // (rows * columns) < needed:
            raise InputError(f"point_step {step}: expected {needed} bytes or more, as x, y and z end there")
        notes.append(f"point_step {step} is read as {size // (rows * columns)}")
        step = size // (rows * columns)
    row_step = int(message.row_step)
    if rows == 1 and columns * step > size == row_step and size % step == 0:
        notes.append(f"width {columns} is read as {size // step}, as row_step and the data say")
        columns = size // step
    each = size // (rows * columns)
    if each > step and each % step and size == rows * columns * each == rows * row_step:  # or rows are padded
        steps_m = [_typical_step(views(message, (rows, columns), (row_step, stride))) for stride in (step, each)]
        if each % _bytes(fields[0]) == 0 and steps_m[1] < SMOOTHER * steps_m[0]:
            notes.append(f"point_step {step} is read as {each}, as row_step and the data say")
            step = each
    row_step, note = _row_step("row_step", row_step, rows, columns, step, size)
    some = np.s_[:: rows // 8 + 1, :: columns // 64 + 1]  # some hundred values
    samples = [each[some].ravel() for each in views(message, (rows, columns), (row_step, step))]
    order, swapped = _byte_order(bool(message.is_bigendian), samples)
    notes += [note, swapped]
    integers = {POINT_TYPES[field.datatype] for field in fields if field.datatype < 7}
    notes += [f"x, y and z are integers ({', '.join(sorted(integers))}), taken as millimetres"] if integers else []
    return Layout((rows, columns), (row_step, step), order, tuple(filter(None, notes)))


def depth_layout(image: Any) -> Layout:
    """Layout of a depth image. Raises `InputError`."""
    encoding = depth_encoding(image.encoding)
    if encoding not in DEPTHS:
        raise InputError(f"encoding {image.encoding!r}; expected a depth image, {', '.join(DEPTHS)}")
    kind, rows, columns = np.dtype(DEPTHS[encoding]), int(image.height), int(image.width)
    if not rows * columns:
        raise InputError(f"{rows} × {columns} pixels")
    step, note = _row_step("step", int(image.step), rows, columns, kind.itemsize, len(image.data))
    if step // columns > kind.itemsize and step % columns == 0 and columns > PADDING_MAX:
        raise InputError(f"step {step} is {step // columns} bytes a pixel, and {image.encoding} has {kind.itemsize}")
    pixels = np.ndarray((rows, columns), kind, image.data, strides=(step, kind.itemsize))
    order, swapped = _byte_order(bool(image.is_bigendian), [pixels[:: rows // 8 + 1].ravel()])
    is_odd = kind.kind != "f" and image.encoding != "16UC1"
    renamed = f"encoding {image.encoding} is read as 16UC1, millimetres" if is_odd else ""
    return Layout((rows, columns), (step, kind.itemsize), order, tuple(filter(None, (note, swapped, renamed))))


def depth_encoding(name: str) -> str:
    """The encoding in `DEPTHS` that a name in any case, also with TYPE_ before it, stands for; else the name."""
    plain = {each.upper(): each for each in DEPTHS}
    return plain.get(name.upper().removeprefix("TYPE_"), name)


def xyz_fields(message: Any) -> list[Any]:
    """The fields x, y and z of a PointCloud2."""
    numeric = [field for field in message.fields if field.datatype in POINT_TYPES]
    fields = {field.name.lower(): field for field in reversed(numeric)}
    if not all(axis in fields for axis in "xyz"):
        names = ", ".join(str(field.name) for field in message.fields) or "none"
        kinds = {int(field.datatype) for field in message.fields if field.name in "xyz"} - POINT_TYPES.keys()
        odd = f" with datatype {', '.join(map(str, sorted(kinds)))}" if kinds else ""
        raise InputError(f"fields {names}{odd}; expected x, y and z of a numeric type")
    xyz = [fields[axis] for axis in "xyz"]
    if any(0 <= b.offset - a.offset < _bytes(a) for a in xyz for b in xyz if a is not b):
        raise InputError(f"fields x, y, z at bytes {', '.join(str(field.offset) for field in xyz)} overlap")
    return xyz


def _bytes(field: Any) -> int:
    return np.dtype(POINT_TYPES[field.datatype]).itemsize


def _row_step(name: str, declared: int, rows: int, columns: int, step: int, size: int) -> tuple[int, str]:
    """Bytes from row to row, and a note if these are not the ``declared`` ones. Raises `InputError`."""
    tight = columns * step
    if rows * tight > size:
        raise InputError(f"{size} bytes of data; expected {rows * tight} for {rows} × {columns} of {step} bytes")
    fits, as_stated = size // (rows * columns), (rows - 1) * declared + tight <= size <= rows * declared
    if size == rows * columns * fits and fits != step and not (declared >= tight and as_stated):
        # Another size of a point fits exactly: with the stated one, most points would be read from the wrong bytes.
        raise InputError(f"{size} bytes of data are {fits} for each of {rows} × {columns}; expected {step}, as stated")
    if rows == 1:  # many drivers leave it at zero, and nothing needs it
        is_row = size == tight or (size == declared and size - tight <= max(PADDING_MAX, step - 1))
        return tight, "" if is_row else f"data are {size - tight} bytes longer than their points: the rest is left out"
    if declared >= tight and as_stated:
        pad = declared - tight
        is_aligned = pad <= max(PADDING_MAX, step - 1)
        return declared, "" if is_aligned else f"rows are {pad} bytes longer than stated: these are left out"
    if rows * tight == size:
        return tight, f"{name} {declared} is read as {tight}, which fits the data"
    if declared >= tight and size > rows * declared and size % declared == 0 and size % rows:
        return declared, f"data are {size // declared - rows} rows longer than stated: the rest is left out"
    raise InputError(f"{name} {declared} and {size} bytes of data; expected {rows} rows of {tight} bytes or more")


def views(message: Any, shape: tuple[int, int], strides: tuple[int, int], order: str = "<") -> list[Any]:
    """The numbers ``(H, W)`` of x, y and z in the bytes of a PointCloud2."""
    kinds = [(f"{order}{POINT_TYPES[field.datatype]}", field.offset) for field in xyz_fields(message)]
    return [np.ndarray(shape, kind, message.data, offset, strides) for kind, offset in kinds]


def _typical_step(axes: list[Any]) -> float:
    """Median distance between neighbours in the rows; NaN for one column."""
    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.linalg.norm(np.diff(np.stack(axes).astype(float), axis=2), axis=0)
    return float(np.median(apart[np.isfinite(apart)])) if np.isfinite(apart).any() else np.nan


def _byte_order(is_big: bool, samples: list[Any]) -> tuple[str, str]:
    """Order of the bytes of ``samples``, which are little-endian views, and a note if it is not the flagged one.

    The flag is believed unless the other order is far more plausible: coordinates of a usual size, neighbours alike.
    """
    (flagged, other), is_known = (">", "<") if is_big else ("<", ">"), False
    for values in samples:
        doubt = _doubt(values.view(flagged + values.dtype.str[1:]))
        if doubt <= CERTAIN:
            return flagged, ""
        least = DOUBTS * _doubt(values.view(other + values.dtype.str[1:]))
        if doubt <= least:  # false for NaN, of values that say nothing
            return flagged, ""
        is_known |= doubt > least
    if not is_known:
        return flagged, ""
    return other, f"is_bigendian is {is_big}, but only as {ORDER[other]} the data make sense: they are read so"


@np.errstate(invalid="ignore", over="ignore")
def _doubt(values: Any) -> float:
    """How odd values look: for floats the share outside `PLAUSIBLE_M`, for integers the step between neighbours. NaN if
    there are none but zeros."""
    if values.dtype.kind == "f":
        size = np.abs(values[np.isfinite(values) & (values != 0)])
        odd = (size < PLAUSIBLE_M[0]) | (size > PLAUSIBLE_M[1])
        return float(odd.mean()) + CERTAIN / DOUBTS if size.size else np.nan
    returned = values[(values != 0) & ~no_return(values)].astype(float)
    steps = np.abs(np.diff(returned))
    # A constant image has no steps; then the nearer reading wins.
    return float(np.median(steps) + 1e-3 * np.median(np.abs(returned)) + CERTAIN / DOUBTS) if steps.size else np.nan


def no_return(raw: Any) -> Any:
    """Where a number is the largest of its type, or the smallest of a signed one: no return."""
    if raw.dtype.kind == "f":
        return np.abs(raw) == np.finfo(raw.dtype).max
    bounds = np.iinfo(raw.dtype)
    return (raw == bounds.max) | ((raw == bounds.min) & (bounds.min < 0))
