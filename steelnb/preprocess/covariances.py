"""The shape of a cloud around each of its points: covariances and normals of the nearest neighbours."""

import math

import numpy as np
from numba import njit

from steelnb.datatypes import Array
from steelnb.preprocess.kdtree import KdTree, build_kdtree, nearest_k, within

UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))
"""Rows and columns of the upper triangle in the order in which covariances are stored: xx xy xz yy yz zz."""


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


def regularised(covariance: Array, eigenvalues: tuple[float, float, float] = (1e-3, 1.0, 1.0)) -> Array:
    """Covariances ``(N, 6)`` with the same axes and these eigenvalues, smallest first: GICP's planes by default.

    Source: Segal, Haehnel, Thrun, "Generalized-ICP" (RSS 2009), section III.
    """
    result = np.empty((len(covariance), 6))
    _regularise(np.ascontiguousarray(covariance), *eigenvalues, result)
    return result


def normals(covariance: Array) -> Array:
    """Unit vectors ``(N, 3)`` of the least spread; their sign is arbitrary."""
    result = np.empty((len(covariance), 3))
    _normals(np.ascontiguousarray(covariance), result)
    return result


def full(covariance: Array) -> Array:
    """Upper triangles ``(N, 6)`` as symmetric matrices ``(N, 3, 3)``."""
    return covariance[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def packed(matrix: Array) -> Array:
    """Symmetric matrices ``(N, 3, 3)`` as upper triangles ``(N, 6)``."""
    return np.ascontiguousarray(matrix[:, UPPER[0], UPPER[1]])


@njit(cache=True, error_model="numpy")
def _covariances(tree, k_most, result):  # type: ignore[no-untyped-def]
    """Leaf by leaf: one search of the tree serves all points of a leaf.

    If the k nearest of a leaf's centre c lie within r, and its points within a of c, then the k nearest of each of
    its points lie within r + 2a of c. Among those candidates each point's k smallest distances are selected.
    """
    point, n = tree.point, len(tree.point)
    node_of, reach = np.empty(64, np.int64), np.empty((64, 4))
    found, nearest = np.empty(k_most, np.int64), np.empty(k_most)
    xs, ys, zs, distance = np.empty(n + 1), np.empty(n + 1), np.empty(n + 1), np.empty(n + 1)
    chosen = np.empty(n + 1, np.int64)
    w = 1.0 / k_most
    for node in range(len(tree.axis)):
        first, last = tree.left[node], tree.right[node]
        if tree.axis[node] >= 0 or first == last:
            continue
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
            mx = my = mz = xx = xy = xz = yy = yz = zz = 0.0
            for k in range(k_most):
                c = chosen[k]
                dx, dy, dz = xs[c] - x, ys[c] - y, zs[c] - z
                mx += dx
                my += dy
                mz += dz
                xx += dx * dx
                xy += dx * dy
                xz += dx * dz
                yy += dy * dy
                yz += dy * dz
                zz += dz * dz
            mx, my, mz = mx * w, my * w, mz * w
            s = result[i]
            s[0], s[1], s[2] = xx * w - mx * mx, xy * w - mx * my, xz * w - mx * mz
            s[3], s[4], s[5] = yy * w - my * my, yz * w - my * mz, zz * w - mz * mz


@njit(cache=True, error_model="numpy")
def _choose(distance, n, k, guess, limit, chosen):  # type: ignore[no-untyped-def]
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
def _turn(app, aqq, apq):  # type: ignore[no-untyped-def]
    """Jacobi's rotation that makes the element pq zero: (tangent, cosine, sine)."""
    if apq == 0.0:
        return 0.0, 1.0, 0.0
    theta = (aqq - app) / (2.0 * apq)
    t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
    c = 1.0 / math.sqrt(t * t + 1.0)
    return t, c, t * c


@njit(cache=True, error_model="numpy")
def eigen(a00, a01, a02, a11, a12, a22):  # type: ignore[no-untyped-def]
    """Eigenvalues and unit eigenvectors of a symmetric 3×3 matrix, ascending, by Jacobi's rotations, without arrays.

    ((value, x, y, z), …). Source: Golub and Van Loan, "Matrix Computations", 8.5.
    """
    x0, y0, z0, x1, y1, z1, x2, y2, z2 = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    for _ in range(12):
        if a01 * a01 + a02 * a02 + a12 * a12 <= 1e-30 * (a00 * a00 + a11 * a11 + a22 * a22):
            break
        t, c, s = _turn(a00, a11, a01)
        a00, a11, a01, a02, a12 = a00 - t * a01, a11 + t * a01, 0.0, c * a02 - s * a12, s * a02 + c * a12
        x0, y0, z0, x1, y1, z1 = (
            c * x0 - s * x1, c * y0 - s * y1, c * z0 - s * z1, s * x0 + c * x1, s * y0 + c * y1, s * z0 + c * z1
        )  # fmt: skip
        t, c, s = _turn(a00, a22, a02)
        a00, a22, a02, a01, a12 = a00 - t * a02, a22 + t * a02, 0.0, c * a01 - s * a12, s * a01 + c * a12
        x0, y0, z0, x2, y2, z2 = (
            c * x0 - s * x2, c * y0 - s * y2, c * z0 - s * z2, s * x0 + c * x2, s * y0 + c * y2, s * z0 + c * z2
        )  # fmt: skip
        t, c, s = _turn(a11, a22, a12)
        a11, a22, a12, a01, a02 = a11 - t * a12, a22 + t * a12, 0.0, c * a01 - s * a02, s * a01 + c * a02
        x1, y1, z1, x2, y2, z2 = (
            c * x1 - s * x2, c * y1 - s * y2, c * z1 - s * z2, s * x1 + c * x2, s * y1 + c * y2, s * z1 + c * z2
        )  # fmt: skip
    one, two, three = (a00, x0, y0, z0), (a11, x1, y1, z1), (a22, x2, y2, z2)
    if one[0] > two[0]:
        one, two = two, one
    if two[0] > three[0]:
        two, three = three, two
    if one[0] > two[0]:
        one, two = two, one
    return one, two, three


@njit(cache=True, error_model="numpy")
def _normals(covariance, result):  # type: ignore[no-untyped-def]
    for i in range(len(covariance)):
        a = covariance[i]
        least, _, _ = eigen(a[0], a[1], a[2], a[3], a[4], a[5])
        result[i, 0], result[i, 1], result[i, 2] = least[1], least[2], least[3]


@njit(cache=True, error_model="numpy")
def _regularise(covariance, small, middle, large, result):  # type: ignore[no-untyped-def]
    for i in range(len(covariance)):
        a = covariance[i]
        (_, x0, y0, z0), (_, x1, y1, z1), (_, x2, y2, z2) = eigen(a[0], a[1], a[2], a[3], a[4], a[5])
        result[i, 0] = small * x0 * x0 + middle * x1 * x1 + large * x2 * x2
        result[i, 1] = small * x0 * y0 + middle * x1 * y1 + large * x2 * y2
        result[i, 2] = small * x0 * z0 + middle * x1 * z1 + large * x2 * z2
        result[i, 3] = small * y0 * y0 + middle * y1 * y1 + large * y2 * y2
        result[i, 4] = small * y0 * z0 + middle * y1 * z1 + large * y2 * z2
        result[i, 5] = small * z0 * z0 + middle * z1 * z1 + large * z2 * z2
