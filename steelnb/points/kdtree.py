"""A k-d tree in arrays, compiled: nearest neighbours of points that move a little between queries."""

from typing import NamedTuple

import numpy as np
from numba import njit

from steelnb.types import Array, IntArray

LEAF = 10


class KdTree(NamedTuple):
    """``point (N, 3)`` sorted by leaf, ``order (N,)`` of each in the cloud it was built of; nodes: ``axis`` (−1 for a
    leaf), ``low`` and ``high`` (largest coordinate left, smallest right), ``left`` and ``right`` (children or points).
    """

    point: Array
    order: IntArray
    axis: IntArray
    low: Array
    high: Array
    left: IntArray
    right: IntArray


def build_kdtree(points: Array) -> KdTree:
    """Tree over finite points ``(N, 3)``: split at the median of the longest side, leaves of up to ten points."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    return KdTree(*_build(points))


@njit(cache=True)
def _build(points):
    n = len(points)
    index = np.arange(n)
    most = max(1, 4 * n // LEAF + 4)
    axis = np.full(most, -1, np.int64)
    low, high = np.zeros(most), np.zeros(most)
    left, right = np.zeros(most, np.int64), np.zeros(most, np.int64)
    stack = np.zeros((64, 3), np.int64)  # node, first, last
    stack[0, 2] = n
    depth, nodes = 1, 1
    while depth:
        depth -= 1
        node, first, last = stack[depth]
        if last - first <= LEAF:
            left[node], right[node] = first, last
            continue
        longest, side = -1.0, 0
        for d in range(3):
            least, most_ = np.inf, -np.inf
            for k in range(first, last):
                value = points[index[k], d]
                least, most_ = min(least, value), max(most_, value)
            if most_ - least > longest:
                longest, side = most_ - least, d
        middle = (first + last) // 2
        _select(points[:, side], index, first, last - 1, middle)
        below = -np.inf
        for k in range(first, middle):
            below = max(below, points[index[k], side])
        axis[node], low[node], high[node] = side, below, points[index[middle], side]
        left[node], right[node] = nodes, nodes + 1
        stack[depth] = (nodes + 1, middle, last)
        stack[depth + 1] = (nodes, first, middle)
        depth += 2
        nodes += 2
    return points[index], index, axis[:nodes], low[:nodes], high[:nodes], left[:nodes], right[:nodes]


@njit(cache=True)
def _select(value, index, first, last, k):
    """Hoare's selection: put the k-th smallest at k, smaller ones before it and larger ones behind."""
    while first < last:
        pivot = value[index[(first + last) // 2]]
        i, j = first, last
        while i <= j:
            while value[index[i]] < pivot:
                i += 1
            while value[index[j]] > pivot:
                j -= 1
            if i <= j:
                index[i], index[j] = index[j], index[i]
                i += 1
                j -= 1
        if k <= j:
            last = j
        elif k >= i:
            first = i
        else:
            return


@njit(cache=True)
def next_leaf(tree, x, y, z, limit, depth, node_of, reach):
    """(leaf, depth of the stack left) of the next leaf that may hold points within √limit of (x, y, z); leaf −1: none.

    A search begins with ``depth`` 1 and zeros in the first rows of the stack: ``node_of (64,)``, the nodes left to
    visit, and ``reach (64, 4)``, the squared distance to the box of each and its parts along x, y and z. Source: Arya
    and Mount, "Algorithms for fast vector quantization", 1993 (incremental distance).
    """
    axis, low, high = tree.axis, tree.low, tree.high
    while depth:
        depth -= 1
        node, far = node_of[depth], reach[depth, 0]
        if far > limit:
            continue
        fx, fy, fz = reach[depth, 1], reach[depth, 2], reach[depth, 3]
        while axis[node] >= 0:
            side = axis[node]
            value = x if side == 0 else (y if side == 1 else z)
            old = fx if side == 0 else (fy if side == 1 else fz)
            if 2.0 * value < low[node] + high[node]:
                near_node, far_node, gap = tree.left[node], tree.right[node], high[node] - value
            else:
                near_node, far_node, gap = tree.right[node], tree.left[node], value - low[node]
            gap2 = gap * gap
            total = far - old + gap2
            if total <= limit:
                node_of[depth], reach[depth, 0] = far_node, total
                reach[depth, 1] = gap2 if side == 0 else fx
                reach[depth, 2] = gap2 if side == 1 else fy
                reach[depth, 3] = gap2 if side == 2 else fz
                depth += 1
            node = near_node
        return node, depth
    return -1, 0


@njit(cache=True)
def nearest_k(tree, x, y, z, k_most, limit, found, distance, node_of, reach):
    """Write the positions in ``tree.point`` of the nearest points to ``found``, squared distances to ``distance``.

    Nearest first, only those within √limit; returns their number. The nearer a limit that surely holds enough of them,
    the less is searched. ``node_of (64,)`` and ``reach (64, 4)`` are scratch.
    """
    point = tree.point
    node_of[0], reach[0, :] = 0, 0.0
    count, worst = 0, limit
    leaf, depth = next_leaf(tree, x, y, z, worst, 1, node_of, reach)
    while leaf >= 0:
        for k in range(tree.left[leaf], tree.right[leaf]):
            dx, dy, dz = point[k, 0] - x, point[k, 1] - y, point[k, 2] - z
            d = dx * dx + dy * dy + dz * dz
            if d < worst:
                place = min(count, k_most - 1)
                while place > 0 and distance[place - 1] > d:
                    distance[place], found[place] = distance[place - 1], found[place - 1]
                    place -= 1
                distance[place], found[place] = d, k
                count = min(count + 1, k_most)
                if count == k_most:
                    worst = distance[count - 1]
        leaf, depth = next_leaf(tree, x, y, z, worst, depth, node_of, reach)
    return count


@njit(cache=True)
def within(tree, x, y, z, limit, found_x, found_y, found_z, node_of, reach):
    """Write the coordinates of all points within √limit to ``found_x (N + 1,)`` and so on; returns their number.

    ``node_of (64,)`` and ``reach (64, 4)`` are scratch.
    """
    point = tree.point
    node_of[0], reach[0, :] = 0, 0.0
    count = np.uint64(0)
    leaf, depth = next_leaf(tree, x, y, z, limit, 1, node_of, reach)
    while leaf >= 0:
        for k in range(tree.left[leaf], tree.right[leaf]):
            dx, dy, dz = point[k, 0] - x, point[k, 1] - y, point[k, 2] - z
            found_x[count], found_y[count], found_z[count] = point[k, 0], point[k, 1], point[k, 2]
            count += np.uint64(dx * dx + dy * dy + dz * dz <= limit)  # written first, kept if near: no branch to guess
        leaf, depth = next_leaf(tree, x, y, z, limit, depth, node_of, reach)
    return np.int64(count)
