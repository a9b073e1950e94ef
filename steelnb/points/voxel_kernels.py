"""Compiled parts of the voxel map: an open-addressing hash table of voxels, and the moments of their points."""

import numpy as np
from numba import njit

from steelnb.points.moments import NO_MOMENTS, add_moments, add_point, covariance, store

EMPTY = -1
BITS = 20
REACH = 1 << BITS
"""Voxels are counted from −REACH to REACH along each axis; 100 km each way with voxels of 10 cm."""


@njit(cache=True)
def place_of(key, mask):
    """Where in a hash table with ``mask`` + 1 entries the search for a key begins."""
    # A product's bits depend only on the lower bits of its factors, and the first index of a voxel is in the highest of
    # its key: without the second product, voxels in a row along x share a place, and a search goes through all of them.
    h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> np.uint64(32))) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64((h >> np.uint64(32)) & np.uint64(mask))


@njit(cache=True)
def pack(i, j, k):
    """The three indices of a voxel as one number."""
    return ((i + REACH) << (2 * BITS + 2)) | ((j + REACH) << (BITS + 1)) | (k + REACH)


@njit(cache=True)
def unpack(key):
    """The three indices of a voxel."""
    mask = (np.int64(1) << (BITS + 1)) - 1
    return (key >> (2 * BITS + 2)) - REACH, ((key >> (BITS + 1)) & mask) - REACH, (key & mask) - REACH


@njit(cache=True)
def find(key, table_key, table_slot):
    """The slot of a voxel, or −1."""
    mask = len(table_key) - 1
    place = place_of(key, mask)
    while table_key[place] != EMPTY:
        if table_key[place] == key:
            return table_slot[place]
        place = (place + 1) & mask
    return np.int64(-1)


@njit(cache=True)
def put(key, slot, table_key, table_slot):
    """Enter a voxel that the table does not hold."""
    mask = len(table_key) - 1
    place = place_of(key, mask)
    while table_key[place] != EMPTY:
        place = (place + 1) & mask
    table_key[place], table_slot[place] = key, slot


@njit(cache=True)
def rehash(keys, table_key, table_slot):
    """Fill an empty table."""
    for slot in range(len(keys)):
        put(keys[slot], slot, table_key, table_slot)


@njit(cache=True)
def insert(points, weights, voxel, table_key, table_slot, keys, moment, mean, seen, size, mark, accumulate):
    """Add points to the voxels; (slots touched, number of voxels). ``seen`` holds the last mark of each voxel."""
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
            seen[slot] = 0
            put(key, slot, table_key, table_slot)
        m = moment[slot]
        if seen[slot] != mark:
            seen[slot] = mark
            touched[count] = slot
            count += 1
            if not accumulate and m[0] > 0.0:  # the old mean becomes one point
                store(add_point(NO_MOMENTS, 1.0, m[1] / m[0], m[2] / m[0], m[3] / m[0]), m)
        x, y, z = points[n, 0] - i * voxel, points[n, 1] - j * voxel, points[n, 2] - k * voxel
        store(add_point(m, weights[n], x, y, z), m)
    for n in range(count):
        slot = touched[n]
        i, j, k = unpack(keys[slot])
        m = moment[slot]
        mean[slot, 0], mean[slot, 1] = i * voxel + m[1] / m[0], j * voxel + m[2] / m[0]
        mean[slot, 2] = k * voxel + m[3] / m[0]
    return touched[:count], size


@njit(cache=True)
def near(keys, low, high):
    """Slots of the voxels with indices from ``low (3,)`` to ``high (3,)``: a loop over all, without a branch."""
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
    """Link new voxels with their neighbours: slots of the 3×3×3 voxels around each, −1 for none."""
    for slot in range(first, last):
        i, j, k = unpack(keys[slot])
        place = 0
        for a in range(-1, 2):
            for b in range(-1, 2):
                for c in range(-1, 2):
                    other = find(pack(i + a, j + b, k + c), table_key, table_slot)
                    around[slot, place] = other
                    if other >= 0:
                        around[other, 26 - place] = slot
                    place += 1


@njit(cache=True)
def outdate(touched, around, outdated):
    """Note in ``outdated (V,)`` that the shapes of the voxels touched and of each of their neighbours have changed."""
    for slot in touched:
        for place in range(27):
            near = around[slot, place]
            if near >= 0:
                outdated[near] = True


@njit(cache=True)
def shapes(asked, slots, floor, value, voxel, around, moment, shape, outdated):
    """Write to ``value (M, 6)``, NaN where it was not asked for before, the shapes of the voxels at places ``asked`` of
    ``slots (M,)``, −1 for none, with ``floor`` added to their diagonals; those outdated are computed first."""
    for i in asked:
        if i < 0 or value[i, 0] == value[i, 0]:
            continue
        slot = slots[i]
        if outdated[slot]:
            outdated[slot] = False
            _shape(slot, voxel, around, moment, shape)
        value[i, :] = shape[slot]
        value[i, 0] += floor
        value[i, 3] += floor
        value[i, 5] += floor


@njit(cache=True)
def _shape(slot, voxel, around, moment, shape):
    m = NO_MOMENTS
    for place in range(27):
        near = around[slot, place]
        if near >= 0:
            x, y, z = (place // 9 - 1) * voxel, (place // 3 % 3 - 1) * voxel, (place % 3 - 1) * voxel
            m = add_moments(m, moment[near], x, y, z)
    shape[slot, :] = covariance(m)
