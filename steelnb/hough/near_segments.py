"""What lies near a segment: its points, and how free it stands.

A line through a wall or the ground is as good a line as one along a bar, but has points beside it (`freedom_of`).
Points are sorted into cubes, so that those near a line are found in time proportional to their number (`walk`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray, Segments
from steelnb.points.voxel_map import REACH, find, hash_table, pack

EDGE = 1.25
"""Edge of a cube in search distances. A point within the search distance of a line is at most √(¼ + 1/EDGE²) < 1 edge
from the nearest step of a walk, so it is in one of the 27 cubes around that step."""


class Cubes(NamedTuple):
    """N points in C cubes of edge ``edge``, metres. ``low (3,)`` and ``high (3,)`` are their bounding box.

    ``order (N,)``: indices of the points, sorted by cube; ``px, py, pz (N,)``: their coordinates in that order;
    ``first (C + 1,)``: where each cube begins in it. ``key`` and ``slot`` are the hash table of the cubes
    (`steelnb.points.voxel_map`).
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


FREE_MIN = 0.7
"""Minimum freedom of a bar. On a surface it is about a third. With 0.65 twice as many lines on sparse ground pass, with
0.75 chords near the tips of arms are lost (merged clouds of ``slender`` and ``tapered``, seed 11)."""
ALONG_M, AROUND = 0.1, 3.0
"""Slices in which the freedom is measured, and how many half-widths around the axis."""


def nearest_bar(points: Array, bars: Segments, distance: float | Array, end_margin: float) -> IntArray:
    """Index ``(N,)`` of the bar whose axis is nearest to each point ``(N, 3)``, or −1 if none is within ``distance``,
    one for all bars or one for each ``(B,)``.

    An axis extends ``end_margin`` past the ends of its bar. Both in metres.
    """
    label, distances = np.full(len(points), -1), np.broadcast_to(distance, len(bars)).astype(float)
    if len(points) and len(bars):
        cubes = sort_into_cubes(points, float(distances.max()))
        label[cubes.order] = _nearest(cubes, bars.start, bars.direction, bars.length, distances, end_margin)
    return label


@njit(cache=True)
def _nearest(cubes, start, direction, length, distance, end_margin):
    """The nearest axis of each point, in the order of the cubes."""
    label, least = np.full(len(cubes.px), -1), np.full(len(cubes.px), np.inf)
    visited, near = np.zeros(len(cubes.first), np.int64), np.empty(len(cubes.px), np.int64)
    for k in range(len(length)):
        (sx, sy, sz), (ux, uy, uz) = start[k], direction[k]
        line = Line(sx, sy, sz, ux, uy, uz, -end_margin, length[k] + end_margin)
        for c in range(walk(cubes, line, visited, near)):
            i = near[c]
            x, y, z = cubes.px[i] - sx, cubes.py[i] - sy, cubes.pz[i] - sz
            t = x * ux + y * uy + z * uz
            squared = x * x + y * y + z * z - t * t
            if squared < min(distance[k] * distance[k], least[i]) and line.low <= t <= line.high:
                least[i], label[i] = squared, k
    return label


def freedom_of(points: Array, segments: Segments, half_m: Array, free_min: float = FREE_MIN) -> Array:
    """How free each segment stands ``(S,)``: the share of the ``points (N, 3)`` within `AROUND` half-widths of its axis
    that lie within one, as the median over slices along it; 0 without points.

    Points on other segments do not count if these stand free. On a surface, parallel lines are segments to each other,
    and none is free: so those with ``free_min`` are found with all points first, then more of them without the points
    on those found. ``half_m (S,)``: half-widths, metres.
    """
    if not len(segments):
        return np.zeros(0)
    widest_m, around = float(half_m.max()), []
    owner, cubes = nearest_bar(points, segments, widest_m, 0.0), sort_into_cubes(points, AROUND * widest_m)
    visited, buffer = np.zeros(len(cubes.first), np.int64), np.empty(len(points), np.int64)
    for start, direction, length, half in zip(segments.start, segments.direction, segments.length, half_m, strict=True):
        line = Line(*start.tolist(), *direction.tolist(), 0.0, length)  # type: ignore[call-arg]
        beside = cubes.order[buffer[: walk(cubes, line, visited, buffer)]]
        offset = points[beside] - start
        along = offset @ direction
        distance = np.linalg.norm(offset - along[:, None] * direction, axis=1)
        near = (along >= 0) & (along <= length) & (distance <= AROUND * half)
        around.append((owner[beside[near]], (along[near] / ALONG_M).astype(np.int64), distance[near] <= half))
    freedom, is_free = np.zeros(len(segments)), np.zeros(len(segments) + 1, dtype=bool)  # the last for no segment
    more = ~is_free
    for _ in range(len(segments)):
        for each, (own, slices, inside) in enumerate(around):
            if is_free.any() and not (more[own] & (own != each)).any():
                continue  # none of the points around it have left since
            counts = (own == each) | ~is_free[own]
            total = np.bincount(slices[counts])
            within = np.bincount(slices[counts & inside], minlength=len(total))
            freedom[each] = np.median(within[total > 0] / total[total > 0]) if total.any() else 0.0
        more = np.append(freedom >= free_min, False) & ~is_free
        if not more.any():
            break
        is_free |= more
    return freedom


def within(points: Array, segments: Segments, distance: float, owner: IntArray | None = None) -> NDArray[np.bool_]:
    """Whether each of the points ``(N, 3)`` lies within ``distance`` metres of a segment: ``(N,)``. That of the number
    ``owner (N,)`` does not count."""
    near, owner = np.zeros(len(points), dtype=np.bool_), np.full(len(points), -1) if owner is None else owner
    cubes = sort_into_cubes(np.asarray(points), distance)
    near[cubes.order] = _mark(cubes, segments.start, segments.direction, segments.length, distance, owner[cubes.order])
    return near


@njit(cache=True)
def _mark(cubes, start, direction, length, distance, owner):
    hit = np.zeros(len(cubes.px), dtype=np.bool_)
    visited, near = np.zeros(len(cubes.first), np.int64), np.empty(len(cubes.px), np.int64)
    for k in range(len(length)):
        (sx, sy, sz), (ux, uy, uz) = start[k], direction[k]
        for c in range(walk(cubes, Line(sx, sy, sz, ux, uy, uz, 0.0, length[k]), visited, near)):
            i = near[c]
            x, y, z = cubes.px[i] - sx, cubes.py[i] - sy, cubes.pz[i] - sz
            t = min(max(x * ux + y * uy + z * uz, 0.0), length[k])
            x, y, z = x - t * ux, y - t * uy, z - t * uz
            if owner[i] != k and x * x + y * y + z * z <= distance * distance:
                hit[i] = True
    return hit
