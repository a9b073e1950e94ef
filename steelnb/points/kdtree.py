"""A compiled k-d tree for nearest-neighbour and radius search, and the voxels around each voxel of a map.

The latter are found by one sweep through the sorted keys of all (`advance`, `gather`): a hash table would be asked
hundreds of times a voxel, mostly for voxels that do not exist.
"""

from typing import NamedTuple

import numpy as np

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray

LEAF = 10
"""Largest number of points in a leaf."""


class KdTree(NamedTuple):
    """``point (N, 3)``: the points sorted by leaf; ``order (N,)``: the index of each in the original cloud.

    Per node: ``axis`` of its split, −1 for a leaf; ``low`` and ``high``, the largest coordinate left of the split and
    the smallest right of it; ``left`` and ``right``, its children, or the range of points in a leaf.
    """

    point: Array
    order: IntArray
    axis: IntArray
    low: Array
    high: Array
    left: IntArray
    right: IntArray


def build_kdtree(points: Array) -> KdTree:
    """Tree over finite points ``(N, 3)``, split at the median of the longest side down to `LEAF` points."""
    return KdTree(*_build(np.ascontiguousarray(points, dtype=np.float64)))


@njit(cache=True)
def _build(points):
    n = len(points)
    point, order = points.copy(), np.arange(n)  # sorted together: through indices it takes 16 % longer
    capacity = max(1, 4 * n // LEAF + 4)
    axis = np.full(capacity, -1, np.int64)
    low, high = np.zeros(capacity), np.zeros(capacity)
    left, right = np.zeros(capacity, np.int64), np.zeros(capacity, np.int64)
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
            lowest, highest = np.inf, -np.inf
            for k in range(first, last):
                lowest, highest = min(lowest, point[k, d]), max(highest, point[k, d])
            if highest - lowest > longest:
                longest, side = highest - lowest, d
        middle = (first + last) // 2
        _select(point, order, side, first, last - 1, middle)
        below = -np.inf
        for k in range(first, middle):
            below = max(below, point[k, side])
        axis[node], low[node], high[node] = side, below, point[middle, side]
        left[node], right[node] = nodes, nodes + 1
        stack[depth] = (nodes + 1, middle, last)
        stack[depth + 1] = (nodes, first, middle)
        depth += 2
        nodes += 2
    return point, order, axis[:nodes], low[:nodes], high[:nodes], left[:nodes], right[:nodes]


@njit(cache=True)
def _select(point, order, side, first, last, k):
    """Quickselect (Hoare 1961): move the k-th smallest to place k, smaller ones before it and larger ones after it."""
    while first < last:
        pivot = point[(first + last) // 2, side]
        i, j = first, last
        while i <= j:
            while point[i, side] < pivot:
                i += 1
            while point[j, side] > pivot:
                j -= 1
            if i <= j:
                for d in range(3):
                    point[i, d], point[j, d] = point[j, d], point[i, d]
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if k <= j:
            last = j
        elif k >= i:
            first = i
        else:
            return


@njit(cache=True)
def next_leaf(tree, x, y, z, limit, depth, node_of, node_distance):
    """Next leaf that may hold points within √limit of (x, y, z), and the remaining depth of the stack; leaf −1 if none.

    The stack of nodes to visit is ``node_of (64,)``, and ``node_distance (64, 4)`` with the squared distance to the box
    of each node and its parts along x, y and z. A search starts with ``depth`` 1 and zeros in their first rows. Source:
    Arya and Mount, "Algorithms for fast vector quantization", 1993 (incremental distance).
    """
    axis, low, high = tree.axis, tree.low, tree.high
    while depth:
        depth -= 1
        node, far = node_of[depth], node_distance[depth, 0]
        if far > limit:
            continue
        fx, fy, fz = node_distance[depth, 1], node_distance[depth, 2], node_distance[depth, 3]
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
                node_of[depth], node_distance[depth, 0] = far_node, total
                node_distance[depth, 1] = gap2 if side == 0 else fx
                node_distance[depth, 2] = gap2 if side == 1 else fy
                node_distance[depth, 3] = gap2 if side == 2 else fz
                depth += 1
            node = near_node
        return node, depth
    return -1, 0


@njit(cache=True)
def nearest_k(tree, x, y, z, k_most, limit, found, distance, node_of, node_distance):
    """Find the nearest points: indices in ``tree.point`` go to ``found``, squared distances to ``distance``.

    Up to ``k_most`` points within √limit, nearest first; returns their number. A tight limit makes the search faster.
    ``node_of (64,)`` and ``node_distance (64, 4)`` are buffers.
    """
    point = tree.point
    node_of[0], node_distance[0, :] = 0, 0.0
    count, worst = 0, limit
    leaf, depth = next_leaf(tree, x, y, z, worst, 1, node_of, node_distance)
    while leaf >= 0:
        for k in range(tree.left[leaf], tree.right[leaf]):
            dx, dy, dz = point[k, 0] - x, point[k, 1] - y, point[k, 2] - z
            d = dx * dx + dy * dy + dz * dz
            if d < worst:
                rank = min(count, k_most - 1)
                while rank > 0 and distance[rank - 1] > d:
                    distance[rank], found[rank] = distance[rank - 1], found[rank - 1]
                    rank -= 1
                distance[rank], found[rank] = d, k
                count = min(count + 1, k_most)
                if count == k_most:
                    worst = distance[count - 1]
        leaf, depth = next_leaf(tree, x, y, z, worst, depth, node_of, node_distance)
    return count


@njit(cache=True)
def within_radius(tree, x, y, z, limit, found_x, found_y, found_z, node_of, node_distance):
    """Write the coordinates of all points within √limit to ``found_x``, ``found_y``, ``found_z (N + 1,)``.

    Returns their number. ``node_of (64,)`` and ``node_distance (64, 4)`` are buffers.
    """
    point = tree.point
    node_of[0], node_distance[0, :] = 0, 0.0
    count = np.uint64(0)
    leaf, depth = next_leaf(tree, x, y, z, limit, 1, node_of, node_distance)
    while leaf >= 0:
        for k in range(tree.left[leaf], tree.right[leaf]):
            dx, dy, dz = point[k, 0] - x, point[k, 1] - y, point[k, 2] - z
            found_x[count], found_y[count], found_z[count] = point[k, 0], point[k, 1], point[k, 2]
            count += np.uint64(dx * dx + dy * dy + dz * dz <= limit)  # branch-free, which is faster
        leaf, depth = next_leaf(tree, x, y, z, limit, depth, node_of, node_distance)
    return np.int64(count)


class Columns(NamedTuple):
    """Offsets of keys (`voxel_map.pack`) in C columns along z: ``low (C,)`` and ``high (C,)`` of each, where it
    begins in ``place`` ``(C,)``, and ``place (K,)`` of each offset in the order of `offsets_within`."""

    low: IntArray
    high: IntArray
    begin: IntArray
    place: IntArray


def columns_of(offsets: IntArray) -> Columns:
    """The columns of the ``offsets (K,)`` of a ball."""
    place = np.argsort(offsets, kind="stable")
    ordered = offsets[place]
    begin = np.flatnonzero(np.diff(ordered, prepend=ordered[0] - 2) != 1)
    return Columns(ordered[begin], ordered[np.append(begin[1:], len(ordered)) - 1], begin, place)


@njit(cache=True, nogil=True)
def advance(key, n, columns, first, last):
    """Move the ranges ``first (C,)`` and ``last (C,)`` of the sorted keys in each column on to the voxel ``n``, from
    that before or from 0; returns the number of voxels in them."""
    count = 0
    for c in range(len(first)):
        low, high = key[n] + columns.low[c], key[n] + columns.high[c]
        begin = first[c]
        while begin < len(key) and key[begin] < low:
            begin += 1
        end = max(begin, last[c])
        while end < len(key) and key[end] <= high:
            end += 1
        first[c], last[c] = begin, end
        count += end - begin
    return count


@njit(cache=True, nogil=True)
def gather(key, n, columns, first, last, at, found):
    """Write the voxels in the ranges to ``found (K,)``, in the order of `offsets_within`; returns their number. The
    buffer ``at (K,)`` holds −1, and does so again on return."""
    for c in range(len(first)):
        base = columns.begin[c] - key[n] - columns.low[c]
        for k in range(first[c], last[c]):
            at[columns.place[base + key[k]]] = k
    count = 0
    for k in range(len(at)):
        if at[k] >= 0:
            found[count] = at[k]
            count += 1
            at[k] = -1
    return count
