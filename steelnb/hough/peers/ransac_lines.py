"""Bars by RANSAC lines: Fischler and Bolles, "Random Sample Consensus", Communications of the ACM 24 (1981), 381–395.

Compiled here: scikit-learn's RANSAC fits regressions, Open3D's knows planes only, scikit-image's and pyRANSAC-3D's try
one line after the other in Python, and a frame needs some 30,000.
"""

import numpy as np
from numba import njit

from steelnb.errors import InputError
from steelnb.hough.peers.bars import POINTS_MIN, bars_of_lines, in_passes, prepared, refine
from steelnb.hough.transform import drop, fit_near_line
from steelnb.rng import stream
from steelnb.types import Array, Lines, Segments

DRAWS = 50
"""Draws for a second point near the first; without that, two of 10,000 points are seldom on one bar."""
FAILURES = 3
"""Lines in a row with too few points, before the search ends."""


def segment_by_ransac_lines(
    points: Array,
    seed: int = 0,
    dx: float | None = None,
    points_min: int = POINTS_MIN,
    trials: int = 300,
    sample_m: float = 0.5,
) -> Segments:
    """The line with most points within ``dx`` out of ``trials`` lines through two points, one line after the other.

    The two points lie within ``sample_m`` metres of each other. ``dx`` is chosen from the points by default.
    """
    points, dx = prepared(points, dx, points_min)
    if trials < 1 or not sample_m > 0:
        raise InputError(f"trials = {trials}, sample_m = {sample_m}: expected at least 1 and a length above 0")
    random = stream(seed, "ransac-lines")

    def find(some: Array) -> Segments:
        px, py, pz = np.ascontiguousarray(some.T)
        lines = Lines(*_lines(px, py, pz, random, dx, trials, sample_m, points_min))
        return bars_of_lines(some, lines, points_min)

    return refine(points, in_passes(find, points, dx, points_min), dx, points_min)


@njit(cache=True)
def _lines(px, py, pz, random, dx, trials, sample_m, points_min):
    """Strongest line, refitted, its points taken out, again: (anchor, direction, count, label) as in `Lines`."""
    n = len(px)
    label = np.full(n, -1, np.int64)
    anchor, direction = np.zeros((n // points_min + 1, 3)), np.zeros((n // points_min + 1, 3))
    count = np.zeros(n // points_min + 1, np.int64)
    px, py, pz, original = px.copy(), py.copy(), pz.copy(), np.arange(n)
    chosen, gone = np.empty(n, np.int64), np.zeros(n, np.uint8)
    found = failures = 0
    while n >= points_min and failures < FAILURES:
        most, line = 0, np.zeros(6)
        for _ in range(trials):
            i = int(random.random() * n)
            for _ in range(DRAWS):
                j = int(random.random() * n)
                x, y, z = px[j] - px[i], py[j] - py[i], pz[j] - pz[i]
                length = np.sqrt(x * x + y * y + z * z)
                if dx < length <= sample_m:
                    break
            else:
                continue
            x, y, z = x / length, y / length, z / length
            near = _count_near(px, py, pz, n, px[i], py[i], pz[i], x, y, z, dx)
            if near > most:
                most = near
                line[:] = px[i], py[i], pz[i], x, y, z
        fitted, size, ax, ay, az, ux, uy, uz = fit_near_line(
            px[:n], py[:n], pz[:n], line[0], line[1], line[2], line[3], line[4], line[5], dx, points_min, chosen
        )
        if most < points_min or not fitted:
            failures += 1
            continue
        failures = 0
        anchor[found, 0], anchor[found, 1], anchor[found, 2] = ax, ay, az
        direction[found, 0], direction[found, 1], direction[found, 2] = ux, uy, uz
        count[found] = size
        for k in range(size):
            gone[original[chosen[k]]] = 1
            label[original[chosen[k]]] = found
        n = drop(gone, px[:n], py[:n], pz[:n], original)
        found += 1
    return anchor[:found], direction[:found], count[:found], label


@njit(cache=True)
def _count_near(px, py, pz, n, ax, ay, az, ux, uy, uz, distance):
    count = 0
    limit = distance * distance
    for i in range(n):
        x, y, z = px[i] - ax, py[i] - ay, pz[i] - az
        t = ux * x + uy * y + uz * z
        count += x * x + y * y + z * z - t * t <= limit
    return count
