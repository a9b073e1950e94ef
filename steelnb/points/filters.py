"""Filters applied to every scan, in the report's order: invalid returns, pass-through, voxel grid."""

import math

import numpy as np

from steelnb.core.checks import checked_number, checked_points, checked_pose
from steelnb.core.errors import InputError
from steelnb.core.kernels import njit
from steelnb.core.types import Array, Scan
from steelnb.points.voxel_map import find, hash_table, put
from steelnb.settings import PreprocessSettings


@njit(cache=True)
def crop(points, T_drone_sensor, lower, upper, up, height, floor):
    """Pass-through filter: from returns ``(N, 3)`` in the sensor frame to points ``(M, 3)`` in the drone frame, metres.

    Keeps finite returns inside the box from ``lower (3,)`` to ``upper (3,)`` in the drone frame, bounds included, that
    are not below ``floor`` in the world frame. The height of a point is ``height`` + ``up (3,)`` · point.
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
    """Centroids ``(M, 3)`` of the points ``(N, 3)`` in each occupied voxel of edge ``leaf_m``, like PCL's VoxelGrid.

    Lengths in metres. Voxels are aligned with the origin, and centroids are sorted by voxel, so the order of the points
    only affects rounding. Raises `InputError` for points of another shape or not finite, and for a leaf that is not
    positive or far too small.
    """
    points, leaf_m = checked_points(points), checked_number(leaf_m, "leaf_m", above=0)
    if not len(points):
        return np.zeros((0, 3))
    coordinates = np.ascontiguousarray(points.T)  # rows have fast extremes
    low, high = np.floor(coordinates.min(axis=1) / leaf_m), np.floor(coordinates.max(axis=1) / leaf_m)
    if not np.prod(high - low + 1.0) < 2.0**62:
        raise InputError(f"leaf_m = {leaf_m}: expected a larger leaf, as one integer cannot number so many voxels")
    grouped, first = _group_by_voxel(points, leaf_m, low.astype(np.int64), (high - low + 1.0).astype(np.int64))
    count = np.diff(np.append(first, len(points)))
    return np.add.reduceat(grouped, first, axis=0) / count[:, None]


@njit(cache=True)
def _group_by_voxel(points, leaf_m, low, extent):
    """Points stably sorted by voxel, and the index of the first point of each voxel.

    A hash table finds the voxels; only these are sorted, since they are far fewer than the points.
    """
    n = len(points)
    table_key, table_slot = hash_table(np.empty(0, np.int64), n)
    group, voxel_key, count = np.empty(n, np.int64), np.empty(n, np.int64), np.zeros(n, np.int64)
    voxels, last, g = 0, np.int64(-1), np.int64(-1)
    for i in range(n):
        key = np.int64(0)
        for k in range(3):
            key = key * extent[k] + np.int64(math.floor(points[i, k] / leaf_m)) - low[k]
        if key != last:  # neighbouring pixels mostly share a voxel
            last, g = key, find(key, table_key, table_slot)
            if g < 0:
                g = np.int64(voxels)
                put(key, g, table_key, table_slot)
                voxel_key[voxels] = key
                voxels += 1
        group[i] = g
        count[g] += 1
    first, free = np.empty(voxels, np.int64), np.empty(voxels, np.int64)
    begin = 0
    for rank, g in enumerate(np.argsort(voxel_key[:voxels])):
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
    Raises `InputError`.
    """
    points = np.ascontiguousarray(scan.points).reshape(-1, 3)
    T_world_drone = checked_pose(T_world_drone, "T_world_drone")
    T_drone_sensor = checked_pose(T_drone_sensor, "T_drone_sensor")
    upper = np.full(3, settings.crop_m)
    up, height = np.ascontiguousarray(T_world_drone[2, :3]), T_world_drone[2, 3]
    cropped = crop(points, T_drone_sensor, -upper, upper, up, height, settings.floor_m)
    return voxel_grid(cropped, settings.voxel_leaf_m)
