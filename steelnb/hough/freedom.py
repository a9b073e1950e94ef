"""Which segment each point is on, and how free segments stand: a line through a wall or the ground is as good a line as
one along a bar, but has points beside it."""

import numpy as np

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray, Segments
from steelnb.hough.whole_structure.cubes import Line, sort_into_cubes, walk

FREE_MIN = 0.7
"""Minimum freedom of a bar. On a surface it is about a third. With 0.65 twice as many lines on sparse ground pass, with
0.75 chords near the tips of arms are lost (merged clouds of ``slender`` and ``tapered``, seed 11)."""
ALONG_M, REACH = 0.1, 3.0
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
    """How free each segment stands ``(S,)``: the share of the ``points (N, 3)`` within `REACH` half-widths of its axis
    that lie within one, as the median over slices along it; 0 without points.

    Points on other segments do not count if these stand free. On a surface, parallel lines are segments to each other,
    and none is free: so those with ``free_min`` are found with all points first, then more of them without the points
    on those found. ``half_m (S,)``: half-widths, metres.
    """
    if not len(segments):
        return np.zeros(0)
    widest_m, around = float(half_m.max()), []
    owner, cubes = nearest_bar(points, segments, widest_m, 0.0), sort_into_cubes(points, REACH * widest_m)
    visited, buffer = np.zeros(len(cubes.first), np.int64), np.empty(len(points), np.int64)
    for start, direction, length, half in zip(segments.start, segments.direction, segments.length, half_m, strict=True):
        line = Line(*start.tolist(), *direction.tolist(), 0.0, length)  # type: ignore[call-arg]
        beside = cubes.order[buffer[: walk(cubes, line, visited, buffer)]]
        offset = points[beside] - start
        along = offset @ direction
        distance = np.linalg.norm(offset - along[:, None] * direction, axis=1)
        near = (along >= 0) & (along <= length) & (distance <= REACH * half)
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
