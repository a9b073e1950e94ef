"""Triangles that touch, where rays meet them, and which points they contain: compiled, in float64."""

from typing import NamedTuple

import numpy as np

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray

TOUCH_M = 1e-5
"""Tolerance within which surfaces touch and a ray hits an edge; float32 cannot resolve smaller distances."""


class Triangles(NamedTuple):
    """T triangles in the world frame, metres.

    ``corner (T, 3, 3)``; ``plane (T, 4)``: unit normal n and offset d of n · x = d.
    ``touching[begin[t] : begin[t + 1]]``: triangles that touch, cross or overlap triangle t, descending.
    """

    corner: Array
    plane: Array
    begin: IntArray
    touching: IntArray


def make_triangles(corner: Array) -> Triangles:
    """Triangles with corners ``(T, 3, 3)``, metres, world frame."""
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    plane = np.column_stack([normal, (normal * corner[:, 0]).sum(axis=1)])
    one, other = _touching_pairs(corner, plane).T
    one, other = np.append(one, other), np.append(other, one)
    order = np.lexsort((-other, one))
    begin = np.searchsorted(one[order], np.arange(len(corner) + 1))
    return Triangles(corner, plane, begin, other[order])


@njit(cache=True)
def _touching_pairs(corner, plane):
    """Pairs ``(P, 2)`` of triangles that touch, cross or overlap. Coplanar ones count if their boxes overlap."""
    count, size = len(corner), 0
    low, high = np.empty((count, 3)), np.empty((count, 3))
    for i in range(count):
        for k in range(3):
            low[i, k] = min(corner[i, 0, k], corner[i, 1, k], corner[i, 2, k]) - TOUCH_M
            high[i, k] = max(corner[i, 0, k], corner[i, 1, k], corner[i, 2, k]) + TOUCH_M
    pair = np.empty((1024, 2), np.int64)
    along_z = np.argsort(low[:, 2])  # a triangle can only touch those that begin before it ends; a tower is tall
    for place in range(count):
        i = along_z[place]
        for later in range(place + 1, count):
            j = along_z[later]
            if low[j, 2] > high[i, 2]:
                break
            if (
                low[i, 0] <= high[j, 0] and low[j, 0] <= high[i, 0]
                and low[i, 1] <= high[j, 1] and low[j, 1] <= high[i, 1]
                and (_edge_meets(corner, plane, i, j) or _edge_meets(corner, plane, j, i))
            ):  # fmt: skip
                if size == len(pair):
                    pair = np.concatenate((pair, np.empty_like(pair)))
                pair[size, 0], pair[size, 1] = i, j
                size += 1
    return pair[:size].copy()


@njit(cache=True)
def _edge_meets(corner, plane, i, j):
    """Whether an edge of triangle ``i`` meets triangle ``j``, or the two are coplanar."""
    flat = True
    for k in range(3):
        a, b = corner[i, k], corner[i, (k + 1) % 3]
        from_a, from_b = signed_distance(plane[j], a), signed_distance(plane[j], b)
        flat = flat and abs(from_a) <= TOUCH_M
        if abs(from_a) > TOUCH_M and from_a * from_b > 0.0 and abs(from_b) > TOUCH_M:
            continue
        share = 0.0 if abs(from_a) <= TOUCH_M else min(max(from_a / (from_a - from_b), 0.0), 1.0)
        point = a + share * (b - a)
        if contains(corner, plane, j, point[0], point[1], point[2]):
            return True
    return flat


@njit(cache=True)
def signed_distance(plane, point):
    """Signed distance of a point to a plane."""
    return plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] - plane[3]


@njit(cache=True)
def ray_distance(ray, corner, plane):
    """Distance along a ``ray (6,)`` to a plane, clamped to the range of the triangle's corners, for grazing rays."""
    nearest, farthest = np.inf, -np.inf
    for k in range(3):
        along = 0.0
        for i in range(3):
            along += (corner[k, i] - ray[i]) * ray[3 + i]
        nearest, farthest = min(nearest, along), max(farthest, along)
    slope = plane[0] * ray[3] + plane[1] * ray[4] + plane[2] * ray[5]
    if slope == 0.0:
        return nearest
    return min(max(-signed_distance(plane, ray) / slope, nearest), farthest)


@njit(cache=True)
def contains(corner, plane, t, x, y, z):
    """Whether a point in the plane of triangle ``t`` is inside it, or outside by at most `TOUCH_M`. The corners run
    anticlockwise about the normal."""
    for k in range(3):
        n = (k + 1) % 3
        ax, ay, az = corner[t, k, 0], corner[t, k, 1], corner[t, k, 2]
        ex, ey, ez = corner[t, n, 0] - ax, corner[t, n, 1] - ay, corner[t, n, 2] - az
        px, py, pz = x - ax, y - ay, z - az
        left = (ey * pz - ez * py) * plane[t, 0] + (ez * px - ex * pz) * plane[t, 1] + (ex * py - ey * px) * plane[t, 2]
        if left < 0.0 and left * left > TOUCH_M * TOUCH_M * (ex * ex + ey * ey + ez * ez):
            return False
    return True
