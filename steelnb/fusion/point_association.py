"""Point-to-bar association by voxel lookup: a point belongs to the bar that is nearest to the mean of its voxel."""

import numpy as np
from numba import njit

from steelnb.points.voxel_kernels import find, pack


@njit(cache=True)
def world_points(points, T, range_max, floor):  # type: ignore[no-untyped-def]
    """Points of a scan ``(N, 3)``, sensor frame, in the world frame with their weights 1/range²; NaN, points beyond
    ``range_max`` metres and below the height ``floor`` are left out."""
    placed, weight = np.empty((len(points), 3)), np.empty(len(points))
    n = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        square = x * x + y * y + z * z
        if not 0.0 < square <= range_max * range_max:  # NaN too
            continue
        height = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if height < floor:
            continue
        placed[n, 0] = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        placed[n, 1] = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        placed[n, 2] = height
        weight[n] = 1.0 / square
        n += 1
    return placed[:n], weight[:n]


@njit(cache=True, nogil=True)
def points_on_bars(points, T, range_max, floor, bar_of_voxel, voxel, table_key, table_slot):  # type: ignore[no-untyped-def]
    """Those of the points of a scan ``(N, 3)`` that lie in the voxels of bars, sensor frame, and their bars; points are
    left out as by `world_points`."""
    found, bar, n, inverse = np.empty((len(points), 3)), np.empty(len(points), np.int64), 0, 1.0 / voxel
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if not 0.0 < x * x + y * y + z * z <= range_max * range_max:  # NaN too
            continue
        height = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if height < floor:
            continue
        a = np.int64(np.floor((T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) * inverse))
        b = np.int64(np.floor((T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) * inverse))
        slot = find(pack(a, b, np.int64(np.floor(height * inverse))), table_key, table_slot)
        if slot >= 0 and bar_of_voxel[slot] >= 0:
            found[n, 0], found[n, 1], found[n, 2], bar[n] = x, y, z, bar_of_voxel[slot]
            n += 1
    return found[:n], bar[:n]


@njit(cache=True)
def bars_of_points(points, bar_of_voxel, voxel, table_key, table_slot):  # type: ignore[no-untyped-def]
    """The bar ``(N,)`` of the voxel in which each point ``(N, 3)`` lies, −1 for none."""
    bar = np.full(len(points), -1, np.int64)
    inverse = 1.0 / voxel
    for n in range(len(points)):
        i, j = np.int64(np.floor(points[n, 0] * inverse)), np.int64(np.floor(points[n, 1] * inverse))
        slot = find(pack(i, j, np.int64(np.floor(points[n, 2] * inverse))), table_key, table_slot)
        if slot >= 0:
            bar[n] = bar_of_voxel[slot]
    return bar
