"""The shape of a cloud around each of its points: covariances and normals of the nearest neighbours."""

import numpy as np
from numba import njit

from steelnb.datatypes import Array
from steelnb.preprocess.kdtree import KdTree, build_kdtree, nearest_k

UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))
"""Rows and columns of the upper triangle in the order in which covariances are stored: xx xy xz yy yz zz."""


def neighbour_covariances(points: Array, neighbours: int = 20, tree: KdTree | None = None) -> Array:
    """Covariance of each point's nearest ``neighbours`` points, itself included: upper triangles ``(N, 6)``, m²."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    return _covariances(tree or build_kdtree(points), points, min(neighbours, len(points)))


def regularised(covariance: Array, eigenvalues: tuple[float, float, float] = (1e-3, 1.0, 1.0)) -> Array:
    """Covariances ``(N, 6)`` with the same axes and these eigenvalues, smallest first: GICP's planes by default.

    Source: Segal, Haehnel, Thrun, "Generalized-ICP" (RSS 2009), section III.
    """
    axes = np.linalg.eigh(full(covariance))[1]
    return packed((axes * np.asarray(eigenvalues)) @ axes.transpose(0, 2, 1))


def normals(covariance: Array) -> Array:
    """Unit vectors ``(N, 3)`` of the least spread."""
    return np.ascontiguousarray(np.linalg.eigh(full(covariance))[1][:, :, 0])


def full(covariance: Array) -> Array:
    """Upper triangles ``(N, 6)`` as symmetric matrices ``(N, 3, 3)``."""
    return covariance[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def packed(matrix: Array) -> Array:
    """Symmetric matrices ``(N, 3, 3)`` as upper triangles ``(N, 6)``."""
    return np.ascontiguousarray(matrix[:, UPPER[0], UPPER[1]])


@njit(cache=True)
def _covariances(tree, points, neighbours):  # type: ignore[no-untyped-def]
    result = np.zeros((len(points), 6))
    found, distance = np.empty(neighbours, np.int64), np.empty(neighbours)
    for i in range(len(points)):
        n = nearest_k(tree, points[i, 0], points[i, 1], points[i, 2], neighbours, found, distance)
        mx = my = mz = 0.0
        for k in range(n):
            mx += tree.point[found[k], 0]
            my += tree.point[found[k], 1]
            mz += tree.point[found[k], 2]
        mx, my, mz = mx / n, my / n, mz / n
        for k in range(n):
            x, y, z = tree.point[found[k], 0] - mx, tree.point[found[k], 1] - my, tree.point[found[k], 2] - mz
            result[i, 0] += x * x / n
            result[i, 1] += x * y / n
            result[i, 2] += x * z / n
            result[i, 3] += y * y / n
            result[i, 4] += y * z / n
            result[i, 5] += z * z / n
    return result
