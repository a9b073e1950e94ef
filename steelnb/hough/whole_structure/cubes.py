"""Points sorted into cubes, to find the points near a line in time proportional to their number."""

from typing import NamedTuple

import numpy as np

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray
from steelnb.points.voxel_kernels import REACH, find, hash_table, pack

EDGE = 1.25
"""Edge of a cube in search distances. A point within the search distance of a line is at most √(¼ + 1/EDGE²) < 1 edge
from the nearest step of a walk, so it is in one of the 27 cubes around that step."""


class Cubes(NamedTuple):
    """N points in C cubes of edge ``edge``, metres. ``low (3,)`` and ``high (3,)`` are their bounding box.

    ``order (N,)``: indices of the points, sorted by cube; ``px, py, pz (N,)``: their coordinates in that order;
    ``first (C + 1,)``: where each cube begins in it. ``key`` and ``slot`` are the hash table of the cubes
    (`steelnb.points.voxel_kernels`).
    """

    low: Array
    high: Array
    edge: float
    order: IntArray
    px: Array
    py: Array
    pz: Array
    first: IntArray
    key: IntArray
    slot: IntArray


class Line(NamedTuple):
    """The line a + t u, metres, with the unit direction u, from t = ``low`` to t = ``high``. Kernels hold it in
    registers."""

    ax: float
    ay: float
    az: float
    ux: float
    uy: float
    uz: float
    low: float
    high: float


def sort_into_cubes(points: Array, distance: float) -> Cubes:
    """Sort finite points ``(N, 3)`` for searches (`walk`) within ``distance`` of a line, both in metres."""
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(3), np.zeros(3))
    edge = max(EDGE * distance, 2.0 * float((high - low).max()) / REACH)  # few enough for `pack`
    cube = np.floor((points - low) / edge).astype(np.int64)
    number = pack(cube[:, 0], cube[:, 1], cube[:, 2])
    order = np.argsort(number, kind="stable")
    first = np.append(np.flatnonzero(np.diff(number[order], prepend=-1)), len(points))
    key, slot = hash_table(number[order[first[:-1]]], len(first))
    px, py, pz = np.ascontiguousarray(points[order].T)
    return Cubes(low, high, edge, order, px, py, pz, first, key, slot)


@njit(cache=True)
def walk(cubes, line, visited, near):
    """Write the indices of the points near a `Line` to ``near``, once each; returns their number.

    All points within the distance of `sort_into_cubes` are written, and some that are farther away. ``visited
    (C + 1,)`` starts with zeros. It holds the number of the last walk through each cube and, as its last entry, the
    number of walks.
    """
    ax, ay, az, ux, uy, uz, begin, end = line
    # Clip the line to the bounding box, so that the time does not depend on its length.
    a, u = (ax, ay, az), (ux, uy, uz)
    for c in range(3):
        low, high = cubes.low[c] - cubes.edge - a[c], cubes.high[c] + cubes.edge - a[c]
        if abs(u[c]) > 1e-12:
            t0, t1 = low / u[c], high / u[c]
            begin, end = max(begin, min(t0, t1)), min(end, max(t0, t1))
        elif low > 0.0 or high < 0.0:
            return 0
    if begin > end:
        return 0
    n = 0
    visited[-1] += 1
    mark = visited[-1]
    steps = int((end - begin) / cubes.edge) + 1
    for k in range(steps + 1):
        t = begin + (end - begin) * k / steps
        i0 = int(np.floor((ax + t * ux - cubes.low[0]) / cubes.edge))
        j0 = int(np.floor((ay + t * uy - cubes.low[1]) / cubes.edge))
        k0 = int(np.floor((az + t * uz - cubes.low[2]) / cubes.edge))
        for i in range(i0 - 1, i0 + 2):
            for j in range(j0 - 1, j0 + 2):
                for m in range(k0 - 1, k0 + 2):
                    cube = find(pack(i, j, m), cubes.key, cubes.slot)
                    if cube < 0 or visited[cube] == mark:
                        continue
                    visited[cube] = mark
                    for index in range(cubes.first[cube], cubes.first[cube + 1]):
                        near[n] = index
                        n += 1
    return n
