"""Files ↔ point clouds: a whole cloud for `steelnb segment`, and single scans."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from steelnb.errors import DegenerateCloudError, EmptyCloudError, FileContentError
from steelnb.io.point_files import open_points
from steelnb.types import Array, IntArray

SHIFT_FROM_M = 1e4
"""Clouds whose middle is further out than this are shifted. UTM coordinates are; a site's own are not."""
SHIFT_STEP_M = 100.0
FARTHEST_M = 1e9
"""Above the largest map coordinate; the coordinates of a corrupt file are beyond it."""
FITS = 5_000_000
"""Points of the largest cloud that is kept whole: with it, `steelnb segment` needs up to 3 GB."""
VOXELS = 2_000_000
WAITING = 1 << 22
"""Sums of chunks that are added to the voxels at once."""
FINEST_M = 2.0**-10
_BITS = 21
_REACH = 1 << (_BITS - 1)


@dataclass(frozen=True)
class Cloud:
    """Distinct finite points of a file.

    ``points (N, 3)`` metres, less ``origin (3,)``, a whole number of hundreds of metres that is zero unless the
    coordinates are large (UTM): add it to whatever is derived from the points. ``dropped_invalid`` counts the points
    with a NaN or infinite coordinate, ``dropped_duplicates`` the exact repeats. ``resolution_m`` is the step between
    the numbers that the file can hold: 0.25 m where UTM coordinates were stored in single precision.

    A cloud of more than `FITS` points comes as the means of its points in voxels of ``thinned_m``, 0 for any other,
    and ``count (N,)`` is how many points each mean is of. Its duplicates are not looked for.
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
    """Read the points of a PLY, PCD, LAS, LAZ, NPY or text file (XYZ, TXT, CSV, PTS, ASC); the ending decides.

    Raises `FileMissingError`, `UnsupportedFormatError`, `FileContentError` (truncated, or not what its ending
    promises), `EmptyCloudError` (no finite point), `DegenerateCloudError` (one point, maybe repeated) and
    `MissingExtraError` (a compressed PCD without Open3D).
    """
    import pandas as pd

    path = Path(path)
    file = open_points(path)
    total, valid, largest, single = 0, 0, 0.0, True
    kept: list[Array] = []
    voxels: _Voxels | None = None
    origin = np.zeros(3)
    for points in file.chunks:
        finite = points[np.isfinite(points).all(axis=1)]
        total, valid = total + len(points), valid + len(finite)
        largest = max(largest, float(np.abs(finite).max(initial=0.0)))
        if largest > FARTHEST_M:
            raise FileContentError(f"{path}: a coordinate of {largest:.3g}; expected metres below {FARTHEST_M:.0e}")
        single &= bool((finite == finite.astype(np.float32)).all())
        kept += [finite] if len(finite) else []
        if valid > FITS:
            if voxels is None:
                voxels, origin = _Voxels(), shift_of(kept[0].mean(axis=0))
            for each in kept:
                voxels.add(each - origin)
            kept = []
    if not valid:
        raise EmptyCloudError(f"{path}: {total} points, none finite; expected at least two")
    resolution_m = max(file.step_m, float(np.spacing(np.float32(largest)) if single else np.spacing(largest)))
    if voxels is not None:
        near, count = voxels.means()
        cloud = Cloud(near, origin, total - valid, 0, resolution_m, count, voxels.edge_m)
    else:
        whole = np.concatenate(kept)
        distinct = whole[~pd.DataFrame(whole).duplicated().to_numpy()]
        origin = shift_of(distinct.mean(axis=0))
        # Rounded to 0.1 µm, so that a shifted cloud has the numbers, and the segments, of the same cloud at home.
        near = np.round(distinct - origin, 7) if origin.any() else distinct
        cloud = Cloud(near, origin, total - valid, valid - len(distinct), resolution_m)
    if len(cloud) < 2:
        raise DegenerateCloudError(
            f"{path}: {valid} points, all at {cloud.points[0] + origin}; expected two distinct points"
        )
    return cloud


def read_points(path: Path | str) -> Array:
    """Points of one scan, float64 metres: ``(N, 3)`` or, of an organised cloud (PCD, NPY), ``(H, W, 3)``.

    Invalid points are NaN rows. Raises as `read_cloud`, but knows no `DegenerateCloudError`.
    """
    file = open_points(Path(path))
    chunks = list(file.chunks)
    if not chunks:
        raise EmptyCloudError(f"{path}: no points; expected at least one")
    points = np.concatenate(chunks)
    points[~np.isfinite(points).all(axis=1)] = np.nan
    return points.reshape(*file.shape, 3)


def write_ply(path: Path | str, points: Array, kind: str = "<f4") -> None:
    """Write the finite points of ``(N, 3)`` or ``(H, W, 3)``, metres, as binary PLY, ``kind`` "<f4" or "<f8"."""
    from plyfile import PlyData, PlyElement

    points = points.reshape(-1, 3)
    points = np.ascontiguousarray(points[np.isfinite(points).all(axis=1)], dtype=kind)
    records = points.view([(axis, kind) for axis in "xyz"]).reshape(-1)
    PlyData([PlyElement.describe(records, "vertex")], byte_order="<").write(str(path))


def shift_of(middle: Array) -> Array:
    """Origin ``(3,)`` for coordinates around ``middle (3,)``, metres: zero unless they are large."""
    far = np.abs(middle).max() > SHIFT_FROM_M
    return SHIFT_STEP_M * np.round(middle / SHIFT_STEP_M) if far else np.zeros(3)


class _Voxels:
    """Sums of points in voxels of ``edge_m``, as fine as keeps them below `VOXELS`.

    The edge starts at 1 mm and doubles whenever there are too many voxels, so coarser voxels are made of finer ones.
    """

    def __init__(self) -> None:
        self.edge_m = FINEST_M
        self._sums = np.zeros((0, 4))  # number, x, y, z
        self._waiting: list[Array] = []

    def add(self, points: Array) -> None:
        while np.abs(points).max() >= (_REACH - 1) * self.edge_m:  # so that the voxels can be numbered
            self._merge(coarser=True)
        self._waiting.append(_summed(np.column_stack([np.ones(len(points)), points]), self.edge_m))
        if sum(map(len, self._waiting)) > WAITING:
            self._merge()

    def means(self) -> tuple[Array, IntArray]:
        """Means ``(M, 3)`` and numbers of points ``(M,)``."""
        self._merge()
        return self._sums[:, 1:] / self._sums[:, :1], self._sums[:, 0].astype(np.int64)

    def _merge(self, coarser: bool = False) -> None:
        self._sums = _summed(np.concatenate([self._sums, *self._waiting]), self.edge_m)
        self._waiting = []
        while coarser or len(self._sums) > VOXELS:
            self.edge_m *= 2
            self._sums, coarser = _summed(self._sums, self.edge_m), False


def _summed(sums: Array, edge_m: float) -> Array:
    """Rows (number, x, y, z) added up by the voxels of their means, in the order of these."""
    cell = np.floor(sums[:, 1:] / (sums[:, :1] * edge_m)).astype(np.int64) + _REACH
    name = (((cell[:, 0] << _BITS) | cell[:, 1]) << _BITS) | cell[:, 2]
    del cell
    order = np.argsort(name, kind="stable")
    first = np.flatnonzero(np.diff(name[order], prepend=-1))
    return np.add.reduceat(sums[order], first, axis=0) if len(first) else sums
