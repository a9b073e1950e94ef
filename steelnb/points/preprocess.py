"""The filters that the report applies to every scan, in its order: invalid returns, pass-through, voxel grid."""

import numpy as np
from numba import njit

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
    cube = np.floor(points / leaf_m).astype(np.int64)
    cube -= cube.min(axis=0)
    extent = cube.max(axis=0) + 1
    if float(extent[0]) * float(extent[1]) * float(extent[2]) < 2.0**62:
        key = (cube[:, 0] * extent[1] + cube[:, 1]) * extent[2] + cube[:, 2]
        order = np.argsort(key, kind="stable")
        new = np.concatenate([[True], np.diff(key[order]) != 0])
    else:  # more cubes than an integer can count: sort by the three coordinates instead
        order = np.lexsort(cube.T[::-1])
        new = np.concatenate([[True], (np.diff(cube[order], axis=0) != 0).any(axis=1)])
    first = np.flatnonzero(new)
    count = np.diff(np.append(first, len(points)))
    return np.add.reduceat(points[order], first, axis=0) / count[:, None]


def preprocess_scan(scan: Scan, T_world_drone: Array, T_drone_sensor: Array, settings: PreprocessSettings) -> Array:
    """Cropped and voxel-filtered points ``(N, 3)`` of a scan in the drone frame, metres, without the floor.

    ``T_world_drone (4, 4)`` is an estimate; it only serves to cut the floor, below ``floor_m`` in the world.
    """
    points = np.ascontiguousarray(scan.points, dtype=np.float64).reshape(-1, 3)
    upper = np.full(3, settings.crop_m)
    up, height = np.ascontiguousarray(T_world_drone[2, :3]), T_world_drone[2, 3]
    kept = crop(points, T_drone_sensor, upper * [0, -1, -1], upper, up, height, settings.floor_m)
    return voxel_grid(kept, settings.voxel_leaf_m)
