"""Point covariances and normals, estimated from the nearest neighbours of each point."""

import math

import numpy as np

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray
from steelnb.points.kdtree import KdTree, build_kdtree, nearest_k, within_radius
from steelnb.points.moments import NO_MOMENTS, add_point, covariance, eigen

FULL = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Row and column of a symmetric matrix → index in its upper triangle, in storage order: xx xy xz yy yz zz."""
NEIGHBOURS = 20
"""Default number of points per covariance, as in PCL's GICP."""
PLANE_THICKNESS = 1e-3
"""Variance along the normal of a plane-shaped covariance; its variance in the plane is 1."""


def neighbour_covariances(points: Array, neighbours: int = NEIGHBOURS, tree: KdTree | None = None) -> Array:
    """Covariance of the nearest ``neighbours`` points of each point, itself included: upper triangles ``(N, 6)``, m².

    ``points (N, 3)`` must be finite. Pass their ``tree`` if it is already built; if ``points`` is ``tree.point``, the
    result is in the order of the tree. Ties for the last neighbour are broken arbitrarily.
    """
    tree = tree or build_kdtree(points)
    in_order = np.full((len(tree.point), 6), np.nan)
    _fill(tree, min(neighbours, len(tree.point)), _leaves(tree), np.arange(len(tree.point)), in_order, False)
    if points is tree.point:
        return in_order
    result = np.empty_like(in_order)
    result[tree.order] = in_order
    return result


def regularised(covariances: Array) -> Array:
    """Plane-shaped covariances ``(N, 6)`` with the normals n of ``covariances (N, 6)``: I − (1 − ε) n nᵀ.

    ε is `PLANE_THICKNESS`: GICP's plane-to-plane model.

    Source: Segal, Haehnel, Thrun, "Generalized-ICP" (RSS 2009), section III.
    """
    result = np.array(covariances)
    _regularise(result)
    return result


class PlaneCovariances:
    """`regularised` covariances of the points of a tree, computed on demand: a scan matches few points of a map.

    Each is that of the nearest ``neighbours`` points, itself included. ``value (M, 6)``, in the order of the tree, is
    NaN until computed.
    """

    def __init__(self, tree: KdTree, neighbours: int) -> None:
        self.tree, self.neighbours = tree, min(neighbours, len(tree.point))
        self.value, self._leaf_of = np.full((len(tree.point), 6), np.nan), _leaves(tree)

    def fill(self, index: IntArray) -> None:
        """Compute the missing covariances of the points ``index (N,)``; −1 entries are ignored."""
        _fill(self.tree, self.neighbours, self._leaf_of, index, self.value, True)


@njit(cache=True, error_model="numpy")
def normals(covariances):
    """Unit normals ``(N, 3)``, the smallest eigenvectors of ``covariances (N, 6)``; their sign is arbitrary."""
    result = np.empty((len(covariances), 3))
    for i in range(len(covariances)):
        c = covariances[i]
        _, result[i, 0], result[i, 1], result[i, 2] = eigen(c[0], c[1], c[2], c[3], c[4], c[5])[0]
    return result


@njit(cache=True, error_model="numpy")
def _fill(tree, k_most, leaf_of, index, value, plane):
    """Write the missing covariances of the leaves of the points ``index (N,)``, `regularised` if ``plane``."""
    n = len(tree.point)
    xyz_distance = np.empty(n + 1), np.empty(n + 1), np.empty(n + 1), np.empty(n + 1)
    stack = np.empty(64, np.int64), np.empty((64, 4))
    scratch = np.empty(k_most, np.int64), np.empty(k_most), np.empty(n + 1, np.int64), xyz_distance, stack
    for i in index:
        if i < 0 or not np.isnan(value[i, 0]):
            continue
        leaf = leaf_of[i]
        _covariances_of_leaf(tree, leaf, k_most, value, scratch)
        if plane:
            _regularise(value[tree.left[leaf] : tree.right[leaf]])


@njit(cache=True, error_model="numpy")
def _regularise(covariances):
    for c in covariances:
        _, x, y, z = eigen(c[0], c[1], c[2], c[3], c[4], c[5])[0]
        scale = PLANE_THICKNESS - 1.0
        tx, ty, tz = scale * x, scale * y, scale * z
        c[0], c[1], c[2] = tx * x + 1.0, tx * y, tx * z
        c[3], c[4], c[5] = ty * y + 1.0, ty * z, tz * z + 1.0


@njit(cache=True)
def _leaves(tree):
    """Index of the leaf of each point ``(N,)``."""
    leaf_of = np.empty(len(tree.point), np.int64)
    for node in range(len(tree.axis)):
        if tree.axis[node] < 0:
            leaf_of[tree.left[node] : tree.right[node]] = node
    return leaf_of


@njit(cache=True, error_model="numpy")
def _covariances_of_leaf(tree, node, k_most, result, scratch):
    """Covariances of all points of a leaf by one search of the tree.

    Let the k nearest neighbours of the leaf's centre c lie within r of c, and the points of the leaf within a of c.
    Then the k nearest neighbours of each of them lie within r + 2a of c, and are selected among those candidates.
    """
    found, nearest, chosen, (xs, ys, zs, distance), (node_of, node_distance) = scratch
    point, first, last = tree.point, tree.left[node], tree.right[node]
    cx = cy = cz = 0.0
    for i in range(first, last):
        cx += point[i, 0]
        cy += point[i, 1]
        cz += point[i, 2]
    cx, cy, cz = cx / (last - first), cy / (last - first), cz / (last - first)
    leaf_radius2 = 0.0
    for i in range(first, last):
        dx, dy, dz = point[i, 0] - cx, point[i, 1] - cy, point[i, 2] - cz
        leaf_radius2 = max(leaf_radius2, dx * dx + dy * dy + dz * dz)
    nearest_k(tree, cx, cy, cz, k_most, np.inf, found, nearest, node_of, node_distance)
    limit = (math.sqrt(nearest[k_most - 1]) + 2.0 * math.sqrt(leaf_radius2)) ** 2 * (1.0 + 1e-12)
    count = within_radius(tree, cx, cy, cz, limit, xs, ys, zs, node_of, node_distance)
    bound = nearest[k_most - 1]
    for i in range(first, last):
        x, y, z = point[i, 0], point[i, 1], point[i, 2]
        for c in range(count):
            dx, dy, dz = xs[c] - x, ys[c] - y, zs[c] - z
            distance[c] = dx * dx + dy * dy + dz * dz
        bound = _smallest_k(distance, count, k_most, bound, limit, chosen)
        m = NO_MOMENTS
        for k in range(k_most):
            c = chosen[k]
            m = add_point(m, 1.0, xs[c] - x, ys[c] - y, zs[c] - z)
        result[i, :] = covariance(m)


@njit(cache=True, error_model="numpy")
def _smallest_k(distance, n, k, initial_bound, limit, chosen):
    """Write the indices of the k smallest of n distances to ``chosen (n + 1,)``; returns an upper bound of them.

    The bound is found by regula falsi on the number of distances below it, which grows about linearly with squared
    distance on a surface. Counting vectorises; sorting does not. Ties at the k-th place are broken by index.
    """
    low, high, count_low, count_high = 0.0, 4.0 * limit, 0, n  # fewer than k lie within low, at least k within high
    bound = high
    if n > k:
        bound = initial_bound
        for iteration in range(60):
            count = 0
            for c in range(n):
                count += distance[c] <= bound
            if count == k:
                break
            if count < k:
                low, count_low = bound, count
            else:
                high, count_high = bound, count
            if iteration % 3 == 2:
                bound = 0.5 * (low + high)
            else:
                bound = low + (high - low) * (k - count_low) / (count_high - count_low)
            if not low < bound < high:
                break
        if count != k:
            bound = high
    size = np.uint64(0)
    for c in range(n):
        chosen[size] = c
        size += np.uint64(distance[c] <= bound)
    if size > k:  # ties: first those that are surely nearer
        size = np.uint64(0)
        for c in range(n):
            chosen[size] = c
            size += np.uint64(distance[c] <= low)
        for c in range(n):
            chosen[size] = c
            size += np.uint64(low < distance[c] <= bound and size < k)
    return bound
