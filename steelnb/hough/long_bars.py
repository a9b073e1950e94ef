"""Long bars among short ones: the legs of a lattice whose braces join them every few tubes.

Around such a leg the ring about its tube holds as many points as the tube, those of the braces, so that by the ring on
all sides it does not stand out (`hough.blocks`), and the braces claim its points. But they lie on one side of it: it is
an edge of the structure. So a long bar is held against twice the points of the half of the ring that faces away from
its other points, which is the whole ring in the midst of a surface or a volume. Over its length, a tube half as wide
still holds points enough, and less of the braces.
"""

import math

import numpy as np
from numba import njit

from steelnb.hough.blocks import GAP, LENGTH, SHADOW, SHIFTS, propose
from steelnb.hough.cubes import sort_into_cubes
from steelnb.hough.growth import around, best_stretch, grow
from steelnb.hough.transform import fit_line
from steelnb.types import Array, Segments

LONG = 30.0
"""Least length of a long bar, in dx. At 20, lines of that kind are found in towers whose points are moved by up to 1 m;
at 30 next to none. Chosen, as the others here, on the surveyed towers 002 to 006 and 008 to 010 of
benchmarks/structure.md."""
NARROW = 0.5
"""Radius of the tube of a long bar, in dx."""
HALF_RING_WEIGHT = 2.0
"""Weight of a point in the outer half of the ring, between `NARROW` and twice that."""
EXCESS = 0.1
"""Least excess of points over those of the ring, for each dx of the length."""
WIDE_ROUNDS, NARROW_ROUNDS = 3, 20
"""Fits in the tube of short bars, and then in the narrow one."""


def long_bars(points: Array, dx: float, min_votes: int = 8) -> Segments:
    """Long bars on the edges of a lattice, from its cloud ``(N, 3)``, metres, any frame, finite; `Segments` in that
    frame, those that stand out most first.

    ``dx``: radius of the tube that holds a bar's points, metres. ``min_votes``: least excess of points in a tube half
    as wide over those around it. The other bars are found in what these leave (`hough.blocks.segment_structure`).
    """
    points = points[np.argsort(points[:, 2], kind="stable")]
    proposed = propose(points, dx, min_votes, LENGTH, SHIFTS)
    ends, count, radius = np.zeros((len(proposed), 6)), np.zeros(len(proposed), np.int64), np.zeros(len(proposed))
    found = _choose(
        sort_into_cubes(points, 2 * dx), proposed.start, proposed.direction, proposed.length, dx, min_votes, ends,
        count, radius,
    )  # fmt: skip
    return Segments(ends[:found, :3], ends[:found, 3:], count[:found], radius[:found])


@njit(cache=True)
def _choose(cubes, start, direction, length, dx, min_votes, ends, count, radius):
    """Grow all proposals, take the one that stands out most and its points, again; the number taken. Fills ``ends``,
    ``count``, ``radius`` of so many."""
    free = np.ones(len(cubes.px), dtype=np.bool_)
    near, along, run = np.empty(len(free), np.int64), np.empty(len(free)), np.empty(len(free), np.int64)
    seen = np.zeros(len(cubes.first), np.int64)  # the last one counts the walks
    score, grown = np.full(len(length), np.inf), np.empty((len(length), 8))
    known = np.full(len(length), -1)  # how many bars were taken when a proposal was grown last
    found = 0
    while len(score) > 0:
        best = np.argmax(score)
        if score[best] == -np.inf:
            break
        if known[best] < found:  # others have taken points since
            known[best] = found
            score[best] = _grown(
                cubes, free, start[best], direction[best], length[best], dx, min_votes, seen, near, along, run,
                grown[best],
            )  # fmt: skip
            continue
        score[best] = -np.inf
        ax, ay, az, ux, uy, uz, low, high = grown[best]
        inside = taken = 0
        for c in range(around(cubes, ax, ay, az, ux, uy, uz, low, high, seen, near)):
            i = near[c]
            x, y, z = cubes.px[i] - ax, cubes.py[i] - ay, cubes.pz[i] - az
            t = x * ux + y * uy + z * uz
            square = x * x + y * y + z * z - t * t
            if not free[i] or t < low or t > high or square > (SHADOW * dx) ** 2:
                continue
            free[i] = False
            taken += 1
            if square <= (NARROW * dx) ** 2:
                run[inside] = i
                inside += 1
        _, across, _, _, _, _, _, _ = fit_line(cubes.px, cubes.py, cubes.pz, run, inside)
        ends[found, 0], ends[found, 1], ends[found, 2] = ax + low * ux, ay + low * uy, az + low * uz
        ends[found, 3], ends[found, 4], ends[found, 5] = ax + high * ux, ay + high * uy, az + high * uz
        count[found], radius[found] = taken, math.sqrt(across / inside)
        found += 1
    return found


@njit(cache=True)
def _grown(cubes, free, anchor, axis, length, dx, min_votes, seen, near, along, run, line):
    """Grow a proposal; its excess of points, −inf for none that is long and stands out. Fills ``line (8,)``: a point,
    the direction, and where it begins and ends."""
    (ax, ay, az), (ux, uy, uz) = anchor, axis
    low, high = 0.0, length
    for k in range(2):
        tube, rounds = (dx, WIDE_ROUNDS) if k == 0 else (NARROW * dx, NARROW_ROUNDS)
        m, ax, ay, az, ux, uy, uz, low, high = grow(
            cubes, free, ax, ay, az, ux, uy, uz, low, high, tube, GAP * dx, min_votes, rounds, seen, near, along, run
        )
        if m < min_votes:
            return -np.inf
    if high - low < LONG * dx:
        return -np.inf
    walked = around(cubes, ax, ay, az, ux, uy, uz, low, high, seen, near)
    inward = np.zeros(3)
    for c in range(walked):
        t, square, across = _beside(cubes, near[c], ax, ay, az, ux, uy, uz)
        if low <= t <= high and (NARROW * dx) ** 2 < square <= (2.0 * NARROW * dx) ** 2:
            inward += across / math.sqrt(square)
    slices = np.zeros(int((high - low) / dx) + 1)
    for c in range(walked):
        t, square, across = _beside(cubes, near[c], ax, ay, az, ux, uy, uz)
        if not low <= t <= high or square > (2.0 * NARROW * dx) ** 2:
            continue
        if square > (NARROW * dx) ** 2:
            # Points of other bars, too: beside a leg that is found already its braces look like an edge.
            slices[int((t - low) / dx)] -= HALF_RING_WEIGHT if (across * inward).sum() < 0.0 else 0.0
        elif free[near[c]]:
            slices[int((t - low) / dx)] += 1.0
    first, last, excess = best_stretch(slices)
    low, high = low + first * dx, min(high, low + last * dx)
    line[0], line[1], line[2], line[3], line[4], line[5], line[6], line[7] = ax, ay, az, ux, uy, uz, low, high
    stands_out = high - low >= LONG * dx and excess >= max(min_votes, EXCESS * (high - low) / dx)
    return excess if stands_out else -np.inf


@njit(cache=True)
def _beside(cubes, i, ax, ay, az, ux, uy, uz):
    """Of a point: the place along a line, the squared distance to it, and the vector from it ``(3,)``."""
    x, y, z = cubes.px[i] - ax, cubes.py[i] - ay, cubes.pz[i] - az
    t = x * ux + y * uy + z * uz
    across = np.array([x - t * ux, y - t * uy, z - t * uz])
    return t, (across * across).sum(), across
