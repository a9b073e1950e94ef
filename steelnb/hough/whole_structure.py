"""Segments of a whole structure: Hough transforms of small blocks, then a greedy selection among their segments.

A single transform of a whole tower fails in two ways. Its directions are some degrees apart, which moves the far end of
a long line by many dx. And a line across twenty bars of a face gets more votes than any bar. Blocks a few bars wide
avoid both, but they cut bars and find the same bar several times. Their segments are therefore proposals. The score of
a proposal is the number of points in its tube minus `RING_WEIGHT` times the number in the ring around it. The best
proposal is grown through the whole cloud. Then its points are removed, which lowers the scores of the proposals that
share them.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steelnb.core.checks import checked_number, checked_points
from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray, Segments
from steelnb.hough.near_segments import Line, sort_into_cubes, walk
from steelnb.hough.segments import GAP, cut, filter_pieces, span
from steelnb.hough.transform import directions, fit_line, iterate

BLOCK = 12.0
"""Edge of a block in dx. Directions 8° apart (granularity 3) then miss the ends of a line by up to dx/2."""
GRANULARITY = 3
LENGTH, PCA_RATIO = 5.0, 0.9
"""Bounds of a segment: minimum length in dx, minimum share of the variance along it."""
SHIFTS = ((0, 0, 0), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1), (0, 0, 1), (0, 1, 0), (1, 0, 0))
"""Shifts of the grids of blocks, in half blocks."""


def propose(points: Array, dx: float, min_votes: int, length_min: float, grids: int) -> Segments:
    """Segments of every block, for `segment_structure`. The bounds are looser: a block may hold only part of a bar.

    They are those of `detect_segments`, whose checks take as long as the transform of a block. Raises `InputError`.
    """
    dx, votes, shortest_m = checked_number(dx, "dx", above=0), max(2, int(0.75 * min_votes)), (length_min - 1) * dx
    edge, sphere = BLOCK * dx, directions(GRANULARITY)
    points, parts = checked_points(points), [tuple(vars(Segments.empty()).values())]
    lowest = points.min(axis=0)
    for shift in SHIFTS[:grids]:
        cell = np.floor((points - lowest) / edge + 0.5 * np.array(shift)).astype(np.int64)
        order = np.lexsort(cell.T[::-1])
        grouped = points[order]
        x, y, z = (np.diff(column[order]) != 0 for column in cell.T)
        first = np.append(0, np.flatnonzero(x | y | z) + 1)
        lows, highs = (extreme.reduceat(grouped, first) for extreme in (np.minimum, np.maximum))
        centres, last = (lows + highs) / 2.0, np.append(first[1:], len(points))
        boxes, halves = highs - centres, np.maximum(_norms(highs - centres), _norms(lows - centres))
        is_full = (last - first >= 0.75 * min_votes) & (_norms(highs - lows) > shortest_m)
        for k in np.flatnonzero(is_full).tolist():
            block = grouped[first[k] : last[k]]
            parts.append(_detect(block, centres[k], sphere, boxes[k], halves[k], dx, votes, shortest_m))
    return Segments(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _norms(vectors: Array) -> Array:
    """Lengths ``(N,)`` of vectors ``(N, 3)``, rounded as `numpy.linalg.norm` rounds that of one."""
    x, y, z = vectors.T
    return np.asarray(np.sqrt(x * x + y * y + z * z))


@njit(cache=True, nogil=True)
def _detect(points, centre, sphere, box, half, dx, min_votes, length_min):
    """The fields of the `Segments` of a block's ``points (N, 3)``, which lie within ``box (3,)`` of its ``centre``."""
    px, py, pz = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    x, y, z, columns = px - centre[0], py - centre[1], pz - centre[2], int(2 * half / dx + 0.5)
    anchor, direction, _, label = iterate(x, y, z, sphere, box, half, dx, columns, min_votes, len(points), True)
    order = np.argsort(label, kind="mergesort")
    begin = np.searchsorted(label[order], np.arange(len(anchor) + 1))
    piece = cut(px, py, pz, order, begin, anchor + centre, direction, GAP * dx, min_votes)
    return filter_pieces(px, py, pz, order, piece, PCA_RATIO - 0.1, np.inf, 0.7 / dx, length_min)


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


RING_WEIGHT = 0.75
"""Weight of a point in the ring from dx to 2 dx. At 1 a planar surface scores zero, but so do bars whose points scatter
by dx: on ten surveyed towers, 1 loses up to 60 % of the points that 0.75 explains. At 0.5, a third of a tower jittered
by 1 m is taken for bars; at 0.75, a twentieth."""
MIN_VOTES = 8
"""Minimum number of points of a bar."""
EXCLUDE_DX = 1.25
"""Points within this many dx of a chosen segment are removed, so that wide bars are not found twice."""


def segment_structure(
    points: Array, dx: float, min_votes: int = MIN_VOTES, length_min: float = LENGTH, grids: int = len(SHIFTS)
) -> Segments:
    """Find the bars in the cloud of a whole structure.

    Parameters
    ----------
    points: ``(N, 3)`` in metres, any frame, finite, voxel-filtered with a leaf of about dx/√3.
    dx: radius of the tube that holds a bar's points, metres.
    min_votes: minimum score and minimum number of points of a segment.
    length_min: minimum length of a segment, in dx.
    grids: number of shifted grids of blocks, 1 to 8. More grids find more bars; the time is proportional.

    Surfaces such as the ground are found as parallel stripes: crop them first.

    Returns `Segments` in the frame of the points, strongest first. Raises as `steelnb.hough.detect_segments`.
    """
    points = points[np.argsort(points[:, 2], kind="stable")]
    proposed = propose(points, dx, min_votes, length_min, grids)
    start, direction, length = proposed.start, proposed.direction, proposed.length
    cubes = sort_into_cubes(points, 2 * dx)
    first_pair, pair = _pairs(cubes, start, direction, length, dx)
    ends, count, radius = _select(cubes, start, direction, length, dx, min_votes, length_min, pair, first_pair)
    return Segments(ends[:, :3], ends[:, 3:], count, radius)


@njit(cache=True)
def _pairs(cubes, start, direction, length, dx):
    """Find the points within 2 dx of each proposal: (first, pair).

    The pairs of point i are ``pair[first[i] : first[i + 1]]``. The entry for proposal k is 2k + 1 in the tube and 2k in
    the ring. The first pass counts the pairs of point i in ``first[i + 2]``. The second one writes them from
    ``first[i + 1]`` on, and advances it past them.
    """
    visited, near = np.zeros(len(cubes.first), np.int64), np.empty(len(cubes.px), np.int64)
    first, pair = np.zeros(len(cubes.px) + 2, np.int64), np.empty(0, np.int32)
    for write in (False, True):
        if write:
            first = np.cumsum(first)
            pair = np.empty(first[-1], np.int32)
        for k in range(len(length)):
            (sx, sy, sz), (ux, uy, uz) = start[k], direction[k]
            for c in range(walk(cubes, Line(sx, sy, sz, ux, uy, uz, 0.0, length[k]), visited, near)):
                i = near[c]
                x, y, z = cubes.px[i] - sx, cubes.py[i] - sy, cubes.pz[i] - sz
                t = x * ux + y * uy + z * uz
                distance2 = x * x + y * y + z * z - t * t
                if 0.0 <= t <= length[k] and distance2 <= 4.0 * dx * dx:
                    if write:
                        pair[first[i + 1]] = 2 * k + (distance2 <= dx * dx)
                        first[i + 1] += 1
                    else:
                        first[i + 2] += 1
    return first, pair


@njit(cache=True, nogil=True)
def _select(cubes, start, direction, length, dx, min_votes, length_min, pair, first_pair):
    """Grow the best proposal, remove its points, repeat: ends ``(M, 6)``, counts and radii of the segments."""
    px, py, pz = cubes.px, cubes.py, cubes.pz
    weight = np.array([-RING_WEIGHT, 1.0])
    score = np.zeros(len(length))
    for k in range(len(pair)):
        score[pair[k] >> 1] += weight[pair[k] & 1]
    buffers = make_buffers(cubes)
    ends, count, radius = np.zeros((len(length), 6)), np.zeros(len(length), np.int64), np.zeros(len(length))
    found = 0
    while len(score) > 0:
        best = np.argmax(score)
        if score[best] < min_votes:
            break
        score[best] = -np.inf
        (ax, ay, az), (ux, uy, uz) = start[best], direction[best]
        proposed = Line(ax, ay, az, ux, uy, uz, 0.0, length[best])
        size, line = grow(cubes, proposed, dx, GAP * dx, min_votes, buffers)
        if size < min_votes:
            continue
        line, best_score = trim(cubes, line, dx, RING_WEIGHT, buffers)
        run = buffers.run[: run_along(cubes, line, dx, GAP * dx, buffers)]
        ax, ay, az, ux, uy, uz, low, high = line
        kept = 0
        for i in run:
            t = (px[i] - ax) * ux + (py[i] - ay) * uy + (pz[i] - az) * uz
            if low <= t <= high:
                run[kept] = i
                kept += 1
        if best_score < min_votes or kept < min_votes:
            continue
        spread_along, spread_across, line = fit_run(cubes, run[:kept])
        ax, ay, az, ux, uy, uz, low, high = line
        long_enough = high - low >= length_min * dx and kept * dx >= high - low
        if not long_enough or spread_along < PCA_RATIO * (spread_along + spread_across):
            continue
        ends[found, 0], ends[found, 1], ends[found, 2] = ax + low * ux, ay + low * uy, az + low * uz
        ends[found, 3], ends[found, 4], ends[found, 5] = ax + high * ux, ay + high * uy, az + high * uz
        count[found], radius[found] = kept, math.sqrt(spread_across / kept)
        found += 1
        for c in range(walk(cubes, line, buffers.visited, buffers.near)):
            i = buffers.near[c]
            x, y, z = px[i] - ax, py[i] - ay, pz[i] - az
            t = x * ux + y * uy + z * uz
            inside = low <= t <= high and x * x + y * y + z * z - t * t <= (EXCLUDE_DX * dx) ** 2
            if buffers.free[i] and inside:
                buffers.free[i] = False
                for k in range(first_pair[i], first_pair[i + 1]):
                    score[pair[k] >> 1] -= weight[pair[k] & 1]
    return ends[:found], count[:found], radius[:found]
