"""Registration target of LOAM: lines and planes fitted to the five nearest features of each source point."""

from dataclasses import dataclass, field

import numpy as np

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray
from steelnb.points.kdtree import KdTree, build_kdtree, nearest_k
from steelnb.points.moments import NO_MOMENTS, add_point, covariance, eigen
from steelnb.registration.target import Search

NEIGHBOURS = 5
"""Number of features to which a line or plane is fitted."""
EIGENVALUE_RATIO = 3.0
"""Minimum ratio of the largest to the middle eigenvalue of a line, and of the middle to the smallest of a plane."""
ALONG_M2 = 100.0
"""Variance along a line or in a plane, so large that a pair does not constrain these directions."""


@dataclass(frozen=True)
class FeatureTarget:
    """Edge and planar features of a map or a scan, for the error ``gicp``.

    ``trees`` index the edge and the planar features. ``plane (N,)`` is 1 for planar source points and 0 for edge
    points. The covariance of a pair is ``sigma_m`` squared across its line or plane and very large along it. The
    residual is therefore the distance to the line or plane in standard deviations: equations 2 and 3 of Zhang and
    Singh, "LOAM" (RSS 2014). Lines and planes are eigenvectors of the neighbours' covariance, as in its section VI.
    """

    trees: tuple[KdTree, KdTree]
    plane: IntArray
    sigma_m: float
    point: Array
    covariance: Array
    normal: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def of(cls, edges: Array, planes: Array, plane: IntArray, sigma_m: float) -> "FeatureTarget":
        """Target of ``edges`` and ``planes (M, 3)``, metres, for a source with points of the kinds ``plane (N,)``."""
        trees = build_kdtree(edges), build_kdtree(planes)
        return cls(trees, plane, sigma_m, np.zeros((len(plane), 3)), np.zeros((len(plane), 6)))

    def search(self, source: Array, limit_m: float) -> Search:
        """Line or plane near each source point ``(N, 3)``, fitted again at each pose."""
        match = np.full(len(source), -1)

        def search(T: Array) -> IntArray:
            across = self.sigma_m**2
            for kind, tree in enumerate(self.trees):
                _fit(tree, kind, source, self.plane, T, limit_m, across, self.point, self.covariance, match)
            return match

        return search


@njit(cache=True)
def _fit(tree, kind, source, plane, T, limit, across, point, shape, match):
    """Write the mean and covariance of the line (kind 0) or plane (1) near each source point of that kind under T.

    ``match (N,)`` becomes the point's own index, or −1 if there is no such line or plane.
    """
    node_of, node_distance = np.empty(64, np.int64), np.empty((64, 4))
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
        if nearest_k(tree, qx, qy, qz, NEIGHBOURS, limit * limit, found, distance, node_of, node_distance) < NEIGHBOURS:
            continue
        m = NO_MOMENTS
        for k in found:
            m = add_point(m, 1.0, p[k, 0] - qx, p[k, 1] - qy, p[k, 2] - qz)
        xx, xy, xz, yy, yz, zz = covariance(m)
        small, medium, large = eigen(xx, xy, xz, yy, yz, zz)
        if kind == 1:
            if medium[0] < EIGENVALUE_RATIO * small[0]:
                continue
            (_, nx, ny, nz), base, extra = small, ALONG_M2, across - ALONG_M2
        else:
            if large[0] < EIGENVALUE_RATIO * medium[0]:
                continue
            (_, nx, ny, nz), base, extra = large, across, ALONG_M2 - across
        match[i] = i
        point[i, 0], point[i, 1], point[i, 2] = qx + m[1] / m[0], qy + m[2] / m[0], qz + m[3] / m[0]
        shape[i, 0], shape[i, 1], shape[i, 2] = base + extra * nx * nx, extra * nx * ny, extra * nx * nz
        shape[i, 3], shape[i, 4], shape[i, 5] = base + extra * ny * ny, extra * ny * nz, base + extra * nz * nz
