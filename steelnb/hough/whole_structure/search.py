"""Segments of a whole structure: Hough transforms of small blocks, then a greedy selection among their segments.

A single transform of a whole tower fails in two ways. Its directions are some degrees apart, which moves the far end of
a long line by many dx. And a line across twenty bars of a face gets more votes than any bar. Blocks a few bars wide
avoid both, but they cut bars and find the same bar several times. Their segments are therefore proposals. The score of
a proposal is the number of points in its tube minus `RING_WEIGHT` times the number in the ring around it. The best
proposal is grown through the whole cloud. Then its points are removed, which lowers the scores of the proposals that
share them.
"""

import math

import numpy as np
from numpy.typing import NDArray

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray, Segments
from steelnb.hough.segments import GAP
from steelnb.hough.whole_structure.blocks import LENGTH, PCA_RATIO, SHIFTS, propose
from steelnb.hough.whole_structure.cubes import Line, sort_into_cubes, walk
from steelnb.hough.whole_structure.growth import fit_run, grow, make_buffers, run_along, trim

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
