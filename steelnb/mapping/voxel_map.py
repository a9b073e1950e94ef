"""A map that grows with the flight: hashed voxels with the moments of their points."""

import numpy as np
from numba import njit

from steelnb.datatypes import Array, IntArray
from steelnb.errors import SettingsError

EMPTY = -1
BITS = 20
REACH = 1 << BITS
"""Voxels are counted from −REACH to REACH along each axis; 100 km each way with voxels of 10 cm."""


class VoxelMap:
    """Voxels of edge ``voxel_m`` in the world frame: number, mean and covariance of all points that fell into each.

    ``remember`` False makes it the report's map, which is filtered anew with every scan: an old mean then weighs as
    much as one new point, so the map forgets. With True, the mean is that of all points ever inserted.
    """

    def __init__(self, voxel_m: float, remember: bool = True) -> None:
        if not voxel_m > 0:
            raise SettingsError(f"voxel_m = {voxel_m}: expected a positive length")
        self.voxel_m, self.remember = voxel_m, remember
        self._table_key = np.full(1 << 14, EMPTY, dtype=np.int64)
        self._table_slot = np.zeros(1 << 14, dtype=np.int64)
        self._key = np.zeros(1 << 12, dtype=np.int64)
        self._moment = np.zeros((1 << 12, 10))  # weight, sum (3), outer (6), all about the voxel's corner
        self._shape = np.zeros((1 << 12, 6))
        self._seen = np.zeros(1 << 12, dtype=np.int64)
        self._size = 0
        self.frames = 0

    def __len__(self) -> int:
        return self._size

    @property
    def nbytes(self) -> int:
        """Memory of the map."""
        arrays = (self._table_key, self._table_slot, self._key, self._moment, self._shape, self._seen)
        return sum(array.nbytes for array in arrays)

    def insert(self, points: Array, weight: Array | None = None) -> IntArray:
        """Add points ``(N, 3)`` with weights ``(N,)`` (default 1); returns the voxels touched, each once.

        Points outside of ±REACH voxels are refused with `SettingsError`.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        if len(points) and np.abs(points).max() >= (REACH - 2) * self.voxel_m:
            raise SettingsError(
                f"a point lies {np.abs(points).max():.3g} m away: beyond the map of {self.voxel_m} m voxels"
            )
        self._reserve(len(points))
        self.frames += 1
        weights = np.ones(len(points)) if weight is None else np.asarray(weight, dtype=np.float64)
        touched, self._size = _insert(
            points, weights, self.voxel_m, self._table_key, self._table_slot, self._key, self._moment, self._seen,
            self._size, self.frames, self.remember,
        )  # fmt: skip
        return touched

    def _reserve(self, more: int) -> None:
        while self._size + more > len(self._key):
            self._key, self._seen = (np.concatenate([a, np.zeros_like(a)]) for a in (self._key, self._seen))
            self._moment, self._shape = (np.concatenate([a, np.zeros_like(a)]) for a in (self._moment, self._shape))
        if 2 * (self._size + more) > len(self._table_key):
            size = len(self._table_key)
            while 2 * (self._size + more) > size:
                size *= 2
            self._table_key = np.full(size, EMPTY, dtype=np.int64)
            self._table_slot = np.zeros(size, dtype=np.int64)
            _rehash(self._key[: self._size], self._table_key, self._table_slot)

    def means(self, chosen: IntArray | None = None) -> Array:
        """Means ``(M, 3)`` of the voxels, or of those chosen."""
        chosen = np.arange(self._size) if chosen is None else chosen
        moment = self._moment[chosen]
        return _corner(self._key[chosen], self.voxel_m) + moment[:, 1:4] / moment[:, :1]

    def weights(self, chosen: IntArray | None = None) -> Array:
        """Total weights ``(M,)`` of the voxels, or of those chosen."""
        return self._moment[: self._size, 0] if chosen is None else self._moment[chosen, 0]

    def near(self, centre: Array, radius_m: float) -> IntArray:
        """Voxels whose corner lies within ``radius_m`` of a point, along each axis."""
        return _near(self._key[: self._size], self.voxel_m, np.asarray(centre, dtype=np.float64), radius_m)

    def update_shapes(self, touched: IntArray) -> None:
        """Recompute the covariance around the voxels touched and their neighbours, from the moments of 3×3×3 voxels."""
        _shapes(
            touched, self.voxel_m, self._table_key, self._table_slot, self._key, self._moment, self._shape, self._size
        )

    def shapes(self, chosen: IntArray) -> Array:
        """Covariances ``(M, 6)`` of the points in the 3×3×3 voxels around each, as `update_shapes` left them."""
        return self._shape[chosen]


@njit(cache=True)
def _hash(key, mask):  # type: ignore[no-untyped-def]
    h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64((h >> np.uint64(20)) & np.uint64(mask))


@njit(cache=True)
def _pack(i, j, k):  # type: ignore[no-untyped-def]
    return ((i + REACH) << (2 * BITS + 2)) | ((j + REACH) << (BITS + 1)) | (k + REACH)


@njit(cache=True)
def _find(key, table_key, table_slot):  # type: ignore[no-untyped-def]
    mask = len(table_key) - 1
    place = _hash(key, mask)
    while table_key[place] != EMPTY:
        if table_key[place] == key:
            return table_slot[place]
        place = (place + 1) & mask
    return -1


@njit(cache=True)
def _put(key, slot, table_key, table_slot):  # type: ignore[no-untyped-def]
    mask = len(table_key) - 1
    place = _hash(key, mask)
    while table_key[place] != EMPTY:
        place = (place + 1) & mask
    table_key[place], table_slot[place] = key, slot


@njit(cache=True)
def _rehash(keys, table_key, table_slot):  # type: ignore[no-untyped-def]
    for slot in range(len(keys)):
        _put(keys[slot], slot, table_key, table_slot)


@njit(cache=True)
def _insert(points, weights, voxel, table_key, table_slot, keys, moment, seen, size, frame, remember):  # type: ignore[no-untyped-def]
    touched = np.empty(len(points), np.int64)
    count = 0
    inverse = 1.0 / voxel
    for n in range(len(points)):
        i, j, k = (
            np.int64(np.floor(points[n, 0] * inverse)), np.int64(np.floor(points[n, 1] * inverse)),
            np.int64(np.floor(points[n, 2] * inverse)),
        )  # fmt: skip
        key = _pack(i, j, k)
        slot = _find(key, table_key, table_slot)
        if slot < 0:
            slot = size
            size += 1
            keys[slot] = key
            moment[slot, :] = 0.0
            seen[slot] = 0
            _put(key, slot, table_key, table_slot)
        if seen[slot] != frame:
            seen[slot] = frame
            touched[count] = slot
            count += 1
            if not remember and moment[slot, 0] > 0.0:  # the old mean becomes one point
                w = moment[slot, 0]
                x, y, z = moment[slot, 1] / w, moment[slot, 2] / w, moment[slot, 3] / w
                moment[slot, :] = (1.0, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)
        w = weights[n]
        x, y, z = points[n, 0] - i * voxel, points[n, 1] - j * voxel, points[n, 2] - k * voxel
        m = moment[slot]
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
    return touched[:count], size


def _corner(keys: IntArray, voxel: float) -> Array:
    mask = (1 << (BITS + 1)) - 1
    cell = np.stack([keys >> (2 * BITS + 2), (keys >> (BITS + 1)) & mask, keys & mask], axis=1) - REACH
    return cell * voxel


@njit(cache=True)
def _near(keys, voxel, centre, radius):  # type: ignore[no-untyped-def]
    mask = (np.int64(1) << (BITS + 1)) - 1
    i0, i1 = (centre[0] - radius) / voxel - 1, (centre[0] + radius) / voxel
    j0, j1 = (centre[1] - radius) / voxel - 1, (centre[1] + radius) / voxel
    k0, k1 = (centre[2] - radius) / voxel - 1, (centre[2] + radius) / voxel
    found = np.empty(len(keys), np.int64)
    count = 0
    for slot in range(len(keys)):
        key = keys[slot]
        i, j, k = (key >> (2 * BITS + 2)) - REACH, ((key >> (BITS + 1)) & mask) - REACH, (key & mask) - REACH
        if i0 <= i <= i1 and j0 <= j <= j1 and k0 <= k <= k1:
            found[count] = slot
            count += 1
    return found[:count]


@njit(cache=True)
def _shapes(touched, voxel, table_key, table_slot, keys, moment, shape, size):  # type: ignore[no-untyped-def]
    mask = (np.int64(1) << (BITS + 1)) - 1
    fresh = np.zeros(size, np.bool_)
    for slot in touched:
        key = keys[slot]
        i, j, k = (key >> (2 * BITS + 2)) - REACH, ((key >> (BITS + 1)) & mask) - REACH, (key & mask) - REACH
        for a in range(-1, 2):
            for b in range(-1, 2):
                for c in range(-1, 2):
                    near = _find(_pack(i + a, j + b, k + c), table_key, table_slot)
                    if near >= 0:
                        fresh[near] = True
    for slot in range(size):
        if not fresh[slot]:
            continue
        key = keys[slot]
        i, j, k = (key >> (2 * BITS + 2)) - REACH, ((key >> (BITS + 1)) & mask) - REACH, (key & mask) - REACH
        w = x = y = z = xx = xy = xz = yy = yz = zz = 0.0
        for a in range(-1, 2):
            for b in range(-1, 2):
                for c in range(-1, 2):
                    near = _find(_pack(i + a, j + b, k + c), table_key, table_slot)
                    if near < 0:
                        continue
                    m = moment[near]
                    p, q, r = a * voxel, b * voxel, c * voxel
                    w += m[0]
                    x += m[1] + m[0] * p
                    y += m[2] + m[0] * q
                    z += m[3] + m[0] * r
                    xx += m[4] + 2 * p * m[1] + m[0] * p * p
                    xy += m[5] + p * m[2] + q * m[1] + m[0] * p * q
                    xz += m[6] + p * m[3] + r * m[1] + m[0] * p * r
                    yy += m[7] + 2 * q * m[2] + m[0] * q * q
                    yz += m[8] + q * m[3] + r * m[2] + m[0] * q * r
                    zz += m[9] + 2 * r * m[3] + m[0] * r * r
        x, y, z = x / w, y / w, z / w
        s = shape[slot]
        s[0], s[1], s[2] = xx / w - x * x, xy / w - x * y, xz / w - x * z
        s[3], s[4], s[5] = yy / w - y * y, yz / w - y * z, zz / w - z * z
