"""Clouds too large for memory: read a chunk at a time into voxels, whose means are the cloud that is worked on."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from steelnb.datatypes import Array, IntArray
from steelnb.errors import DegenerateCloudError, EmptyCloudError, FileContentError, FileMissingError, SteelnbError
from steelnb.recordings.clouds import FARTHEST_M, LAS, SHIFT_FROM_M, SHIFT_STEP_M, Cloud
from steelnb.recordings.headers import binary_chunks, point_count
from steelnb.recordings.las import las_chunks, las_count, las_step

FITS = 5_000_000
"""Points of the largest cloud that is read whole: with it, `steelnb segment` needs up to 3 GB."""
VOXELS = 2_000_000
CHUNK = 1 << 20
WAITING = 1 << 22
"""Sums of chunks that are added to the voxels at once."""
FINEST_M = 2.0**-10
_BITS = 21
_REACH = 1 << (_BITS - 1)


def is_large(path: Path) -> bool:
    """Whether a file says of itself that it holds more than `FITS` points, and can be read in chunks.

    LAS, LAZ, and binary PLY and PCD can; text and compressed PCD cannot. What cannot be read is not large.
    """
    try:
        if path.suffix.lower() in LAS:
            return las_count(path) > FITS
        return (
            path.suffix.lower() in (".ply", ".pcd") and point_count(path) > FITS and binary_chunks(path, 1) is not None
        )
    except (SteelnbError, OSError):
        return False


def read_thinned(path: Path) -> Cloud:
    """The means of the points in voxels, as fine as keeps the voxels below `VOXELS`, and how many points each holds.

    The voxels' edge starts at 1 mm and doubles whenever there are too many. Repeated points are not looked for. Raises
    as `steelnb.recordings.read_cloud`.
    """
    voxels, origin = _Voxels(), np.zeros(3)
    total, invalid, largest, single = 0, 0, 0.0, True
    try:
        for points in _chunks(path):
            valid = points[np.isfinite(points).all(axis=1)]
            invalid += len(points) - len(valid)
            if not len(valid):
                continue
            largest = max(largest, float(np.abs(valid).max()))
            if largest > FARTHEST_M:
                raise FileContentError(f"{path}: a coordinate of {largest:.3g}; expected metres below {FARTHEST_M:.0e}")
            if not total and np.abs(middle := valid.mean(axis=0)).max() > SHIFT_FROM_M:
                origin = SHIFT_STEP_M * np.round(middle / SHIFT_STEP_M)
            single &= bool((valid == valid.astype(np.float32)).all())
            voxels.add(valid - origin)
            total += len(valid)
        step_m = las_step(path) if path.suffix.lower() in LAS else 0.0
    except OSError as fault:
        raise FileMissingError(f"{path}: cannot be read: {fault.strerror or fault}") from None
    if not total:
        raise EmptyCloudError(f"{path}: {invalid} points, none finite; expected at least two")
    means, count = voxels.means()
    if len(means) < 2:
        raise DegenerateCloudError(f"{path}: {total} points, all at {means[0] + origin}; expected two distinct points")
    resolution_m = max(step_m, float(np.spacing(np.float32(largest)) if single else np.spacing(largest)))
    return Cloud(means, origin, invalid, 0, resolution_m, count, voxels.edge_m)


def _chunks(path: Path) -> Iterator[Array]:
    if path.suffix.lower() in LAS:
        return las_chunks(path, CHUNK)
    return binary_chunks(path, CHUNK) or iter(())


class _Voxels:
    """Sums of the points in voxels of ``edge_m``, which is a power of two, so that coarser voxels are made of finer."""

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
