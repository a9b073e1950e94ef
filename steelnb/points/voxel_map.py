"""An incremental voxel map: a hash table of voxels with the moments of their points."""

from typing import NamedTuple

import numpy as np

from steelnb.core.arguments import checks_arguments
from steelnb.core.checks import checked_array, checked_cloud, checked_kind, checked_number
from steelnb.core.errors import InputError
from steelnb.core.types import Array, IntArray
from steelnb.points import voxel_kernels as kernels
from steelnb.points.kdtree import KdTree, build_kdtree


class SearchState(NamedTuple):
    """What `VoxelMap.correspond` knows of N source points: the slot nearest to each, the distance to all others, and
    the place it was searched from."""

    nearest: IntArray
    others_min: Array
    searched_from: Array

    @classmethod
    def of(cls, count: int) -> "SearchState":
        """Nothing is known of ``count`` points yet."""
        return cls(np.full(count, -1), np.full(count, -1.0), np.zeros((count, 3)))


class VoxelMap:
    """Voxels of edge ``voxel_m``, metres, in the world frame, with the weight, mean and covariance of their points.

    With ``accumulate``, the mean is that of all inserted points. Otherwise, the map is voxelised again with every scan
    as in the report: the old mean of a voxel counts as one point. The slot of a voxel never changes. The time of an
    insertion depends on the size of the scan, not of the map. Raises `InputError`.
    """

    @checks_arguments
    def __init__(self, voxel_m: float, accumulate: bool = True) -> None:
        self.voxel_m, self.accumulate = checked_number(voxel_m, "voxel_m", above=0), accumulate
        self._key = np.zeros(1 << 12, dtype=np.int64)
        self._table: tuple[IntArray, IntArray] = kernels.hash_table(self._key[:0], 1 << 13)
        self._moment = np.zeros((1 << 12, 10))  # see `points.moments`; the origin is the voxel's corner
        self._mean = np.zeros((1 << 12, 3))
        self._last_mark = np.zeros(1 << 12, dtype=np.int64)
        self._around = np.zeros((1 << 12, 27), dtype=np.int32)  # valid for the first `_linked` voxels
        self._shape = np.zeros((1 << 12, 6))
        self._shape_mark = np.zeros(1 << 12, dtype=np.int64)  # number of insertions for which the shape is valid
        self._size = self._linked = self._mark = 0
        self.tree: KdTree | None = None
        """Of the means, if `index` was called since the last insertion."""

    def __len__(self) -> int:
        return self._size

    def __repr__(self) -> str:
        return f"VoxelMap({self._size} voxels of {self.voxel_m:g} m)"

    @checks_arguments
    def insert(self, points: Array, weight: Array | None = None) -> None:
        """Add points ``(N, 3)`` in metres with weights ``(N,)``, default 1.

        Raises `InputError` and leaves the map unchanged for arrays of other shapes, if a point is not finite or farther
        than `voxel_kernels.REACH` voxels away, and if a weight is not positive and finite.
        """
        points = np.ascontiguousarray(checked_cloud(points)).reshape(-1, 3)
        weight = np.ones(len(points)) if weight is None else np.ascontiguousarray(weight, dtype=np.float64)
        farthest = np.abs(points).max(initial=0.0)
        if not farthest < (kernels.REACH - 2) * self.voxel_m:
            raise InputError(
                f"points: a coordinate of {farthest:.3g} m; expected finite ones below"
                f" {(kernels.REACH - 2) * self.voxel_m:.3g} m for voxels of {self.voxel_m} m; move them towards zero"
            )
        if weight.shape != (len(points),) or not ((weight > 0) & (weight < np.inf)).all():
            raise InputError(f"weight of shape {weight.shape}: expected ({len(points)},) positive numbers")
        needed = self._size + len(points)
        if needed > len(self._key):
            for name in ("_key", "_last_mark", "_moment", "_mean", "_around", "_shape", "_shape_mark"):
                array = getattr(self, name)
                larger = np.zeros((1 << (needed - 1).bit_length(), *array.shape[1:]), array.dtype)
                larger[: self._size] = array[: self._size]
                setattr(self, name, larger)
        if 2 * needed > len(self._table[0]):
            self._table = kernels.hash_table(self.keys(), needed)
        self.tree = None
        self._mark += 1
        self._size = kernels.insert(
            points, weight, self.voxel_m, *self._table, self._key, self._moment, self._mean, self._last_mark,
            self._size, self._mark, self.accumulate,
        )  # fmt: skip

    def keys(self) -> IntArray:
        """Keys ``(M,)`` of all voxels (`voxel_kernels.pack`)."""
        return self._key[: self._size]

    def means(self, slots: IntArray | None = None, copy: bool = True) -> Array:
        """Means ``(M, 3)`` in metres of all voxels, or of the voxels ``slots``; without ``copy`` for use until the next
        insertion."""
        if slots is not None:
            return self._mean[self._checked(slots, 0)]
        return self._mean[: self._size].copy() if copy else self._mean[: self._size]

    def weights(self) -> Array:
        """Total weights ``(M,)`` of all voxels."""
        return self._moment[: self._size, 0].copy()

    def near(self, centre: Array, radius_m: float) -> IntArray:
        """Slots of the voxels that overlap the cube of half-width ``radius_m`` about ``centre (3,)``, metres. Raises
        `InputError`."""
        centre = checked_array(centre, "centre", (3,))
        radius_m = checked_number(radius_m, "radius_m", 0, infinite=True)
        low, high = (np.floor((centre + side * radius_m) / self.voxel_m) for side in (-1, 1))
        low, high = (np.clip(side, -kernels.REACH, kernels.REACH).astype(np.int64) for side in (low, high))
        return kernels.near(self.keys(), low, high)

    def shapes(self, slots: IntArray, floor_m2: float = 0.0) -> Array:
        """Covariances ``(M, 6)`` of the points in the 3×3×3 voxels around each voxel, m²: upper triangles xx xy xz yy
        yz zz, with ``floor_m2``, the same in every call, added to the variances.

        Rows ``slots (N,)`` are computed, −1 is ignored; others are undefined. Valid until the next insertion.
        """
        slots = self._checked(slots, -1)
        self.link()
        kernels.shapes(
            slots, floor_m2, self._shape, self._shape_mark, self._mark, self.voxel_m, self._around, self._moment
        )
        return self._shape[: self._size]

    def correspond(self, source: Array, T: Array, limit_m: float, match: IntArray, state: SearchState) -> int:
        """Write the slot of the mean nearest to each point ``source (N, 3)`` moved by ``T (4, 4)`` to ``match (N,)``.

        It is −1 if none is within ``limit_m``. ``state`` of the last call for the same source saves searches, whose
        number is returned.
        """
        checked_kind(state, "state", tuple, "SearchState.of(len(source))")
        n = len(source)
        shapes = [np.shape(each) for each in (source, T, match, *state)]
        if shapes != [(n, 3), (4, 4), (n,), (n,), (n,), (n, 3)]:
            wanted = f"expected ({n}, 3) and (4, 4), and match and state of {n} points"
            raise InputError(f"source and T of shapes {shapes[0]} and {shapes[1]}: {wanted}")
        if not limit_m >= 0 or state.nearest.max(initial=-1) >= self._size:
            raise InputError(f"limit_m = {limit_m}: expected 0 or more, and the state of a search in this map")
        self.link()
        return int(
            kernels.correspond(source, T, limit_m, self.voxel_m, *self._table, self._around, self._mean, match, *state)
        )

    def index(self) -> None:
        """Build the k-d tree of the means, for a map that stays as it is while many clouds are registered to it: pairs
        within five voxels are then found in a quarter of the time."""
        self.link()
        self.tree = build_kdtree(self.means()) if len(self) else None

    def _checked(self, slots: IntArray, low: int) -> IntArray:
        """Slots of this map. Raises `InputError`: compiled code would read beyond its arrays."""
        slots = np.asarray(slots) if np.size(slots) else np.zeros(np.shape(slots), dtype=np.int64)
        expected = f"whole numbers from {low} to {self._size - 1}"
        if slots.dtype.kind not in "iu" or (low < 0 and slots.ndim != 1):
            raise InputError(f"slots: {slots.dtype} of shape {slots.shape}; expected {expected} in an array (N,)")
        if slots.size and not low <= slots.min() <= slots.max() < self._size:
            raise InputError(f"slots: {slots[(slots < low) | (slots >= self._size)][0]}; expected {expected}")
        return slots

    def link(self) -> None:
        """Find the voxels around each new voxel. `shapes` and `correspond` do so when they are called first, and after
        an insertion; copies of a linked map are linked."""
        kernels.link(self._linked, self._size, self._key, *self._table, self._around)
        self._linked = self._size
