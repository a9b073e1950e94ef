"""An incremental voxel map: a hash table of voxels with open addressing, and the moments of their points."""

from typing import NamedTuple

import numpy as np

from steelnb.core.checks import checked_array, checked_cloud, checked_number
from steelnb.core.errors import InputError
from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray
from steelnb.points.kdtree import KdTree, build_kdtree
from steelnb.points.moments import NO_MOMENTS, add_moments, add_point, covariance, store

EMPTY = -1
BITS = 20
REACH = 1 << BITS
"""Voxel indices range from −REACH to REACH along each axis: ±100 km with voxels of 10 cm."""


@njit(cache=True)
def bucket_of(key, mask):
    """First bucket to probe for a key in a hash table with ``mask`` + 1 buckets."""
    # A bit of a product depends only on the lower bits of its factors, and a key has the index along x in its highest
    # bits. Without the second product, voxels in a row along x would share a bucket.
    h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> np.uint64(32))) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64((h >> np.uint64(32)) & np.uint64(mask))


@njit(cache=True)
def pack(i, j, k):
    """Key of the voxel with indices (i, j, k)."""
    return ((i + REACH) << (2 * BITS + 2)) | ((j + REACH) << (BITS + 1)) | (k + REACH)


@njit(cache=True)
def unpack(key):
    """Indices (i, j, k) of the voxel with a key."""
    mask = (np.int64(1) << (BITS + 1)) - 1
    return (key >> (2 * BITS + 2)) - REACH, ((key >> (BITS + 1)) & mask) - REACH, (key & mask) - REACH


def offsets_within(radius_m: float, voxel_m: float) -> IntArray:
    """Offsets ``(K,)`` of the keys (`pack`) of the voxels whose centres lie within a radius, nearest first."""
    reach = int(radius_m / voxel_m)
    steps = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = np.linalg.norm(steps, axis=1)
    order = np.argsort(distance, kind="stable")
    steps = steps[order][distance[order] * voxel_m <= radius_m + 1e-9]
    return np.asarray(pack(*steps.T) - pack(0, 0, 0))


@njit(cache=True)
def find(key, table_key, table_slot):
    """Slot of a voxel, or −1 if the table does not hold it."""
    mask = len(table_key) - 1
    bucket = bucket_of(key, mask)
    while table_key[bucket] != EMPTY:
        if table_key[bucket] == key:
            return table_slot[bucket]
        bucket = (bucket + 1) & mask
    return np.int64(-1)


@njit(cache=True)
def put(key, slot, table_key, table_slot):
    """Add a voxel that the table does not hold yet."""
    mask = len(table_key) - 1
    bucket = bucket_of(key, mask)
    while table_key[bucket] != EMPTY:
        bucket = (bucket + 1) & mask
    table_key[bucket], table_slot[bucket] = key, slot


@njit(cache=True)
def hash_table(keys, capacity):
    """Hash table (key, slot) with room for ``capacity`` voxels. It holds ``keys``; the slot of each is its index."""
    size = 16
    while size < 2 * capacity:
        size *= 2
    table_key, table_slot = np.full(size, EMPTY, np.int64), np.zeros(size, np.int64)
    for slot in range(len(keys)):
        put(keys[slot], slot, table_key, table_slot)
    return table_key, table_slot


@njit(cache=True)
def _insert(points, weights, voxel, table_key, table_slot, keys, moment, mean, last_mark, size, mark, accumulate):
    """Add points to the voxels; returns the number of all voxels.

    ``mark`` is the number of this insertion, ``last_mark`` that of the last insertion that touched each voxel.
    """
    touched = np.empty(len(points), np.int64)
    count = 0
    inverse = 1.0 / voxel
    for n in range(len(points)):
        i, j, k = (
            np.int64(np.floor(points[n, 0] * inverse)), np.int64(np.floor(points[n, 1] * inverse)),
            np.int64(np.floor(points[n, 2] * inverse)),
        )  # fmt: skip
        key = pack(i, j, k)
        slot = find(key, table_key, table_slot)
        if slot < 0:
            slot = size
            size += 1
            keys[slot] = key
            moment[slot, :] = 0.0
            last_mark[slot] = 0
            put(key, slot, table_key, table_slot)
        m = moment[slot]
        if last_mark[slot] != mark:
            last_mark[slot] = mark
            touched[count] = slot
            count += 1
            if not accumulate and m[0] > 0.0:  # the old mean counts as one point
                store(add_point(NO_MOMENTS, 1.0, m[1] / m[0], m[2] / m[0], m[3] / m[0]), m)
        x, y, z = points[n, 0] - i * voxel, points[n, 1] - j * voxel, points[n, 2] - k * voxel
        store(add_point(m, weights[n], x, y, z), m)
    for n in range(count):
        slot = touched[n]
        i, j, k = unpack(keys[slot])
        m = moment[slot]
        mean[slot, 0], mean[slot, 1] = i * voxel + m[1] / m[0], j * voxel + m[2] / m[0]
        mean[slot, 2] = k * voxel + m[3] / m[0]
    return size


@njit(cache=True)
def _near(keys, low, high):
    """Slots of the voxels with indices from ``low (3,)`` to ``high (3,)``, by a branch-free scan of all voxels."""
    i0, i1, j0, j1, k0, k1 = low[0], high[0], low[1], high[1], low[2], high[2]
    found = np.empty(len(keys) + 1, np.int64)
    count = np.uint64(0)
    for slot in range(len(keys)):
        i, j, k = unpack(keys[slot])
        found[count] = slot
        count += np.uint64((i >= i0) & (i <= i1) & (j >= j0) & (j <= j1) & (k >= k0) & (k <= k1))
    return found[: np.int64(count)]


@njit(cache=True)
def _link(first, last, keys, table_key, table_slot, around):
    """Write the slots of the 3×3×3 voxels around each new voxel to ``around (V, 27)``, −1 where there is none."""
    for slot in range(first, last):
        i, j, k = unpack(keys[slot])
        neighbour = 0
        for a in range(-1, 2):
            for b in range(-1, 2):
                for c in range(-1, 2):
                    other = find(pack(i + a, j + b, k + c), table_key, table_slot)
                    around[slot, neighbour] = other
                    if other >= 0:
                        around[other, 26 - neighbour] = slot
                    neighbour += 1


@njit(cache=True)
def _shapes(slots, floor, value, value_mark, mark, voxel, around, moment):
    """Write the covariances of all points in the 3×3×3 voxels around the voxels ``slots`` to ``value[slots]``.

    ``floor`` is added to their diagonals. Negative entries are skipped, and voxels whose ``value_mark`` is ``mark``.
    """
    for at in slots:
        if at < 0 or value_mark[at] == mark:
            continue
        value_mark[at] = mark
        m = NO_MOMENTS
        for neighbour in range(27):
            other = around[at, neighbour]
            if other >= 0:
                i, j, k = neighbour // 9 - 1, neighbour // 3 % 3 - 1, neighbour % 3 - 1
                m = add_moments(m, moment[other], i * voxel, j * voxel, k * voxel)
        value[at, :] = covariance(m)
        value[at, 0] += floor
        value[at, 3] += floor
        value[at, 5] += floor


@njit(cache=True)
def _nearer(other, x, y, z, mean, slot, best, second):
    """The nearest slot and the two smallest squared distances, with those of another slot."""
    px, py, pz = mean[other, 0] - x, mean[other, 1] - y, mean[other, 2] - z
    d = px * px + py * py + pz * pz
    return (other, d, best) if d < best else (slot, best, min(d, second))


@njit(cache=True)
def _nearest(x, y, z, limit, voxel, table_key, table_slot, around, mean):
    """Slot of the mean nearest to (x, y, z) and its squared distance, and a distance within which there is no other.

    The slot is −1 if no mean is within ``limit``. The search visits one cubic shell of voxels after the other, until
    what they cover is farther than the nearest mean or the limit. `_link` knows the first shells of a voxel.
    """
    inverse = 1.0 / voxel
    i, j, k = np.int64(np.floor(x * inverse)), np.int64(np.floor(y * inverse)), np.int64(np.floor(z * inverse))
    fx, fy, fz = x - i * voxel, y - j * voxel, z - k * voxel
    edge = min(fx, voxel - fx, fy, voxel - fy, fz, voxel - fz)
    slot, best, second, covered = np.int64(-1), np.inf, np.inf, edge
    own = find(pack(i, j, k), table_key, table_slot)
    begin = 1
    if own >= 0:
        begin, covered = 2, voxel + edge
        for neighbour in range(27):
            other = around[own, neighbour]
            if other >= 0:
                slot, best, second = _nearer(np.int64(other), x, y, z, mean, slot, best, second)
    for shell in range(begin, np.int64(limit * inverse) + 2):
        if best <= covered * covered or covered > limit:
            break
        covered = shell * voxel + edge
        for a in range(-shell, shell + 1):
            for b in range(-shell, shell + 1):
                inside = abs(a) < shell and abs(b) < shell
                for c in range(-shell, shell + 1, 2 * shell if inside else 1):
                    other = find(pack(i + a, j + b, k + c), table_key, table_slot)
                    if other >= 0:
                        slot, best, second = _nearer(other, x, y, z, mean, slot, best, second)
    if best > limit * limit:
        return np.int64(-1), best, min(np.sqrt(best), covered)
    return slot, best, min(np.sqrt(second), covered)


@njit(cache=True)
def _correspond(
    source, T, limit, voxel, table_key, table_slot, around, mean, match, nearest_of, others_min, searched_from
):  # fmt: skip
    """Write the slot of the mean nearest to each point under T to ``match (N,)``: −1 if none is within ``limit``.

    Returns the number of searches. As in `registration.target.correspond_points`, a point is searched for only if its
    nearest mean may have changed: all but ``nearest_of (N,)`` were at least ``others_min (N,)`` away from
    ``searched_from (N, 3)``. A negative ``others_min`` forces a search.
    """
    searches = 0
    for n in range(len(source)):
        x, y, z = source[n, 0], source[n, 1], source[n, 2]
        qx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        qy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        qz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if others_min[n] >= 0.0:
            mx, my, mz = qx - searched_from[n, 0], qy - searched_from[n, 1], qz - searched_from[n, 2]
            free = others_min[n] - np.sqrt(mx * mx + my * my + mz * mz)
            known, d = nearest_of[n], np.inf
            if known >= 0:
                px, py, pz = mean[known, 0] - qx, mean[known, 1] - qy, mean[known, 2] - qz
                d = px * px + py * py + pz * pz
            if free > 0.0 and (d < free * free or free > limit):
                match[n] = known if d <= limit * limit else -1
                continue
        # Slightly beyond the limit, so that points without a pair are not searched for every time.
        slot, d, others_min[n] = _nearest(qx, qy, qz, 1.05 * limit, voxel, table_key, table_slot, around, mean)
        nearest_of[n], match[n] = slot, slot if d <= limit * limit else -1
        searched_from[n, 0], searched_from[n, 1], searched_from[n, 2] = qx, qy, qz
        searches += 1
    return searches


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

    def __init__(self, voxel_m: float, accumulate: bool = True) -> None:
        self.voxel_m, self.accumulate = checked_number(voxel_m, "voxel_m", above=0), accumulate
        self._key = np.zeros(1 << 12, dtype=np.int64)
        self._table: tuple[IntArray, IntArray] = hash_table(self._key[:0], 1 << 13)
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

    def insert(self, points: Array, weight: Array | None = None) -> None:
        """Add points ``(N, 3)`` in metres with weights ``(N,)``, default 1.

        Raises `InputError` and leaves the map unchanged for arrays of other shapes, if a point is not finite or farther
        than `REACH` voxels away, and if a weight is not positive and finite.
        """
        points = np.ascontiguousarray(checked_cloud(points)).reshape(-1, 3)
        weight = np.ones(len(points)) if weight is None else np.ascontiguousarray(weight, dtype=np.float64)
        farthest = np.abs(points).max(initial=0.0)
        if not farthest < (REACH - 2) * self.voxel_m:
            raise InputError(
                f"points: a coordinate of {farthest:.3g} m; expected finite ones below"
                f" {(REACH - 2) * self.voxel_m:.3g} m for voxels of {self.voxel_m} m; move them towards zero"
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
            self._table = hash_table(self.keys(), needed)
        self.tree = None
        self._mark += 1
        self._size = _insert(
            points, weight, self.voxel_m, *self._table, self._key, self._moment, self._mean, self._last_mark,
            self._size, self._mark, self.accumulate,
        )  # fmt: skip

    def keys(self) -> IntArray:
        """Keys ``(M,)`` of all voxels (`pack`)."""
        return self._key[: self._size]

    def means(self, slots: IntArray | None = None, copy: bool = True) -> Array:
        """Means ``(M, 3)`` in metres of all voxels, or of the voxels ``slots``; without ``copy`` for use until the next
        insertion."""
        if slots is not None:
            return self._mean[: self._size][slots]
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
        low, high = (np.clip(side, -REACH, REACH).astype(np.int64) for side in (low, high))
        return _near(self.keys(), low, high)

    def shapes(self, slots: IntArray, floor_m2: float = 0.0) -> Array:
        """Covariances ``(M, 6)`` of the points in the 3×3×3 voxels around each voxel, m²: upper triangles xx xy xz yy
        yz zz, with ``floor_m2``, the same in every call, added to the variances.

        Rows ``slots (N,)`` are computed, −1 is ignored; others are undefined. Valid until the next insertion.
        """
        self.link()
        _shapes(slots, floor_m2, self._shape, self._shape_mark, self._mark, self.voxel_m, self._around, self._moment)
        return self._shape[: self._size]

    def correspond(self, source: Array, T: Array, limit_m: float, match: IntArray, state: SearchState) -> int:
        """Write the slot of the mean nearest to each point ``source (N, 3)`` moved by ``T (4, 4)`` to ``match (N,)``.

        It is −1 if none is within ``limit_m``. ``state`` of the last call for the same source saves searches, whose
        number is returned.
        """
        self.link()
        return int(_correspond(source, T, limit_m, self.voxel_m, *self._table, self._around, self._mean, match, *state))

    def index(self) -> None:
        """Build the k-d tree of the means, for a map that stays as it is while many clouds are registered to it: pairs
        within five voxels are then found in a quarter of the time."""
        self.link()
        self.tree = build_kdtree(self.means()) if len(self) else None

    def link(self) -> None:
        """Find the voxels around each new voxel. `shapes` and `correspond` do so when they are called first, and after
        an insertion; copies of a linked map are linked."""
        _link(self._linked, self._size, self._key, *self._table, self._around)
        self._linked = self._size
