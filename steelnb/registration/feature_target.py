"""Registration target of LOAM: edges and planes, fitted to the five features nearest to each point."""

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from steelnb.points.kdtree import KdTree, build_kdtree, nearest_k
from steelnb.points.moments import NO_MOMENTS, add_point, covariance, eigen
from steelnb.registration.target import Pairs
from steelnb.types import Array, IntArray

NEIGHBOURS = 5
"""Features of which a line or a plane is fitted."""
LONGER = 3.0
"""Features lie along a line, or on a plane, where the next eigenvalue of their covariance is so many times smaller."""
ALONG_M2 = 100.0
"""Variance along a line or in a plane, where a pair says nothing."""


@dataclass(frozen=True)
class FeatureTarget:
    """Edge and plane features of a map or a scan, for the error ``gicp``.

    ``trees`` are those of edges and of planes; ``plane (N,)`` is 1 for the points of the source that lie on planes, 0
    for those on edges. A pair's covariance is ``sigma_m`` squared
    across its line or plane and very large along it, so the squared residual is the squared distance from the line or
    plane by that of its standard deviation: equations 2 and 3 of Zhang and Singh, "LOAM" (RSS 2014), with the lines and
    planes of its section VI, by the eigenvectors of neighbours.
    """

    trees: tuple[KdTree, KdTree]
    plane: IntArray
    sigma_m: float
    point: Array
    covariance: Array
    normal: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def of(cls, edges: Array, planes: Array, plane: IntArray, sigma_m: float) -> "FeatureTarget":
        """Target of edges and planes ``(M, 3)`` for a source, of whose points those of ``plane (N,)`` are on planes."""
        trees = build_kdtree(edges), build_kdtree(planes)
        return cls(trees, plane, sigma_m, np.zeros((len(plane), 3)), np.zeros((len(plane), 6)))

    def pairs(self, source: Array, limit_m: float) -> Pairs:
        """Lines and planes near each source point ``(N, 3)``, fitted anew at each pose."""
        match = np.full(len(source), -1)

        def update(T: Array) -> None:
            across = self.sigma_m**2
            for kind, tree in enumerate(self.trees):
                _fit(tree, kind, source, self.plane, T, limit_m, across, self.point, self.covariance, match)

        return Pairs(match, update)


@njit(cache=True)
def _fit(tree, kind, source, plane, T, limit, across, point, shape, match):
    """Write the middle and the covariance of the line (kind 0) or plane (1) at each source point of that kind under T.

    ``match (N,)`` becomes its own number, −1 where there is none.
    """
    node_of, reach = np.empty(64, np.int64), np.empty((64, 4))
    found, distance = np.empty(NEIGHBOURS, np.int64), np.empty(NEIGHBOURS)
    p = tree.point
    for i in range(len(source)):
        if plane[i] != kind:
            continue
        match[i] = -1
        x, y, z = source[i, 0], source[i, 1], source[i, 2]
        qx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        qy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        qz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if nearest_k(tree, qx, qy, qz, NEIGHBOURS, limit * limit, found, distance, node_of, reach) < NEIGHBOURS:
            continue
        m = NO_MOMENTS
        for k in found:
            m = add_point(m, 1.0, p[k, 0] - qx, p[k, 1] - qy, p[k, 2] - qz)
        xx, xy, xz, yy, yz, zz = covariance(m)
        least, middle, most = eigen(xx, xy, xz, yy, yz, zz)
        if kind == 1:
            if middle[0] < LONGER * least[0]:
                continue
            (_, nx, ny, nz), base, extra = least, ALONG_M2, across - ALONG_M2
        else:
            if most[0] < LONGER * middle[0]:
                continue
            (_, nx, ny, nz), base, extra = most, across, ALONG_M2 - across
        match[i] = i
        point[i, 0], point[i, 1], point[i, 2] = qx + m[1] / m[0], qy + m[2] / m[0], qz + m[3] / m[0]
        shape[i, 0], shape[i, 1], shape[i, 2] = base + extra * nx * nx, extra * nx * ny, extra * nx * nz
        shape[i, 3], shape[i, 4], shape[i, 5] = base + extra * ny * ny, extra * ny * nz, base + extra * nz * nz
