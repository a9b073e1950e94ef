"""Reader of point files: NPY, NPZ, PLY, PCD, LAS, LAZ and text. What it does not understand is refused, not guessed.
Writer of PLY."""

import os
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from steelnb.core.arguments import checks_arguments
from steelnb.core.checks import COORDINATE_MAX_M, check_length, checked_array
from steelnb.core.errors import InputError
from steelnb.core.files import new_file, reading
from steelnb.core.types import Array, IntArray, shift_of, translated
from steelnb.hough.lines import spacing
from steelnb.io.column_names import AXIS
from steelnb.io.coordinates import check_degrees, check_first_column, check_geocentric, check_steps, is_stray
from steelnb.io.encodings import foreign_file
from steelnb.io.las import read_las
from steelnb.io.pcd import read_pcd
from steelnb.io.ply import read_ply
from steelnb.io.table_form import read_table

EXTENT_MAX_M, SPACING_MAX_M = 500.0, 1.0
"""A cloud that exceeds both extent and spacing is probably in millimetres: no scanner is that sparse."""
CENTIMETRES_MAX = 5000.0
"""A structure of this extent in centimetres is 50 m large."""
LINES_LOOKED_AT = 100
"""Number of lines by which decimal commas are recognised."""
COORDINATE_MIN_M = 1e-30
"""Smaller numbers than this are bytes in another order."""
CHANNELS_MAX = 16
"""An array (3, N) has more columns than this, an array (N, 3 or more) at most as many."""
CLOUD_NAMES = r"points?|pts|xyz|cloud|point_?cloud|coords?|coordinates"
"""Names of the array of coordinates in a NPZ file."""
OTHER_AXES = {
    "x": ("e|east|easting|points_0", "ost|rechtswert|(?:points_m_xyz|coordinates)_0"),
    "y": ("n|north|northing|points_1", "nord|hochwert|(?:points_m_xyz|coordinates)_1"),
    "z": ("elevation|height|altitude|points_2", "elev|hoehe|höhe|alt|(?:points_m_xyz|coordinates)_2", "u|up|h"),
}
RARE_AXIS = (r"(?:points|coords|coordinates|local)_?{}", r"{}_?(?:local|\d)")
"""Names of columns, the preferred first: other words for an axis than `AXIS`, and rarer forms."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Distinct finite points of a file.

    ``points (N, 3)`` in metres are relative to ``origin (3,)``: add it to results derived from them. The origin is zero
    unless the coordinates are large (UTM), and a multiple of 100 m. ``invalid`` counts the dropped points with a
    coordinate that is NaN, infinite or beyond `COORDINATE_MAX_M`, ``duplicates`` the dropped exact duplicates, and
    ``strays`` the dropped points kilometres from all others (`STRAY_M`), or with a coordinate that stands for none
    (`NO_RETURN`).
    """

    points: Array
    origin: Array
    invalid: int
    duplicates: int
    strays: int = 0

    def __len__(self) -> int:
        return len(self.points)


@checks_arguments
def read_cloud(path: Path | str) -> Cloud:
    """Read the points of a NPY, NPZ, PLY, PCD, LAS, LAZ or text file (XYZ, TXT, CSV, ASC, PTS), chosen by the suffix.

    Raises `InputError` for a missing, truncated or invalid file, fewer than two distinct points, several sites, and a
    cloud that seems to be in millimetres.
    """
    points = read_points(path).reshape(-1, 3)
    finite = points[np.isfinite(points).all(axis=1)]
    distinct = finite[~pd.DataFrame(finite).duplicated().to_numpy()]
    if len(distinct) < 2:
        raise InputError(f"{path}: {len(distinct)} distinct finite points of {len(points)}; expected at least two")
    kept = distinct[~is_stray(path, distinct)]
    extent_m = float(np.ptp(kept, axis=0).max())
    if extent_m > EXTENT_MAX_M:
        spacing_m = spacing(kept)
        if spacing_m > SPACING_MAX_M:
            unit = "millimetres" if extent_m > CENTIMETRES_MAX else "centimetres or millimetres"
            looks = f"a spacing of {spacing_m:.3g} over {extent_m:.4g} looks like {unit}"
            raise InputError(f"{path}: {looks}; expected metres")
    check_geocentric(path, kept)
    check_steps(path, kept)
    check_degrees(path, kept)
    origin = shift_of(kept.mean(axis=0))
    shifted = translated(kept, -origin) if origin.any() else kept
    return Cloud(shifted, origin, len(points) - len(finite), len(finite) - len(distinct), len(distinct) - len(kept))


@checks_arguments
def read_points(path: Path | str) -> Array:
    """Points of one file, float64, metres: ``(N, 3)``, or ``(H, W, 3)`` of an organised cloud (PCD, NPY, NPZ).

    Invalid points, and those beyond `COORDINATE_MAX_M`, are NaN rows. A file in which most points are beyond is
    damaged. Raises `InputError`.
    """
    path = Path(path)
    read = READERS.get(path.suffix.lower())
    if os.path.isdir(path):
        raise InputError(f"{path}: a folder; expected a file of points (`steelnb run` takes a folder of scans)")
    with reading(path, f"a {path.suffix[1:].upper() or 'readable'} file of points"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of NumPy, about files of Python 2
        if path.suffix.lower() != ".npz" and (what := foreign_file(path)):
            raise ValueError(what)
        if read is None:
            raise InputError(f"{path}: ending {path.suffix!r}; expected one of {', '.join(READERS)}")
        points = np.array(read(path), dtype=np.float64)
        if not points.size:
            raise ValueError("no points")
        largest = np.maximum.reduce([np.abs(points[..., axis]) for axis in range(3)])
        largest[largest == np.finfo(np.float32).max] = np.nan  # no return
        tiny = (largest > 0) & (largest < COORDINATE_MIN_M)
        beyond = np.isfinite(largest) & (largest > COORDINATE_MAX_M)
        if len(np.unique(largest[tiny])) > 1:  # a single value stands for no return
            beyond |= tiny
        if beyond.sum() > np.isfinite(largest).sum() / 2:
            bounds = f"{COORDINATE_MIN_M:.0e} to {COORDINATE_MAX_M:.0e} m"
            raise ValueError(f"{beyond.sum()} points that are not within {bounds}, as {points[beyond][0]}")
    points[~(largest <= COORDINATE_MAX_M) | tiny] = np.nan
    return points


def _read_numpy(path: Path) -> Any:
    """The array of a NPY file, or that of points in a NPZ file. The former is mapped, since NumPy then compares its
    size with the file before it allocates."""
    try:
        stored = np.load(path, mmap_mode="r", allow_pickle=False)
        if not isinstance(stored, np.ndarray):
            stored = {name: stored[name] for name in stored.files}
    except Exception:  # NumPy evaluates the header, so that damage raises anything
        raise ValueError("damaged, truncated, or not of numbers; expected an array by numpy.save") from None
    stored = _of_archive(stored) if isinstance(stored, dict) else stored
    is_picture = stored.dtype in ("u1", "i1")
    if is_picture or (not stored.dtype.names and stored.dtype.kind not in "fiu"):
        what = "a picture of " if is_picture else ""
        raise ValueError(f"{what}{stored.dtype}; expected coordinates")
    if stored.dtype.names is not None:
        field = {name.lower(): name for name in stored.dtype.names}
        if not {"x", "y", "z"} <= field.keys():
            raise ValueError(f"fields {', '.join(stored.dtype.names)[:80]}; expected x, y and z")
        if any(stored.dtype[field[axis]].shape for axis in "xyz"):
            raise ValueError(f"x, y and z of type {stored.dtype[field['x']]}; expected a number each")
        return np.stack([stored[field[axis]].astype(np.float64) for axis in "xyz"], axis=-1)
    may_be_axes = stored.ndim in (2, 3) and len(stored) in (3, 4)
    if may_be_axes and stored.shape[-1] > CHANNELS_MAX:
        stored = np.moveaxis(stored, 0, -1)  # one row an axis
    elif may_be_axes and (stored.shape != (4, 3) if stored.ndim == 2 else stored.shape[-1] > 4):
        raise ValueError(f"an array of shape {stored.shape}: its rows may be points or axes; expected (N, 3)")
    if stored.ndim not in (2, 3) or not 3 <= stored.shape[-1] <= CHANNELS_MAX:
        raise ValueError(f"an array of shape {stored.shape}; expected (N, 3) or (H, W, 3)")
    if stored.ndim == 2 and stored.shape[1] > 3:
        check_first_column(stored[:, :6])
    return stored[..., :3]


def _of_archive(members: Mapping[str, Any]) -> Any:
    """The points among the members of a NPZ file: ``x``, ``y`` and ``z``; else the only array, the only one with three
    columns, or of several of these the only one with a name of `CLOUD_NAMES`. Raises ValueError."""
    arrays = {name: each for name, each in members.items() if isinstance(each, np.ndarray)}
    named = {name.lower(): array for name, array in arrays.items()}
    if named.keys() >= {"x", "y", "z"}:
        return np.stack([named[axis].astype(np.float64).ravel() for axis in "xyz"], axis=-1)
    fitting = [name for name, array in arrays.items() if array.ndim > 1 and array.shape[-1] == 3]
    preferred = [name for name in fitting if re.fullmatch(CLOUD_NAMES, name.lower())]
    chosen = list(arrays) if len(arrays) == 1 else fitting if len(fitting) == 1 else preferred
    if len(chosen) != 1:
        held = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise ValueError(f"arrays {held[:200] or 'none'}; expected one of points (N, 3), or its name points or xyz")
    return arrays[chosen[0]]


def _read_text(path: Path) -> Any:
    """x, y and z, or east, north and height, by the names of the columns; without names the first three, or three lines
    of many numbers."""
    table = read_table(path)
    number = [
        table.find(axis, *(form.format(axis) for form in AXIS), *words, *(form.format(axis) for form in RARE_AXIS))
        for axis, words in OTHER_AXES.items()
    ]
    is_unnamed, said = None in number, None
    if is_unnamed:
        if table.has_header or any(each is not None for each in number):
            raise ValueError(f"columns {', '.join(table.names)[:80]}; expected x, y and z")
        if len(table.own) < 3:
            raise ValueError(f"{len(table.own)} numbers in line {table.first}; expected x, y and z")
        if len(table.own) > CHANNELS_MAX:  # one line an axis, as in NPY
            lines = table.values(table.own)
            if len(lines) != 3:
                raise ValueError(f"{len(lines)} lines of {len(table.own)} numbers; expected x, y and z in each line")
            return lines.T
        said = next((k for k in range(len(table.said)) if table.said[k : k + 3] == ("x", "y", "z")), None)
        number = list(table.own[said if said and said + 3 <= len(table.own) else 0 :][:3])
    elif other := {table.units[k] for k in number if k is not None} - {"", "m"}:
        raise ValueError(f"x, y and z in {', '.join(sorted(other))}; expected metres")
    behind = table.own[3:6] if is_unnamed and said is None else ()
    points = table.values([k for k in number if k is not None], more=behind)
    if is_unnamed and len(table.own) > 3:
        check_first_column(points)
    if is_unnamed and table.separator == "," and len(table.own) >= 6 and len(table.own) % 2 == 0:
        _check_commas(table.data.splitlines()[:LINES_LOOKED_AT])
    return points[:, :3]


def _check_commas(lines: list[bytes]) -> None:
    """Raise ValueError if lines may have half as many numbers with decimal commas: all are whole numbers, and every
    second one has as many digits as the others of these."""
    cells = [[cell.strip() for cell in line.split(b",")] for line in lines]
    is_whole = all(re.fullmatch(rb"-?\d+", cell) for line in cells for cell in line)
    decimals = {cell for line in cells for cell in line[1::2]}
    are_even = is_whole and len(cells) > 1 and len({len(cell) for cell in decimals}) == 1
    are_padded = any(len(cell) > 1 and cell.startswith(b"0") for cell in decimals)
    are_colours = (
        len(cells[0]) == 6 and all(0 <= int(cell) < 256 for line in cells for cell in line[3:]) if is_whole else False
    )
    if are_even and (are_padded or not are_colours or (len(cells) == LINES_LOOKED_AT and len(decimals) > 3)):
        raise ValueError("whole numbers between commas, which may be decimal ones; expected decimal points")


READERS: Mapping[str, Callable[[Path], Any]] = {
    ".npy": _read_numpy, ".npz": _read_numpy, ".ply": read_ply, ".pcd": read_pcd, ".las": read_las, ".laz": read_las,
    ".xyz": _read_text, ".txt": _read_text, ".csv": _read_text, ".asc": _read_text, ".pts": _read_text,
}  # fmt: skip
"""Reader of each suffix."""


@checks_arguments
def write_map(path: Path | str, points: Array, bar: IntArray) -> None:
    """Write points ``(N, 3)`` in metres, and the bar ``(N,)`` of each as the property ``bar``, to a binary
    little-endian PLY file. Coordinates are doubles, so that UTM keeps its millimetres."""
    points = checked_array(points, "points", ("N", 3))
    check_length(bar, "bar", len(points), "one per point")
    vertex = np.empty(len(points), [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("bar", "<i4")])
    vertex["x"], vertex["y"], vertex["z"], vertex["bar"] = *points.T, bar
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    header += "property double x\nproperty double y\nproperty double z\nproperty int bar\nend_header\n"
    with new_file(path) as file:
        file.write_bytes(header.encode() + vertex.tobytes())
