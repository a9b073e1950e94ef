"""Files → point clouds."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from steelnb.datatypes import Array, IntArray
from steelnb.errors import (
    DegenerateCloudError,
    EmptyCloudError,
    FileContentError,
    FileMissingError,
    UnsupportedFormatError,
)
from steelnb.recordings.headers import read_pcd, read_ply
from steelnb.recordings.las import las_step, read_las
from steelnb.recordings.text import read_text

LAS = (".las", ".laz")
READERS = (
    {".ply": read_ply, ".pcd": read_pcd}
    | dict.fromkeys(LAS, read_las)
    | dict.fromkeys((".xyz", ".txt", ".csv", ".pts", ".asc"), read_text)
)
SHIFT_FROM_M = 1e4
"""Clouds whose middle is further out than this are shifted. UTM coordinates are; a site's own are not."""
SHIFT_STEP_M = 100.0
FARTHEST_M = 1e9
"""No map coordinate is larger; a corrupt file's are."""


@dataclass(frozen=True)
class Cloud:
    """Distinct finite points of a file.

    ``points (N, 3)`` metres, less ``origin (3,)``, a whole number of hundreds of metres that is zero unless the
    coordinates are large (UTM): add it to whatever is derived from the points. ``dropped_invalid`` counts the points
    with a NaN or infinite coordinate, ``dropped_duplicates`` the exact repeats. ``resolution_m`` is the step between
    the numbers that the file can hold: 0.25 m where UTM coordinates were stored in single precision.

    A cloud too large for memory comes as the means of its points in voxels of ``thinned_m`` (`recordings.thinning`),
    0 for any other, and ``count (N,)`` is how many points each mean is of.
    """

    points: Array
    origin: Array
    dropped_invalid: int
    dropped_duplicates: int
    resolution_m: float
    count: IntArray | None = None
    thinned_m: float = 0.0

    def __len__(self) -> int:
        return len(self.points)


def read_cloud(path: Path | str) -> Cloud:
    """Read the points of a PLY, PCD, LAS, LAZ or text file (XYZ, TXT, CSV, PTS, ASC); the ending decides, in any case.

    Raises `FileMissingError`, `UnsupportedFormatError`, `FileContentError` (truncated, or not what its ending
    promises), `EmptyCloudError` (no finite point) and `DegenerateCloudError` (one point, maybe repeated).
    """
    path = Path(path)
    if not path.is_file():
        raise FileMissingError(f"{path}: {'a folder' if path.is_dir() else 'does not exist'}; expected a file")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise UnsupportedFormatError(f"{path}: ending {path.suffix!r}; expected one of {', '.join(READERS)}")
    try:
        points = reader(path)
        step_m = las_step(path) if path.suffix.lower() in LAS else 0.0
    except OSError as fault:
        raise FileMissingError(f"{path}: cannot be read: {fault.strerror or fault}") from None
    return _cleaned(points, path, step_m)


def _cleaned(points: Array, path: Path, step_m: float) -> Cloud:
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise EmptyCloudError(f"{path}: {len(points)} points, none finite; expected at least two")
    valid = points[finite]
    largest = float(np.abs(valid).max())
    if largest > FARTHEST_M:
        raise FileContentError(f"{path}: a coordinate of {largest:.3g}; expected metres below {FARTHEST_M:.0e}")
    distinct = valid[~pd.DataFrame(valid).duplicated().to_numpy()]
    if len(distinct) < 2:
        raise DegenerateCloudError(f"{path}: {len(valid)} points, all at {distinct[0]}; expected two distinct points")
    middle = distinct.mean(axis=0)
    far = np.abs(middle).max() > SHIFT_FROM_M
    origin = SHIFT_STEP_M * np.round(middle / SHIFT_STEP_M) if far else np.zeros(3)
    single = bool((distinct == distinct.astype(np.float32)).all())
    resolution = max(step_m, np.spacing(np.float32(largest)) if single else np.spacing(largest))
    # Rounded to 0.1 µm: then a shifted cloud has the very numbers, and so the segments, that it would have at home.
    near = np.round(distinct - origin, 7) if far else distinct
    return Cloud(near, origin, len(points) - len(valid), len(valid) - len(distinct), float(resolution))
