"""The three filters that the report runs on every scan, in its order."""

import numpy as np

from steelnb.config import PreprocessSettings
from steelnb.datatypes import Array, Scan


def finite_points(points: Array) -> Array:
    """Points ``(H, W, 3)`` or ``(N, 3)`` without those that have a NaN or infinite coordinate, as ``(M, 3)``."""
    flat = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    return flat[np.isfinite(flat).all(axis=1)]


def pass_through(points: Array, lower: Array, upper: Array) -> Array:
    """The points ``(N, 3)`` inside the axis-aligned box from ``lower (3,)`` to ``upper (3,)``, bounds included."""
    return points[((points >= lower) & (points <= upper)).all(axis=1)]


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
    sensor = finite_points(scan.points)
    drone = sensor @ T_drone_sensor[:3, :3].T + T_drone_sensor[:3, 3]
    upper = np.array([settings.x_max_m, settings.y_max_m, settings.z_max_m])
    drone = pass_through(drone, upper * [0, -1, -1], upper)
    height = drone @ T_world_drone[2, :3] + T_world_drone[2, 3]
    return voxel_grid(drone[height >= settings.floor_m], settings.voxel_leaf_m)
