"""Reader of point files: NPY, PLY (trimesh), PCD (Open3D), LAS and LAZ (laspy), and text (pandas)."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from steelnb.core.errors import InputError
from steelnb.core.files import reading
from steelnb.core.geometry import shift_of
from steelnb.core.lazy_open3d import import_open3d
from steelnb.core.types import Array
from steelnb.hough.lines import spacing

EXTENT_MAX_M, SPACING_MAX_M = 500.0, 1.0
"""A cloud that exceeds both extent and spacing is probably in millimetres: no scanner is that sparse."""


@dataclass(frozen=True)
class Cloud:
    """Distinct finite points of a file.

    ``points (N, 3)`` in metres are relative to ``origin (3,)``: add it to results derived from them. The origin is zero
    unless the coordinates are large (UTM), and a multiple of 100 m. ``invalid`` counts the dropped points with a NaN or
    infinite coordinate, ``duplicates`` the dropped exact duplicates.
    """

    points: Array
    origin: Array
    invalid: int
    duplicates: int

    def __len__(self) -> int:
        return len(self.points)


def read_cloud(path: Path | str) -> Cloud:
    """Read the points of a NPY, PLY, PCD, LAS, LAZ or text file (XYZ, TXT, CSV), chosen by the suffix.

    Raises `InputError` for a missing, truncated or invalid file, fewer than two distinct points, and a cloud that seems
    to be in millimetres.
    """
    points = read_points(path).reshape(-1, 3)
    finite = points[np.isfinite(points).all(axis=1)]
    distinct = finite[~pd.DataFrame(finite).duplicated().to_numpy()]
    if len(distinct) < 2:
        raise InputError(f"{path}: {len(distinct)} distinct finite points of {len(points)}; expected at least two")
    extent_m = float(np.ptp(distinct, axis=0).max())
    if extent_m > EXTENT_MAX_M:
        spacing_m = spacing(distinct)
        if spacing_m > SPACING_MAX_M:
            raise InputError(
                f"{path}: a spacing of {spacing_m:.3g} over {extent_m:.4g} looks like millimetres; expected metres"
            )
    origin = shift_of(distinct.mean(axis=0))
    # Rounded to 0.1 µm, so that a shifted cloud equals the same cloud at the origin.
    shifted = np.round(distinct - origin, 7) if origin.any() else distinct
    return Cloud(shifted, origin, len(points) - len(finite), len(finite) - len(distinct))


def read_points(path: Path | str) -> Array:
    """Points of one file, float64, metres: ``(N, 3)``, or ``(H, W, 3)`` of an organised cloud (PCD, NPY).

    Invalid points are NaN rows. Raises `InputError`.
    """
    path = Path(path)
    read = READERS.get(path.suffix.lower())
    if read is None:
        raise InputError(f"{path}: ending {path.suffix!r}; expected one of {', '.join(READERS)}")
    with reading(path, f"a {path.suffix[1:].upper()} file of points"):
        points = np.array(read(path), dtype=np.float64)
        if points.ndim not in (2, 3) or points.shape[-1] != 3 or not points.size:
            raise ValueError(f"an array of shape {points.shape}")
    points[~np.isfinite(points).all(axis=-1)] = np.nan
    return points


def _read_ply(path: Path) -> Any:
    import trimesh

    loaded: Any = trimesh.load(path, process=False)
    (count,) = re.findall(rb"^element vertex (\d+)", path.read_bytes(), re.MULTILINE)[:1]
    if len(loaded.vertices) != int(count):
        raise ValueError(f"{len(loaded.vertices)} points, {int(count)} in the header")
    return loaded.vertices


def _read_pcd(path: Path) -> Any:
    """Open3D returns no points for a truncated binary file, and zeros for the missing lines of a text file."""
    o3d = import_open3d()
    header, _, data = path.read_bytes().partition(b"\nDATA ")
    columns, rows, count = (int(n) for n in re.findall(rb"^(?:WIDTH|HEIGHT|POINTS)\s+(\d+)", header, re.MULTILINE))
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.t.io.read_point_cloud(str(path), format="pcd")
    lines = len(data.splitlines()) - 1 if data.startswith(b"ascii") else count
    if "positions" not in cloud.point or not lines == len(cloud.point.positions) == count:
        raise ValueError(f"truncated, or without x, y and z; {count} points in the header")
    return cloud.point.positions.numpy().reshape((rows, columns, 3) if rows > 1 else (-1, 3))


def _read_las(path: Path) -> Any:
    import laspy

    las = laspy.read(path)
    if len(las.points) != las.header.point_count:
        raise ValueError(f"{len(las.points)} points, {las.header.point_count} in the header")
    return las.xyz


def _read_text(path: Path) -> Any:
    """x, y and z in the first three columns, separated by blanks (in a CSV by commas); ``#`` starts a comment."""
    separator = "," if path.suffix.lower() == ".csv" else r"\s+"
    return pd.read_csv(path, sep=separator, header=None, usecols=[0, 1, 2], comment="#", dtype=np.float64).to_numpy()


READERS: Mapping[str, Callable[[Path], Any]] = {
    ".npy": lambda path: np.load(path, allow_pickle=False)[..., :3],
    ".ply": _read_ply, ".pcd": _read_pcd, ".las": _read_las, ".laz": _read_las,
    ".xyz": _read_text, ".txt": _read_text, ".csv": _read_text,
}  # fmt: skip
"""Reader of each suffix."""
