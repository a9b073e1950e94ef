"""An incremental voxel map: hashed voxels with the moments of their points."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from steelnb.errors import InputError
from steelnb.points import voxel_kernels as kernels
from steelnb.types import Array, IntArray


class VoxelGrid(NamedTuple):
    """The hash table of a voxel map: edge (m), keys and slots."""

    voxel_m: float
    key: IntArray
    slot: IntArray


class VoxelMap:
    """Hashed voxels of edge ``voxel_m`` in the world frame: weight, mean and covariance of the points in each.

    With ``accumulate`` the mean is that of all points ever inserted. Without, the map is the report's, re-filtered with
    every scan: the old mean of a voxel then weighs as much as one new point. A voxel keeps its slot for good; inserting
    takes time in proportion to the scan, whatever the size of the map. Raises `InputError`.
    """

    def __init__(self, voxel_m: float, accumulate: bool = True) -> None:
        if not 0 < voxel_m < np.inf:
            raise InputError(f"voxel_m = {voxel_m}: expected a positive length")
        self.voxel_m, self.accumulate = float(voxel_m), accumulate
        self._table_key = np.full(1 << 14, kernels.EMPTY, dtype=np.int64)
        self._table_slot = np.zeros(1 << 14, dtype=np.int64)
        self._key = np.zeros(1 << 12, dtype=np.int64)
        self._moment = np.zeros((1 << 12, 10))  # weight, sum (3), outer (6), all about the voxel's corner
        self._mean = np.zeros((1 << 12, 3))
        self._shape = np.zeros((1 << 12, 6))
        self._outdated = np.zeros(1 << 12, dtype=bool)  # whether a shape is that of earlier moments
        self._seen = np.zeros(1 << 12, dtype=np.int64)
        self._around = np.zeros((1 << 12, 27), dtype=np.int32)  # slots of the 3×3×3 voxels around the first `_linked`
        self._size = self._linked = self._mark = 0

    def __len__(self) -> int:
        return self._size

    def insert(self, points: Array, weight: Array | None = None) -> IntArray:
        """Add points ``(N, 3)`` in metres with weights ``(N,)`` (default 1); returns the slots of the voxels touched.

        Points that are not finite or lie beyond ±REACH voxels, and weights that are not positive, are refused with
        `InputError`; the map then stays as it was.
        """
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        weight = np.ones(len(points)) if weight is None else np.ascontiguousarray(weight, dtype=np.float64)
        farthest = np.abs(points).max(initial=0.0)
        if not farthest < (kernels.REACH - 2) * self.voxel_m:
            raise InputError(f"a point lies {farthest:.3g} m away: beyond the map of {self.voxel_m} m voxels")
        if weight.shape != (len(points),) or not ((weight > 0) & (weight < np.inf)).all():
            raise InputError(f"weight of shape {weight.shape}: expected ({len(points)},) positive numbers")
        self._reserve(len(points))
        self._mark += 1
        touched, self._size = kernels.insert(
            points, weight, self.voxel_m, self._table_key, self._table_slot, self._key, self._moment, self._mean,
            self._seen, self._size, self._mark, self.accumulate,
        )  # fmt: skip
        return touched

    def _reserve(self, more: int) -> None:
        while self._size + more > len(self._key):
            for name in ("_key", "_seen", "_moment", "_mean", "_shape", "_outdated", "_around"):
                array = getattr(self, name)
                setattr(self, name, np.concatenate([array, np.zeros_like(array)]))
        if 2 * (self._size + more) > len(self._table_key):
            size = len(self._table_key)
            while 2 * (self._size + more) > size:
                size *= 2
            self._table_key = np.full(size, kernels.EMPTY, dtype=np.int64)
            self._table_slot = np.zeros(size, dtype=np.int64)
            kernels.rehash(self._key[: self._size], self._table_key, self._table_slot)

    def means(self, chosen: IntArray | None = None) -> Array:
        """Means ``(M, 3)`` in metres of all voxels, or of the slots ``chosen``."""
        return self._mean[: self._size].copy() if chosen is None else self._mean[chosen]

    def weights(self, chosen: IntArray | None = None) -> Array:
        """Total weights ``(M,)`` of all voxels, or of the slots ``chosen``."""
        return self._moment[: self._size, 0].copy() if chosen is None else self._moment[chosen, 0]

    def near(self, centre: Array, radius_m: float) -> IntArray:
        """Slots of the voxels that overlap the cube of half-width ``radius_m`` about ``centre (3,)``, metres."""
        low, high = (np.floor((np.asarray(centre) + side * radius_m) / self.voxel_m) for side in (-1, 1))
        low, high = (np.clip(side, -kernels.REACH, kernels.REACH).astype(np.int64) for side in (low, high))
        return kernels.near(self._key[: self._size], low, high)

    def update_shapes(self, touched: IntArray) -> None:
        """Note that each slot in ``touched`` has new points: the covariances of the 3×3×3 voxels around it and around
        its neighbours are computed anew when they are asked for next."""
        kernels.link(self._linked, self._size, self._key, self._table_key, self._table_slot, self._around)
        self._linked = self._size
        kernels.outdate(np.asarray(touched, dtype=np.int64), self._around, self._outdated)

    def shapes(self, chosen: IntArray | None = None) -> Array:
        """Covariances ``(M, 6)`` in m² of the points in the 3×3×3 voxels around each, as of the last `update_shapes`.

        Upper triangles xx xy xz yy yz zz; of all voxels, or of the slots ``chosen``.
        """
        shapes = VoxelShapes.of(self, np.arange(self._size) if chosen is None else chosen)
        shapes.fill(np.arange(len(shapes.slot)))
        return shapes.value

    def fill_shapes(self, asked: IntArray, slot: IntArray, floor_m2: float, value: Array) -> None:
        """See `VoxelShapes`."""
        kernels.shapes(
            asked, slot, floor_m2, value, self.voxel_m, self._around, self._moment, self._shape, self._outdated
        )

    def grid(self) -> VoxelGrid:
        """The grid, without copies; valid until the next `insert`."""
        return VoxelGrid(self.voxel_m, self._table_key, self._table_slot)


@dataclass(frozen=True)
class VoxelShapes:
    """`VoxelMap.shapes` of some voxels, each computed when a registration first asks for it: a scan meets few of them.

    ``slot (M,)``: the voxels; ``floor_m2`` is added to all three variances; ``value (M, 6)`` is NaN until asked for.
    Valid until the next `VoxelMap.insert`.
    """

    voxels: VoxelMap
    slot: IntArray
    floor_m2: float
    value: Array

    @classmethod
    def of(cls, voxels: VoxelMap, slot: IntArray, floor_m2: float = 0.0) -> "VoxelShapes":
        """Those of the voxels ``slot (M,)``, none computed yet."""
        return cls(voxels, slot, floor_m2, np.full((len(slot), 6), np.nan))

    def fill(self, asked: IntArray) -> None:
        """Compute those at the places ``asked (N,)`` that are missing; −1 asks for none."""
        self.voxels.fill_shapes(asked, self.slot, self.floor_m2, self.value)
