"""The filters that the report applies to every scan, in its order: invalid returns, pass-through, voxel grid."""

import math

import numpy as np
from numba import njit

from steelnb.points.voxel_kernels import place_of
from steelnb.settings import PreprocessSettings
from steelnb.types import Array, Scan


@njit(cache=True)
def crop(points, T_drone_sensor, lower, upper, up, height, floor):
    """Pass-through filter of returns ``(N, 3)`` in the sensor frame: those kept, in the drone frame ``(M, 3)``.

    Kept are finite returns inside the box from ``lower (3,)`` to ``upper (3,)`` in the drone frame, bounds included,
    and not below ``floor`` in the world, where the height of a point is ``height`` + ``up (3,)`` · point. Metres.
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
        if inside and up[0] * x + up[1] * y + up[2] * z + height >= floor:  # NaN is not inside
            kept[count, 0], kept[count, 1], kept[count, 2] = x, y, z
            count += 1
    return kept[:count]


def voxel_grid(points: Array, leaf_m: float) -> Array:
    """Mean of the points ``(N, 3)`` in each occupied voxel of edge ``leaf_m``, metres, as PCL's VoxelGrid: ``(M, 3)``.

    Voxels are aligned with the origin and the result is sorted by voxel, so the order of the points changes no more
    than the rounding of the sums. Raises ValueError for a leaf that is not positive.
    """
    if not leaf_m > 0:
        raise ValueError(f"leaf_m = {leaf_m}: expected a positive length in metres")
    if not len(points):
        return np.zeros((0, 3))
    points = np.ascontiguousarray(points, dtype=np.float64)
    cube, low, high = _cubes(points, leaf_m)
    extent = high - low + 1
    if float(extent[0]) * float(extent[1]) * float(extent[2]) < 2.0**62:
        grouped, first = _grouped(points, cube, low, extent)
    else:  # more cubes than an integer can count: sort by the three coordinates instead
        order = np.lexsort(cube.T[::-1])
        grouped, cube = points[order], cube[order]
        first = np.flatnonzero(np.concatenate([[True], (np.diff(cube, axis=0) != 0).any(axis=1)]))
    count = np.diff(np.append(first, len(points)))
    return np.add.reduceat(grouped, first, axis=0) / count[:, None]


@njit(cache=True)
def _cubes(points, leaf_m):
    """The cube ``(N, 3)`` that holds each point, and the lowest and highest index along each axis."""
    cube = np.empty(points.shape, np.int64)
    low, high = np.full(3, np.int64(2) ** 62), np.full(3, -(np.int64(2) ** 62))
    for i in range(len(points)):
        for k in range(3):
            cube[i, k] = np.int64(math.floor(points[i, k] / leaf_m))
            low[k], high[k] = min(low[k], cube[i, k]), max(high[k], cube[i, k])
    return cube, low, high


@njit(cache=True)
def _grouped(points, cube, low, extent):
    """Points in the order of their cubes, those of a cube in their own, and where each cube begins among them.

    A hash table finds the cubes, of which there are far fewer than points, and only they are sorted.
    """
    n, size = len(cube), 1024
    while size < 2 * n:
        size *= 2
    table, mask = np.full(size, -1, np.int64), size - 1
    group, key, count = np.empty(n, np.int64), np.empty(n, np.int64), np.zeros(n, np.int64)
    cubes, last, g = 0, np.int64(-1), np.int64(-1)
    for i in range(n):
        own = ((cube[i, 0] - low[0]) * extent[1] + cube[i, 1] - low[1]) * extent[2] + cube[i, 2] - low[2]
        if own != last:  # neighbouring pixels mostly share a cube
            at = place_of(own, mask)
            while table[at] >= 0 and key[table[at]] != own:
                at = (at + 1) & mask
            if table[at] < 0:
                table[at], key[cubes] = cubes, own
                cubes += 1
            g, last = table[at], own
        group[i] = g
        count[g] += 1
    first, free = np.empty(cubes, np.int64), np.empty(cubes, np.int64)
    begin = 0
    for rank, g in enumerate(np.argsort(key[:cubes])):
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

    ``T_world_drone (4, 4)`` is an estimate; it only serves to cut the floor, below ``floor_m`` in the world.
    """
    points = np.ascontiguousarray(scan.points, dtype=np.float64).reshape(-1, 3)
    reach = np.full(3, settings.crop_m)
    up, height = np.ascontiguousarray(T_world_drone[2, :3]), T_world_drone[2, 3]
    kept = crop(points, T_drone_sensor, -reach, reach, up, height, settings.floor_m)
    return voxel_grid(kept, settings.voxel_leaf_m)
