"""Growth of a proposed segment through a whole cloud, along the points that are still free."""

import numpy as np
from numba import njit

from steelnb.hough.cubes import walk
from steelnb.hough.pieces import span
from steelnb.hough.transform import fit_line


@njit(cache=True)
def around(cubes, ax, ay, az, ux, uy, uz, low, high, seen, near):
    """`walk` with a mark of its own: the last of ``seen`` counts them."""
    seen[-1] += 1
    return walk(cubes, ax, ay, az, ux, uy, uz, low, high, seen, seen[-1], near)


@njit(cache=True)
def run_along(cubes, free, ax, ay, az, ux, uy, uz, low, high, radius, gap, seen, near, along, run):
    """Free points within ``radius`` of a line, as far from ``low`` to ``high`` on it as gaps allow; returns their
    number.

    The points are looked for a few gaps beyond ``low`` and ``high``; twice as far if the run comes near to where the
    search ended.
    """
    beyond = 4.0 * gap
    while True:
        n = 0
        for c in range(around(cubes, ax, ay, az, ux, uy, uz, low - beyond, high + beyond, seen, near)):
            i = near[c]
            x, y, z = cubes.px[i] - ax, cubes.py[i] - ay, cubes.pz[i] - az
            t = x * ux + y * uy + z * uz
            inside = low - beyond <= t <= high + beyond
            if free[i] and inside and x * x + y * y + z * z - t * t <= radius * radius:
                near[n], along[n] = i, t
                n += 1
        order = np.argsort(along[:n])
        m = first = 0
        overlap, reach = 0.0, 0.0
        for k in range(1, n + 1):
            if k < n and along[order[k]] - along[order[k - 1]] <= gap:
                continue
            shared = min(along[order[k - 1]], high) - max(along[order[first]], low)
            if shared > overlap:  # of several runs, the one that shares most with the proposal
                overlap, m = shared, k - first
                reach = max(along[order[k - 1]] - high, low - along[order[first]])
                for j in range(m):
                    run[j] = near[order[first + j]]
            first = k
        if m == 0 or reach + gap < beyond:
            return m
        beyond *= 2.0


@njit(cache=True)
def grow(cubes, free, ax, ay, az, ux, uy, uz, low, high, radius, gap, min_votes, rounds, seen, near, along, run):
    """Fit a line to its `run_along` and look again, until the run has no more points: (their number, line, low, high).

    Fewer than ``min_votes`` points end it; line and ends are then those before.
    """
    m = 0
    for _ in range(rounds):
        before = m
        m = run_along(cubes, free, ax, ay, az, ux, uy, uz, low, high, radius, gap, seen, near, along, run)
        if m < min_votes or m == before:
            break
        _, _, ax, ay, az, ux, uy, uz = fit_line(cubes.px, cubes.py, cubes.pz, run, m)
        low, high = span(cubes.px, cubes.py, cubes.pz, run[:m], ax, ay, az, ux, uy, uz)
    return m, ax, ay, az, ux, uy, uz, low, high


@njit(cache=True)
def best_stretch(slices):
    """Kadane's maximum-sum stretch: (first slice, one past the last, sum); the sum is 0 where no slice is above 0."""
    total = excess = 0.0
    begin = first = last = 0
    for k in range(len(slices)):
        if total <= 0.0:
            total, begin = 0.0, k
        total += slices[k]
        if total > excess:
            excess, first, last = total, begin, k + 1
    return first, last, excess
