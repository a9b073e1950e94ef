"""Growth of a proposed segment through the free points of a whole cloud."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray
from steelnb.hough.segments_kernels import span
from steelnb.hough.transform import fit_line
from steelnb.hough.whole_structure.cubes import Line, walk

FITS_MAX = 8
"""Maximum number of fits of a growing segment."""


class Buffers(NamedTuple):
    """What the searches among N points in C cubes write to. ``free (N,)``: points that belong to no segment yet;
    ``visited (C + 1,)`` and ``near (N,)``: of `walk`; ``along (N,)``: coordinates along a line; ``run (N,)``: indices.
    """

    free: NDArray[np.bool_]
    visited: IntArray
    near: IntArray
    along: Array
    run: IntArray


@njit(cache=True)
def make_buffers(cubes):
    """`Buffers` for searches in some cubes, with all points free."""
    n = len(cubes.px)
    visited = np.zeros(len(cubes.first), np.int64)
    return Buffers(np.ones(n, np.bool_), visited, np.empty(n, np.int64), np.empty(n), np.empty(n, np.int64))


@njit(cache=True)
def fit_run(cubes, run):
    """Fit a line to points: the scatter along and across it, and the `Line` from the first point to the last."""
    along, across, ax, ay, az, ux, uy, uz = fit_line(cubes.px, cubes.py, cubes.pz, run, len(run))
    low, high = span(cubes.px, cubes.py, cubes.pz, run, ax, ay, az, ux, uy, uz)
    return along, across, Line(ax, ay, az, ux, uy, uz, low, high)


@njit(cache=True)
def run_along(cubes, line, radius, gap, buffers):
    """Write the indices of a run of free points within ``radius`` of a line to ``buffers.run``; returns their number.

    A run has no gap above ``gap`` along the line. If there are several, the one that overlaps most with the line's
    interval is taken. The search extends a few gaps past that interval, and farther if the run does.
    """
    ax, ay, az, ux, uy, uz, low, high = line
    free, visited, near, along, run = buffers
    beyond = 4.0 * gap
    while True:
        n = 0
        for c in range(walk(cubes, Line(ax, ay, az, ux, uy, uz, low - beyond, high + beyond), visited, near)):
            i = near[c]
            x, y, z = cubes.px[i] - ax, cubes.py[i] - ay, cubes.pz[i] - az
            t = x * ux + y * uy + z * uz
            inside = low - beyond <= t <= high + beyond
            if free[i] and inside and x * x + y * y + z * z - t * t <= radius * radius:
                near[n], along[n] = i, t
                n += 1
        order = np.argsort(along[:n])
        m = first = 0
        overlap, overshoot = 0.0, 0.0
        for k in range(1, n + 1):
            if k < n and along[order[k]] - along[order[k - 1]] <= gap:
                continue
            overlap_of_run = min(along[order[k - 1]], high) - max(along[order[first]], low)
            if overlap_of_run > overlap:
                overlap, m = overlap_of_run, k - first
                overshoot = max(along[order[k - 1]] - high, low - along[order[first]])
                for j in range(m):
                    run[j] = near[order[first + j]]
            first = k
        if m == 0 or overshoot + gap < beyond:
            return m
        beyond *= 2.0


@njit(cache=True)
def grow(cubes, line, radius, gap, min_votes, buffers):
    """Alternate between `run_along` a line and a fit to the run, until the run stops growing.

    Returns (number of points, line). It stops early when a run has fewer than ``min_votes`` points.
    """
    m = 0
    for _ in range(FITS_MAX):
        before = m
        m = run_along(cubes, line, radius, gap, buffers)
        if m < min_votes or m == before:
            break
        _, _, line = fit_run(cubes, buffers.run[:m])
    return m, line


@njit(cache=True)
def trim(cubes, line, radius, ring_weight, buffers):
    """Trim a grown segment, which may have outgrown its bar, to the interval with the best score.

    Returns (line, score). A free point scores 1 within ``radius``, and −``ring_weight`` from there to twice ``radius``.
    Scores are summed over slices of length ``radius``; the best interval is Kadane's maximum-sum interval.
    """
    ax, ay, az, ux, uy, uz, low, high = line
    free, visited, near, _, _ = buffers
    slices = np.zeros(int((high - low) / radius) + 1)
    for c in range(walk(cubes, line, visited, near)):
        i = near[c]
        x, y, z = cubes.px[i] - ax, cubes.py[i] - ay, cubes.pz[i] - az
        t = x * ux + y * uy + z * uz
        distance2 = x * x + y * y + z * z - t * t
        if free[i] and low <= t <= high and distance2 <= 4.0 * radius * radius:
            slices[int((t - low) / radius)] += 1.0 if distance2 <= radius * radius else -ring_weight
    total = best_score = 0.0
    begin = first = last = 0
    for k in range(len(slices)):
        if total <= 0.0:
            total, begin = 0.0, k
        total += slices[k]
        if total > best_score:
            best_score, first, last = total, begin, k + 1
    return Line(ax, ay, az, ux, uy, uz, low + first * radius, min(high, low + last * radius)), best_score
