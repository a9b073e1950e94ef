"""Covariances and normals of a cloud, from the nearest neighbours of each point."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steelnb.points.kdtree import KdTree, build_kdtree, nearest_k, within
from steelnb.points.moments import NO_MOMENTS, add_point, covariance, eigen
from steelnb.types import Array, IntArray

UPPER = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]
"""Rows and columns of upper triangles in the order in which covariances are stored: xx xy xz yy yz zz."""
PLANE_THICKNESS = 1e-3


def neighbour_covariances(points: Array, neighbours: int = 20, tree: KdTree | None = None) -> Array:
    """Covariance of each point's nearest ``neighbours`` points, itself included: upper triangles ``(N, 6)``, m².

    ``points (N, 3)`` are finite; ``tree`` is theirs, where it is at hand: give ``tree.point`` itself as points to have
    the covariances in the order of the tree. Of points that are equally far any may be the last neighbour.
    """
    tree = tree or build_kdtree(points)
    sorted_ = np.empty((len(tree.point), 6))
    if len(sorted_):
        _covariances(tree, min(neighbours, len(sorted_)), sorted_)
    if points is tree.point:
        return sorted_
    result = np.empty_like(sorted_)
    result[tree.order] = sorted_
    return result


def regularised(covariances: Array, thickness: float = PLANE_THICKNESS) -> Array:
    """Plane-shaped covariances ``(N, 6)`` with the normals n of ``covariances (N, 6)``: I − (1 − thickness) n nᵀ.

    Source: Segal, Haehnel, Thrun, "Generalized-ICP" (RSS 2009), section III.
    """
    normal = normals(covariances)
    result = (thickness - 1.0) * normal[:, UPPER[0]] * normal[:, UPPER[1]]
    result[:, [0, 3, 5]] += 1.0
    return result


@dataclass(frozen=True)
class PlaneCovariances:
    """`regularised` covariances of the points of a tree, each computed when a registration first asks for it.

    ``value (M, 6)``, in the order of the tree, is NaN until then: a scan meets few of the points of a map.
    """

    tree: KdTree
    neighbours: int
    value: Array
    leaf_of: IntArray
    done: NDArray[np.bool_]

    @classmethod
    def of(cls, tree: KdTree, neighbours: int) -> "PlaneCovariances":
        """Covariances of the nearest ``neighbours`` points around each, itself included."""
        n = len(tree.point)
        return cls(tree, min(neighbours, n), np.full((n, 6), np.nan), _leaves(tree), np.zeros(len(tree.axis), bool))

    def fill(self, asked: IntArray) -> None:
        """Compute those of the points ``asked (N,)`` that are missing; −1 asks for none."""
        _regularise_where_asked(self.tree, self.neighbours, self.leaf_of, asked, self.done, PLANE_THICKNESS, self.value)


def normals(covariances: Array) -> Array:
    """Unit vectors ``(N, 3)`` of the least spread of ``covariances (N, 6)``; their sign is arbitrary."""
    result = np.empty((len(covariances), 3))
    _normals(np.ascontiguousarray(covariances), result)
    return result


@njit(cache=True, error_model="numpy")
def _covariances(tree, k_most, result):
    space = _scratch(len(tree.point), k_most)
    for node in range(len(tree.axis)):
        if tree.axis[node] < 0:
            _covariances_of_leaf(tree, node, k_most, result, space)


@njit(cache=True, error_model="numpy")
def _regularise_where_asked(tree, k_most, leaf_of, asked, done, thickness, result):
    """`regularised` covariances of the points ``asked (N,)``, −1 for none, and of those that share their leaves."""
    space = _scratch(len(tree.point), k_most)
    for i in asked:
        if i < 0 or done[leaf_of[i]]:
            continue
        leaf = leaf_of[i]
        done[leaf] = True
        _covariances_of_leaf(tree, leaf, k_most, result, space)
        for j in range(tree.left[leaf], tree.right[leaf]):
            _, x, y, z = eigen(result[j, 0], result[j, 1], result[j, 2], result[j, 3], result[j, 4], result[j, 5])[0]
            tx, ty, tz = (thickness - 1.0) * x, (thickness - 1.0) * y, (thickness - 1.0) * z
            result[j, 0], result[j, 1], result[j, 2] = tx * x + 1.0, tx * y, tx * z
            result[j, 3], result[j, 4], result[j, 5] = ty * y + 1.0, ty * z, tz * z + 1.0


@njit(cache=True)
def _leaves(tree):
    """The leaf of each point ``(N,)``."""
    leaf_of = np.empty(len(tree.point), np.int64)
    for node in range(len(tree.axis)):
        if tree.axis[node] < 0:
            leaf_of[tree.left[node] : tree.right[node]] = node
    return leaf_of


@njit(cache=True)
def _scratch(n, k_most):
    xyz_distance = np.empty(n + 1), np.empty(n + 1), np.empty(n + 1), np.empty(n + 1)
    stack = np.empty(64, np.int64), np.empty((64, 4))
    return np.empty(k_most, np.int64), np.empty(k_most), np.empty(n + 1, np.int64), xyz_distance, stack


@njit(cache=True, error_model="numpy")
def _covariances_of_leaf(tree, node, k_most, result, space):
    """One search of the tree serves all points of a leaf.

    If the k nearest of a leaf's centre c lie within r, and its points within a of c, then the k nearest of each of
    its points lie within r + 2a of c. Among those candidates each point's k smallest distances are selected.
    """
    found, nearest, chosen, (xs, ys, zs, distance), (node_of, reach) = space
    point, first, last = tree.point, tree.left[node], tree.right[node]
    if first == last:
        return
    cx = cy = cz = 0.0
    for i in range(first, last):
        cx += point[i, 0]
        cy += point[i, 1]
        cz += point[i, 2]
    cx, cy, cz = cx / (last - first), cy / (last - first), cz / (last - first)
    apart = 0.0
    for i in range(first, last):
        dx, dy, dz = point[i, 0] - cx, point[i, 1] - cy, point[i, 2] - cz
        apart = max(apart, dx * dx + dy * dy + dz * dz)
    nearest_k(tree, cx, cy, cz, k_most, np.inf, found, nearest, node_of, reach)
    limit = (math.sqrt(nearest[k_most - 1]) + 2.0 * math.sqrt(apart)) ** 2 * (1.0 + 1e-12)
    count = within(tree, cx, cy, cz, limit, xs, ys, zs, node_of, reach)
    guess = nearest[k_most - 1]
    for i in range(first, last):
        x, y, z = point[i, 0], point[i, 1], point[i, 2]
        for c in range(count):
            dx, dy, dz = xs[c] - x, ys[c] - y, zs[c] - z
            distance[c] = dx * dx + dy * dy + dz * dz
        guess = _choose(distance, count, k_most, guess, limit, chosen)
        m = NO_MOMENTS
        for k in range(k_most):
            c = chosen[k]
            m = add_point(m, 1.0, xs[c] - x, ys[c] - y, zs[c] - z)
        result[i, :] = covariance(m)


@njit(cache=True, error_model="numpy")
def _choose(distance, n, k, guess, limit, chosen):
    """Write the positions of the k smallest of n distances to ``chosen (n + 1,)``; returns a bound that holds them.

    Counting those below a threshold runs at several a cycle; the threshold is found by the rule of false position,
    as counts grow about evenly with squared distance on a surface. Equals at the k-th place are taken as they come.
    """
    low, high, fewer, more = 0.0, 4.0 * limit, 0, n  # fewer than k lie within low, at least k within high
    bound = high
    if n > k:
        bound = guess
        for turn in range(60):
            count = 0
            for c in range(n):
                count += distance[c] <= bound
            if count == k:
                break
            if count < k:
                low, fewer = bound, count
            else:
                high, more = bound, count
            even = turn % 3 == 2
            bound = 0.5 * (low + high) if even else low + (high - low) * (k - fewer) / (more - fewer)
            if not low < bound < high:
                break
        if count != k:
            bound = high
    taken = np.uint64(0)
    for c in range(n):
        chosen[taken] = c
        taken += np.uint64(distance[c] <= bound)
    if taken > k:  # equals: first those that are surely nearer
        taken = np.uint64(0)
        for c in range(n):
            chosen[taken] = c
            taken += np.uint64(distance[c] <= low)
        for c in range(n):
            chosen[taken] = c
            taken += np.uint64(low < distance[c] <= bound and taken < k)
    return bound


@njit(cache=True, error_model="numpy")
def _normals(covariances, result):
    for i in range(len(covariances)):
        a = covariances[i]
        least, _, _ = eigen(a[0], a[1], a[2], a[3], a[4], a[5])
        result[i, 0], result[i, 1], result[i, 2] = least[1], least[2], least[3]
