"""Segments of a whole structure: the Hough transform in small blocks, and a greedy selection among their segments.

One transform of a whole tower fails in two ways. Its directions are some degrees apart, which moves the far end of a
long line by many dx. And the longest lines get the most votes, so that a line across twenty bars of a face beats the
bars. Blocks a few bars wide avoid both, but cut bars and find each of them several times. So their segments are
proposals: each scores the points inside its tube less those in the ring around it, the best is grown through the whole
cloud and its points are removed, which lowers the scores of all others that share them; and so on.
"""

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steelnb.hough.cubes import sort_into_cubes, walk
from steelnb.hough.growth import around, best_stretch, grow, run_along
from steelnb.hough.pieces import span
from steelnb.hough.segments import detect_segments
from steelnb.hough.transform import fit_line
from steelnb.types import Array, Segments

BLOCK = 12.0
"""Edge of a block in dx. Directions 8° apart (granularity 3) then miss the ends of a line by dx/2."""
GRANULARITY = 3
GAP, LENGTH, PCA_RATIO = 4.0, 5.0, 0.9
"""Bounds of a segment: largest gap and least length in dx, least share of the variance along it."""
RING_WEIGHT = 0.75
"""Weight of a point between dx and 2 dx. A sheet of points holds as many there as within dx, so 1 would tell bars from
sheets, but bars whose points scatter by dx leave some there too: on ten surveyed towers, 1 loses up to 60 % of the
points that 0.75 explains. At 0.5 a third of a tower jittered by 1 m passes for bars, at 0.75 a twentieth."""
MIN_VOTES = 8
"""Fewest points of a bar."""
SHADOW = 1.25
"""Points within this many dx of a chosen segment cannot start another: else wide bars come out doubled."""
SHIFTS = ((0, 0, 0), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1), (0, 0, 1), (0, 1, 0), (1, 0, 0))
"""Shifts of the grids of blocks, in halves of a block."""
GROUP = 256
"""Size of the groups of proposals whose largest score is kept, which shortens the search for the strongest."""


def segment_structure(
    points: Array, dx: float, min_votes: int = MIN_VOTES, length_min: float = LENGTH, grids: int = len(SHIFTS)
) -> Segments:
    """Find the bars in the cloud of a whole structure.

    Parameters
    ----------
    points: ``(N, 3)`` in metres, any frame, finite, voxel-filtered with a leaf of about dx/√3.
    dx: radius of the tube that holds a bar's points, metres.
    min_votes: least excess of points in the tube over those in the ring, and fewest points of a segment.
    length_min: least length of a segment, in dx.
    grids: number of shifted grids of blocks, 1 to 8; each proposes most bars again, and takes as long.

    Surfaces (ground, walls) come out as stripes side by side: crop them first.

    Returns `Segments` in the frame of the points, strongest first. Raises as `steelnb.hough.detect_segments`.
    """
    points = points[np.argsort(points[:, 2], kind="stable")]
    proposed = propose(points, dx, min_votes, length_min, SHIFTS[:grids])
    start, direction, length = proposed.start, proposed.direction, proposed.length
    cubes = sort_into_cubes(points, 2 * dx)
    first_pair = np.zeros(len(points) + 2, dtype=np.int64)
    pair = np.empty(_pairs(cubes, start, direction, length, dx, first_pair, np.zeros(0, dtype=np.int32)), np.int32)
    first_pair = np.cumsum(first_pair)
    _pairs(cubes, start, direction, length, dx, first_pair, pair)
    ends, count = np.zeros((len(proposed), 6)), np.zeros(len(proposed), dtype=np.int64)
    radius = np.zeros(len(proposed))
    found = _choose(
        cubes, start, direction, length, dx, min_votes, length_min, pair, first_pair, ends, count, radius,
    )  # fmt: skip
    return Segments(ends[:found, :3], ends[:found, 3:], count[:found], radius[:found])


def within(points: Array, segments: Segments, distance: float) -> NDArray[np.bool_]:
    """Which of the points ``(N, 3)`` lie within ``distance`` metres of a segment, its ends included."""
    near = np.zeros(len(points), dtype=np.bool_)
    cubes = sort_into_cubes(np.asarray(points), distance)
    near[cubes.order] = _mark(cubes, segments.start, segments.direction, segments.length, distance)
    return near


def propose(
    points: Array, dx: float, min_votes: int, length_min: float, shifts: Sequence[tuple[int, int, int]]
) -> Segments:
    """Segments of each block of the cloud ``(N, 3)``, of grids of blocks that are shifted by half a block against each
    other, one for each of the ``shifts``. Lengths as in `segment_structure`, which chooses among them."""
    edge = BLOCK * dx
    low = points.min(axis=0)
    found = [Segments.empty()]
    for shift in shifts:
        cell = np.floor((points - low) / edge + 0.5 * np.array(shift)).astype(np.int64)
        order = np.lexsort(cell.T[::-1])  # by the three numbers: blocks may be more than one number counts
        new = (np.diff(cell[order], axis=0) != 0).any(axis=1)
        bounds = np.concatenate([[0], np.flatnonzero(new) + 1, [len(points)]])
        for first, last in itertools.pairwise(bounds):
            some = points[order[first:last]]
            # Bounds looser than the final ones: a block may hold only part of a bar.
            if len(some) >= 0.75 * min_votes and np.linalg.norm(np.ptp(some, axis=0)) > (length_min - 1) * dx:
                found.append(
                    detect_segments(
                        some, dx=dx, min_votes=max(2, int(0.75 * min_votes)), granularity=GRANULARITY,
                        gap_max=GAP * dx, pca_ratio_min=PCA_RATIO - 0.1, density_min=0.7 / dx,
                        length_min=(length_min - 1) * dx,
                    )
                )  # fmt: skip
    return Segments.joined(found)


@njit(cache=True)
def _mark(cubes, start, direction, length, distance):
    hit = np.zeros(len(cubes.px), dtype=np.bool_)
    seen, near = np.full(len(cubes.first) - 1, -1), np.empty(len(cubes.px), np.int64)
    for k in range(len(length)):
        (sx, sy, sz), (ux, uy, uz) = start[k], direction[k]
        for c in range(walk(cubes, sx, sy, sz, ux, uy, uz, 0.0, length[k], seen, k, near)):
            i = near[c]
            x, y, z = cubes.px[i] - sx, cubes.py[i] - sy, cubes.pz[i] - sz
            t = min(max(x * ux + y * uy + z * uz, 0.0), length[k])
            x, y, z = x - t * ux, y - t * uy, z - t * uz
            if x * x + y * y + z * z <= distance * distance:
                hit[i] = True
    return hit


@njit(cache=True)
def _pairs(cubes, start, direction, length, dx, first, pair):
    """Find the points within 2 dx of each proposal; return the number of pairs.

    Counts those of point i in ``first[i + 2]`` if ``pair`` is empty. Otherwise ``first[i + 1]`` is where the pairs of
    point i begin in ``pair``, and moves on to where they end: twice the proposal, and 1 more inside than in the ring.
    """
    n = 0
    seen, near = np.full(len(cubes.first) - 1, -1), np.empty(len(cubes.px), np.int64)
    for k in range(len(length)):
        (sx, sy, sz), (ux, uy, uz) = start[k], direction[k]
        for c in range(walk(cubes, sx, sy, sz, ux, uy, uz, 0.0, length[k], seen, k, near)):
            i = near[c]
            x, y, z = cubes.px[i] - sx, cubes.py[i] - sy, cubes.pz[i] - sz
            t = x * ux + y * uy + z * uz
            distance2 = x * x + y * y + z * z - t * t
            if 0.0 <= t <= length[k] and distance2 <= 4.0 * dx * dx:
                n += 1
                if len(pair) == 0:
                    first[i + 2] += 1
                else:
                    pair[first[i + 1]] = 2 * k + (distance2 <= dx * dx)
                    first[i + 1] += 1
    return n


@njit(cache=True)
def _strongest(score, stale, most):
    """The first of the largest scores. ``most`` holds the largest of each `GROUP`, renewed where it is ``stale``."""
    for group in range(len(most)):
        if stale[group]:
            most[group] = score[group * GROUP : (group + 1) * GROUP].max()
            stale[group] = False
    first = np.argmax(most) * GROUP
    return first + np.argmax(score[first : first + GROUP])


@njit(cache=True, nogil=True)
def _choose(cubes, start, direction, length, dx, min_votes, length_min, pair, first_pair, ends, count, radius):
    """Take the best proposal, grow it, take its points away, again. Fills ``ends``, ``count``, ``radius``."""
    px, py, pz = cubes.px, cubes.py, cubes.pz
    weight = np.array([-RING_WEIGHT, 1.0])
    score = np.zeros(len(length))
    for k in range(len(pair)):
        score[pair[k] >> 1] += weight[pair[k] & 1]
    groups = (len(length) + GROUP - 1) // GROUP
    stale, most = np.ones(groups, dtype=np.bool_), np.empty(groups)
    free = np.ones(len(px), dtype=np.bool_)
    near, along, run = np.empty(len(px), np.int64), np.empty(len(px)), np.empty(len(px), np.int64)
    seen = np.zeros(len(cubes.first), np.int64)  # the last one counts the walks
    found = 0
    while len(score) > 0:
        best = _strongest(score, stale, most)
        if score[best] < min_votes:
            break
        score[best] = -np.inf
        stale[best // GROUP] = True
        (ax, ay, az), (ux, uy, uz) = start[best], direction[best]
        m, ax, ay, az, ux, uy, uz, low, high = grow(
            cubes, free, ax, ay, az, ux, uy, uz, 0.0, length[best], dx, GAP * dx, min_votes, 8, seen, near, along, run
        )
        if m < min_votes:
            continue
        low, high, excess = _stretch(cubes, free, ax, ay, az, ux, uy, uz, low, high, dx, seen, near)
        m = run_along(cubes, free, ax, ay, az, ux, uy, uz, low, high, dx, GAP * dx, seen, near, along, run)
        kept = 0
        for k in range(m):
            t = (px[run[k]] - ax) * ux + (py[run[k]] - ay) * uy + (pz[run[k]] - az) * uz
            if low <= t <= high:
                run[kept] = run[k]
                kept += 1
        if excess < min_votes or kept < min_votes:
            continue
        spread_along, spread_across, ax, ay, az, ux, uy, uz = fit_line(px, py, pz, run, kept)
        low, high = span(px, py, pz, run[:kept], ax, ay, az, ux, uy, uz)
        long_enough = high - low >= length_min * dx and kept * dx >= high - low
        if not long_enough or spread_along < PCA_RATIO * (spread_along + spread_across):
            continue
        ends[found, 0], ends[found, 1], ends[found, 2] = ax + low * ux, ay + low * uy, az + low * uz
        ends[found, 3], ends[found, 4], ends[found, 5] = ax + high * ux, ay + high * uy, az + high * uz
        count[found], radius[found] = kept, math.sqrt(spread_across / kept)
        found += 1
        for c in range(around(cubes, ax, ay, az, ux, uy, uz, low, high, seen, near)):
            i = near[c]
            x, y, z = px[i] - ax, py[i] - ay, pz[i] - az
            t = x * ux + y * uy + z * uz
            if free[i] and low <= t <= high and x * x + y * y + z * z - t * t <= (SHADOW * dx) ** 2:
                free[i] = False
                for k in range(first_pair[i], first_pair[i + 1]):
                    score[pair[k] >> 1] -= weight[pair[k] & 1]
                    stale[(pair[k] >> 1) // GROUP] = True
    return found


@njit(cache=True)
def _stretch(cubes, free, ax, ay, az, ux, uy, uz, low, high, dx, seen, near):
    """The part of a grown segment that stands out most: (low, high, excess of points). It may have outgrown its bar.

    The `best_stretch` of slices one dx long.
    """
    slices = np.zeros(int((high - low) / dx) + 1)
    for c in range(around(cubes, ax, ay, az, ux, uy, uz, low, high, seen, near)):
        i = near[c]
        x, y, z = cubes.px[i] - ax, cubes.py[i] - ay, cubes.pz[i] - az
        t = x * ux + y * uy + z * uz
        distance2 = x * x + y * y + z * z - t * t
        if free[i] and low <= t <= high and distance2 <= 4.0 * dx * dx:
            slices[int((t - low) / dx)] += 1.0 if distance2 <= dx * dx else -RING_WEIGHT
    first, last, excess = best_stretch(slices)
    return low + first * dx, min(high, low + last * dx), excess
