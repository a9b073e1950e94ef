"""Compiled parts of the voxel map: an open hash table of cubes, and the moments of the points in them."""

import numpy as np
from numba import njit

EMPTY = -1
BITS = 20
REACH = 1 << BITS
"""Voxels are counted from −REACH to REACH along each axis; 100 km each way with voxels of 10 cm."""


@njit(cache=True)
def _place(key, mask):  # type: ignore[no-untyped-def]
    # A product's bits depend only on the lower bits of its factors, and the first index of a voxel is in the highest of
    # its key: without the second product, voxels in a row along x share a place, and a search goes through all of them.
    h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> np.uint64(32))) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64((h >> np.uint64(32)) & np.uint64(mask))


@njit(cache=True)
def pack(i, j, k):  # type: ignore[no-untyped-def]
    """The three indices of a voxel as one number."""
    return ((i + REACH) << (2 * BITS + 2)) | ((j + REACH) << (BITS + 1)) | (k + REACH)


@njit(cache=True)
def unpack(key):  # type: ignore[no-untyped-def]
    """The three indices of a voxel."""
    mask = (np.int64(1) << (BITS + 1)) - 1
    return (key >> (2 * BITS + 2)) - REACH, ((key >> (BITS + 1)) & mask) - REACH, (key & mask) - REACH


@njit(cache=True)
def find(key, table_key, table_slot):  # type: ignore[no-untyped-def]
    """The slot of a voxel, or −1."""
    mask = len(table_key) - 1
    place = _place(key, mask)
    while table_key[place] != EMPTY:
        if table_key[place] == key:
            return table_slot[place]
        place = (place + 1) & mask
    return np.int64(-1)


@njit(cache=True)
def _put(key, slot, table_key, table_slot):  # type: ignore[no-untyped-def]
    mask = len(table_key) - 1
    place = _place(key, mask)
    while table_key[place] != EMPTY:
        place = (place + 1) & mask
    table_key[place], table_slot[place] = key, slot


@njit(cache=True)
def rehash(keys, table_key, table_slot):  # type: ignore[no-untyped-def]
    """Fill an empty table."""
    for slot in range(len(keys)):
        _put(keys[slot], slot, table_key, table_slot)


@njit(cache=True)
def insert(points, weights, voxel, table_key, table_slot, keys, moment, mean, seen, size, mark, remember):  # type: ignore[no-untyped-def]
    """Add points to the voxels; (voxels touched, number of voxels). ``seen`` holds the mark of who touched one last."""
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
            _put(key, slot, table_key, table_slot)
        m = moment[slot]
        if seen[slot] != mark:
            seen[slot] = mark
            touched[count] = slot
            count += 1
            if not remember and m[0] > 0.0:  # the old mean becomes one point
                x, y, z = m[1] / m[0], m[2] / m[0], m[3] / m[0]
                m[0], m[1], m[2], m[3], m[4], m[5], m[6] = 1.0, x, y, z, x * x, x * y, x * z
                m[7], m[8], m[9] = y * y, y * z, z * z
        w = weights[n]
        x, y, z = points[n, 0] - i * voxel, points[n, 1] - j * voxel, points[n, 2] - k * voxel
        m[0] += w
        m[1] += w * x
        m[2] += w * y
        m[3] += w * z
        m[4] += w * x * x
        m[5] += w * x * y
        m[6] += w * x * z
        m[7] += w * y * y
        m[8] += w * y * z
        m[9] += w * z * z
    for n in range(count):
        slot = touched[n]
        i, j, k = unpack(keys[slot])
        m = moment[slot]
        mean[slot, 0], mean[slot, 1] = i * voxel + m[1] / m[0], j * voxel + m[2] / m[0]
        mean[slot, 2] = k * voxel + m[3] / m[0]
    return touched[:count], size


@njit(cache=True)
def near(keys, low, high):  # type: ignore[no-untyped-def]
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
def link(first, last, keys, table_key, table_slot, around):  # type: ignore[no-untyped-def]
    """Tell new voxels and those beside them of each other."""
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
def shapes(touched, voxel, around, moment, shape, seen, mark):  # type: ignore[no-untyped-def]
    """Covariances of the 3×3×3 voxels around each voxel touched and each of its neighbours."""
    for slot in touched:
        for place in range(27):
            near = around[slot, place]
            if near >= 0 and seen[near] != mark:
                seen[near] = mark
                _shape(near, voxel, around, moment, shape)


@njit(cache=True)
def _shape(slot, voxel, around, moment, shape):  # type: ignore[no-untyped-def]
    w = x = y = z = xx = xy = xz = yy = yz = zz = 0.0
    for place in range(27):
        near = around[slot, place]
        if near < 0:
            continue
        m = moment[near]
        p, q, r = (place // 9 - 1) * voxel, (place // 3 % 3 - 1) * voxel, (place % 3 - 1) * voxel
        w += m[0]
        x += m[1] + m[0] * p
        y += m[2] + m[0] * q
        z += m[3] + m[0] * r
        xx += m[4] + p * (2.0 * m[1] + m[0] * p)
        xy += m[5] + p * m[2] + q * (m[1] + m[0] * p)
        xz += m[6] + p * m[3] + r * (m[1] + m[0] * p)
        yy += m[7] + q * (2.0 * m[2] + m[0] * q)
        yz += m[8] + q * m[3] + r * (m[2] + m[0] * q)
        zz += m[9] + r * (2.0 * m[3] + m[0] * r)
    x, y, z = x / w, y / w, z / w
    s = shape[slot]
    s[0], s[1], s[2] = xx / w - x * x, xy / w - x * y, xz / w - x * z
    s[3], s[4], s[5] = yy / w - y * y, yz / w - y * z, zz / w - z * z
