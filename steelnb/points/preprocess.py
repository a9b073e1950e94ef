"""Filters of every scan, in the order of the report: invalid returns, pass-through, voxel grid."""

import math

import numpy as np
from numba import njit

from steelnb.points.voxel_kernels import bucket_of
from steelnb.settings import PreprocessSettings
from steelnb.types import Array, Scan


@njit(cache=True)
def crop(points, T_drone_sensor, lower, upper, up, height, floor):
    """Pass-through filter: points ``(M, 3)`` in the drone frame of the returns ``(N, 3)`` in the sensor frame, metres.

    Keeps finite returns inside the box from ``lower (3,)`` to ``upper (3,)`` in the drone frame, bounds included, that
    are not below ``floor`` in the world frame. A point's height there is ``height`` + ``up (3,)`` · point.
    """
    T = T_drone_sensor
    kept = np.empty((len(points), 3))
    count = 0
    for i in range(len(points)):
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        inside = lower[0] <= x <= upper[0] and lower[1] <= y <= upper[1] and lower[2] <= z <= upper[2]
        if inside and up[0] * x + up[1] * y + up[2] * z + height >= floor:  # false for NaN
            kept[count, 0], kept[count, 1], kept[count, 2] = x, y, z
            count += 1
    return kept[:count]


def voxel_grid(points: Array, leaf_m: float) -> Array:
    """Centroids ``(M, 3)`` of the points ``(N, 3)`` in each occupied voxel of edge ``leaf_m``, as PCL's VoxelGrid.

    Metres. Voxels are aligned with the origin, and the centroids are sorted by voxel, so the order of the points only
    affects rounding. Raises ValueError if the leaf is not positive or far too small.
    """
    if not leaf_m > 0:
        raise ValueError(f"leaf_m = {leaf_m}: expected a positive length in metres")
    if not len(points):
        return np.zeros((0, 3))
    points = np.ascontiguousarray(points, dtype=np.float64)
    voxel, low, high = _voxel_indices(points, leaf_m)
    if np.prod(high - low + 1.0) >= 2.0**62:
        raise ValueError(f"leaf_m = {leaf_m}: expected a larger leaf, as one integer cannot number so many voxels")
    grouped, first = _group_by_voxel(points, voxel, low, high - low + 1)
    count = np.diff(np.append(first, len(points)))
    return np.add.reduceat(grouped, first, axis=0) / count[:, None]


@njit(cache=True)
def _voxel_indices(points, leaf_m):
    """Voxel indices ``(N, 3)`` of the points, and the lowest and highest index along each axis."""
    voxel = np.empty(points.shape, np.int64)
    low, high = np.full(3, np.int64(2) ** 62), np.full(3, -(np.int64(2) ** 62))
    for i in range(len(points)):
        for k in range(3):
            voxel[i, k] = np.int64(math.floor(points[i, k] / leaf_m))
            low[k], high[k] = min(low[k], voxel[i, k]), max(high[k], voxel[i, k])
    return voxel, low, high


@njit(cache=True)
def _group_by_voxel(points, voxel, low, extent):
    """Points stably sorted by voxel, and the index of the first point of each voxel.

    The voxels are found by a hash table and only they are sorted, since they are far fewer than the points.
    """
    n, size = len(voxel), 1024
    while size < 2 * n:
        size *= 2
    table, mask = np.full(size, -1, np.int64), size - 1
    group, key, count = np.empty(n, np.int64), np.empty(n, np.int64), np.zeros(n, np.int64)
    voxels, last, g = 0, np.int64(-1), np.int64(-1)
    for i in range(n):
        voxel_key = ((voxel[i, 0] - low[0]) * extent[1] + voxel[i, 1] - low[1]) * extent[2] + voxel[i, 2] - low[2]
        if voxel_key != last:  # neighbouring pixels mostly share a voxel
            bucket = bucket_of(voxel_key, mask)
            while table[bucket] >= 0 and key[table[bucket]] != voxel_key:
                bucket = (bucket + 1) & mask
            if table[bucket] < 0:
                table[bucket], key[voxels] = voxels, voxel_key
                voxels += 1
            g, last = table[bucket], voxel_key
        group[i] = g
        count[g] += 1
    first, free = np.empty(voxels, np.int64), np.empty(voxels, np.int64)
    begin = 0
    for rank, g in enumerate(np.argsort(key[:voxels])):
        first[rank] = free[g] = begin
        begin += count[g]
    grouped = np.empty_like(points)
    for i in range(n):
        for k in range(3):
            grouped[free[group[i]], k] = points[i, k]
        free[group[i]] += 1
    return grouped, first


def preprocess_scan(scan: Scan, T_world_drone: Array, T_drone_sensor: Array, settings: PreprocessSettings) -> Array:
    """Cropped and voxel-filtered points ``(N, 3)`` of a scan in the drone frame, metres, without the floor.

    ``T_world_drone (4, 4)`` may be an estimate: it is only used to cut the floor at ``floor_m`` in the world frame.
    """
    points = np.ascontiguousarray(scan.points, dtype=np.float64).reshape(-1, 3)
    upper = np.full(3, settings.crop_m)
    up, height = np.ascontiguousarray(T_world_drone[2, :3]), T_world_drone[2, 3]
    cropped = crop(points, T_drone_sensor, -upper, upper, up, height, settings.floor_m)
    return voxel_grid(cropped, settings.voxel_leaf_m)
