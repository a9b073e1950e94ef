"""Which segment each point is on, and how free segments stand: a line through a wall or the ground is as good a line as
one along a bar, but has points beside it."""

import numpy as np

from steelnb.core.types import Array, IntArray, Segments
from steelnb.hough.segments_kernels import assign

FREE_MIN = 0.7
"""Minimum freedom of a bar. On a surface it is about a third. With 0.65 twice as many lines on sparse ground pass, with
0.75 chords near the tips of arms are lost (merged clouds of ``slender`` and ``tapered``, seed 11)."""
ALONG_M, REACH = 0.1, 3.0
"""Slices in which the freedom is measured, and how many half-widths around the axis."""


def nearest_bar(points: Array, bars: Segments, distance: float, end_margin: float) -> IntArray:
    """Index ``(N,)`` of the bar whose axis is nearest to each point ``(N, 3)``, or −1 if none is within ``distance``.

    An axis extends ``end_margin`` past the ends of its bar. Both in metres.
    """
    px, py, pz = np.ascontiguousarray(points.T)
    return np.asarray(assign(px, py, pz, bars.start, bars.direction, bars.length, distance, end_margin)[0])


def freedom_of(points: Array, segments: Segments, half_m: Array, free_min: float = FREE_MIN) -> Array:
    """How free each segment stands ``(S,)``: the share of the ``points (N, 3)`` within `REACH` half-widths of its axis
    that lie within one, as the median over slices along it; 0 without points.

    Points on other segments do not count if these stand free. On a surface, parallel lines are segments to each other,
    and none is free: so those with ``free_min`` are found with all points first, then more of them without the points
    on those found. ``half_m (S,)``: half-widths, metres.
    """
    owner = nearest_bar(points, segments, float(half_m.max(initial=0.0)), 0.0)
    around = []
    for each in range(len(segments)):
        offset = points - segments.start[each]
        along = offset @ segments.direction[each]
        beside = np.flatnonzero((along >= 0) & (along <= segments.length[each]))
        distance = np.linalg.norm(offset[beside] - along[beside, None] * segments.direction[each], axis=1)
        near = distance <= REACH * half_m[each]
        beside, distance = beside[near], distance[near]
        around.append((owner[beside], (along[beside] / ALONG_M).astype(np.int64), distance <= half_m[each]))
    freedom, is_free = np.zeros(len(segments)), np.zeros(len(segments) + 1, dtype=bool)  # the last for no segment
    for _ in range(len(segments)):
        for each, (own, slices, inside) in enumerate(around):
            counts = (own == each) | ~is_free[own]
            total = np.bincount(slices[counts])
            within = np.bincount(slices[counts & inside], minlength=len(total))
            freedom[each] = np.median(within[total > 0] / total[total > 0]) if total.any() else 0.0
        more = np.append(freedom >= free_min, False) & ~is_free
        if not more.any():
            break
        is_free |= more
    return freedom
