"""Files of points → arrays: NPY, PLY (trimesh), PCD (Open3D), LAS and LAZ (laspy), and text (pandas)."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import KDTree

from steelnb.errors import InputError
from steelnb.files import reading
from steelnb.libraries import import_open3d
from steelnb.types import Array

SHIFT_FROM_M, SHIFT_STEP_M = 1e4, 100.0
"""Clouds whose middle is further out than the first are shifted. UTM coordinates are; a site's own are not."""
EXTENT_MAX_M, SPACING_MAX_M = 500.0, 1.0
"""What extends further, of points further apart, is in millimetres: no scanner sees so little of so much."""


@dataclass(frozen=True)
class Cloud:
    """Distinct finite points of a file.

    ``points (N, 3)`` metres, less ``origin (3,)``, a whole number of hundreds of metres that is zero unless the
    coordinates are large (UTM): add it to whatever is derived from the points. ``invalid`` counts the points with a NaN
    or infinite coordinate, ``duplicates`` the exact repeats, both left out.
    """

    points: Array
    origin: Array
    invalid: int
    duplicates: int

    def __len__(self) -> int:
        return len(self.points)


def read_cloud(path: Path | str) -> Cloud:
    """Read the points of a NPY, PLY, PCD, LAS, LAZ or text file (XYZ, TXT, CSV); the ending decides.

    Raises `InputError`: a missing or truncated file, or not what its ending promises; fewer than two distinct points;
    or a cloud that looks like millimetres.
    """
    points = read_points(path).reshape(-1, 3)
    finite = points[np.isfinite(points).all(axis=1)]
    distinct = finite[~pd.DataFrame(finite).duplicated().to_numpy()]
    if len(distinct) < 2:
        raise InputError(f"{path}: {len(distinct)} distinct finite points of {len(points)}; expected at least two")
    extent_m = float(np.ptp(distinct, axis=0).max())
    if extent_m > EXTENT_MAX_M:
        spacing_m = float(np.median(KDTree(distinct).query(distinct[:: 1 + len(distinct) // 1000], k=2)[0][:, 1]))
        if spacing_m > SPACING_MAX_M:
            raise InputError(
                f"{path}: points {spacing_m:.3g} apart over {extent_m:.4g}: it looks like millimetres; expected metres"
            )
    origin = shift_of(distinct.mean(axis=0))
    # Rounded to 0.1 µm, so that a shifted cloud has the numbers, and the segments, of the same cloud at home.
    near = np.round(distinct - origin, 7) if origin.any() else distinct
    return Cloud(near, origin, len(points) - len(finite), len(finite) - len(distinct))


def read_points(path: Path | str) -> Array:
    """Points of one scan, float64 metres: ``(N, 3)`` or, of an organised cloud (PCD, NPY), ``(H, W, 3)``.

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


def shift_of(middle: Array) -> Array:
    """Origin ``(3,)`` for coordinates around ``middle (3,)``, metres: zero unless they are large."""
    far = np.abs(middle).max() > SHIFT_FROM_M
    return SHIFT_STEP_M * np.round(middle / SHIFT_STEP_M) if far else np.zeros(3)


def _read_ply(path: Path) -> Any:
    import trimesh

    loaded: Any = trimesh.load(path, process=False)
    (count,) = re.findall(rb"^element vertex (\d+)", path.read_bytes(), re.MULTILINE)[:1]
    if len(loaded.vertices) != int(count):
        raise ValueError(f"{len(loaded.vertices)} points; its header promises {int(count)}")
    return loaded.vertices


def _read_pcd(path: Path) -> Any:
    """Open3D gives no points for half a binary file, and zeros for the missing lines of a text."""
    o3d = import_open3d()
    head, _, data = path.read_bytes().partition(b"\nDATA ")
    columns, rows, count = (int(n) for n in re.findall(rb"^(?:WIDTH|HEIGHT|POINTS)\s+(\d+)", head, re.MULTILINE))
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.t.io.read_point_cloud(str(path), format="pcd")
    lines = len(data.splitlines()) - 1 if data.startswith(b"ascii") else count
    if "positions" not in cloud.point or not lines == len(cloud.point.positions) == count:
        raise ValueError(f"cut short, or without x, y and z; its header promises {count} points")
    return cloud.point.positions.numpy().reshape((rows, columns, 3) if rows > 1 else (-1, 3))


def _read_las(path: Path) -> Any:
    import laspy

    las = laspy.read(path)
    if len(las.points) != las.header.point_count:
        raise ValueError(f"{len(las.points)} points; its header promises {las.header.point_count}")
    return las.xyz


def _read_text(path: Path) -> Any:
    """x, y and z in the first three columns, with blanks or, in a CSV, commas between; ``#`` begins a comment."""
    separator = "," if path.suffix.lower() == ".csv" else r"\s+"
    return pd.read_csv(path, sep=separator, header=None, usecols=[0, 1, 2], comment="#", dtype=np.float64).to_numpy()


READERS: Mapping[str, Callable[[Path], Any]] = {
    ".npy": lambda path: np.load(path, allow_pickle=False)[..., :3],
    ".ply": _read_ply, ".pcd": _read_pcd, ".las": _read_las, ".laz": _read_las,
    ".xyz": _read_text, ".txt": _read_text, ".csv": _read_text,
}  # fmt: skip
"""By the ending of a file."""
