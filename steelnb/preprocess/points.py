"""The three filters that the report runs on every scan, in its order."""

import numpy as np
from numba import njit

from steelnb.config import PreprocessSettings
from steelnb.datatypes import Array, Scan


@njit(cache=True)
def crop(points, T_drone_sensor, lower, upper, up, height, floor):  # type: ignore[no-untyped-def]
    """The returns ``(N, 3)`` of a scan that count, in the drone frame ``(M, 3)``, in their order.

    Those are finite, inside the box from ``lower (3,)`` to ``upper (3,)``, bounds included, and not below ``floor`` in
    the world, where a point of the drone frame is ``height`` + ``up (3,)`` · point high.
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
    """One point for each cube of edge ``leaf_m`` that holds any: the mean of its points, as PCL's VoxelGrid.

    The cubes are aligned with the origin. The result ``(M, 3)`` is sorted by cube, so it does not depend on the order
    of the points, except through the rounding of the sums. Raises ValueError for a leaf that is not positive.
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
    """Scan → voxel-filtered points ``(N, 3)`` in the drone frame, without the floor.

    The pose is the estimate at hand; it only serves to find the floor, which lies below ``floor_m`` in the world.
    """
    points = np.ascontiguousarray(scan.points, dtype=np.float64).reshape(-1, 3)
    upper = np.array([settings.x_max_m, settings.y_max_m, settings.z_max_m])
    up, height = np.ascontiguousarray(T_world_drone[2, :3]), T_world_drone[2, 3]
    kept = crop(points, T_drone_sensor, upper * [0, -1, -1], upper, up, height, settings.floor_m)
    return voxel_grid(kept, settings.voxel_leaf_m)
