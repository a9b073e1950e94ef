"""Compiled parts of the voxel map: a hash table of voxels with open addressing, and the moments of their points."""

import numpy as np

from steelnb.core.kernels import njit
from steelnb.core.types import IntArray
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
def insert(points, weights, voxel, table_key, table_slot, keys, moment, mean, last_mark, size, mark, accumulate):
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
def near(keys, low, high):
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
def link(first, last, keys, table_key, table_slot, around):
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
def shapes(index, slots, floor, value, voxel, around, moment):
    """Write the covariances of all points in the 3×3×3 voxels around the voxels ``slots[index]`` to ``value[index]``.

    ``floor`` is added to their diagonals. Negative ``index`` entries and rows of ``value (M, 6)`` that are not NaN are
    skipped.
    """
    for at in index:
        if at < 0 or not np.isnan(value[at, 0]):
            continue
        m = NO_MOMENTS
        for neighbour in range(27):
            other = around[slots[at], neighbour]
            if other >= 0:
                i, j, k = neighbour // 9 - 1, neighbour // 3 % 3 - 1, neighbour % 3 - 1
                m = add_moments(m, moment[other], i * voxel, j * voxel, k * voxel)
        value[at, :] = covariance(m)
        value[at, 0] += floor
        value[at, 3] += floor
        value[at, 5] += floor
