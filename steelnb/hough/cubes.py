"""Points sorted into cubes, for searches along lines in time proportional to the points near the line."""

from typing import NamedTuple

import numpy as np
from numba import njit

from steelnb.points.voxel_kernels import REACH, find, pack, rehash
from steelnb.types import Array, IntArray

EDGE = 1.25
"""Edge of a cube in search distances. A point within the distance of a line lies at most √(¼ + 1/EDGE²) < 1 edge from
the nearest step of a walk, so the 27 cubes around the step hold it."""


class Cubes(NamedTuple):
    """N points in C cubes of edge ``edge``, counted from ``low (3,)``; no point lies beyond ``high (3,)``.

    ``order (N,)``: the points, cube by cube; ``px, py, pz (N,)``: their coordinates in that order; ``first (C + 1,)``:
    where each cube begins. ``key`` and ``slot`` are a hash table of the cubes (`steelnb.points.voxel_kernels`).
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


def sort_into_cubes(points: Array, distance: float) -> Cubes:
    """Cubes of finite points ``(N, 3)`` for searches (`walk`) as far as ``distance`` from a line, both in metres."""
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(3), np.zeros(3))
    edge = max(EDGE * distance, 2.0 * float((high - low).max()) / REACH)  # so that the cubes can be numbered
    cube = np.floor((points - low) / edge).astype(np.int64)
    name = pack(cube[:, 0], cube[:, 1], cube[:, 2])
    order = np.argsort(name, kind="stable")
    first = np.append(np.flatnonzero(np.diff(name[order], prepend=-1)), len(points))
    size = 4
    while size < 2 * len(first):
        size *= 2
    key, slot = np.full(size, -1, dtype=np.int64), np.zeros(size, dtype=np.int64)
    rehash(name[order[first[:-1]]], key, slot)
    px, py, pz = np.ascontiguousarray(points[order].T)
    return Cubes(low, high, edge, order, px, py, pz, first, key, slot)


@njit(cache=True)
def walk(cubes, ax, ay, az, ux, uy, uz, begin, end, seen, mark, near):
    """Write the places of the points near a line from ``begin`` to ``end`` on it, once each; return their number.

    All points within the distance of `sort_into_cubes` of that part are written, ends included, and others farther
    away. ``seen (C,)`` holds the ``mark`` of the last walk through each cube.
    """
    # No further than the box of the points, else a line that is long beside the cubes takes forever.
    a, u = (ax, ay, az), (ux, uy, uz)
    for c in range(3):
        low, high = cubes.low[c] - cubes.edge - a[c], cubes.high[c] + cubes.edge - a[c]
        if abs(u[c]) > 1e-12:
            one, other = low / u[c], high / u[c]
            begin, end = max(begin, min(one, other)), min(end, max(one, other))
        elif low > 0.0 or high < 0.0:
            return 0
    if begin > end:
        return 0
    n = 0
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
                    if cube < 0 or seen[cube] == mark:
                        continue
                    seen[cube] = mark
                    for place in range(cubes.first[cube], cubes.first[cube + 1]):
                        near[n] = place
                        n += 1
    return n
