"""Histograms of the points of bars by part along the bar, viewing direction, and position beside the line of sight.

A section is fitted to the cells of a histogram, which are its depths, and to the edges of the outline that its counts
show (`sections.fit`).
"""

import math

import numpy as np

from steelnb.core.kernels import njit
from steelnb.fusion.sections.shapes import in_frame, sighting

VIEWS, CELLS, PARTS = 24, 32, 6
"""Number of bins: directions of 15°, cells of 1 cm beside the line of sight, and parts along a bar."""
HISTOGRAM = PARTS, VIEWS, CELLS, 4
"""Shape of the histogram of a bar. For each part, direction and cell: number of points, weight, weighted sums of u and
v."""
CELL_M = 0.01


@njit(cache=True, nogil=True)
def accumulate(points, T, bar, start, direction, length, across, margin, histogram):  # type: ignore[no-untyped-def]
    """Add points ``(N, 3)`` in the frame of a sensor at ``T (4, 4)`` to the histograms of their bars ``(N,)``. Points
    near the ends, where other bars join, are left out: within ``margin`` metres, or a third of the length if less."""
    for i in range(len(points)):
        b = bar[i]
        x, y, z, cx, cy, cz = sighting(T, points[i], start[b])
        u, v, t = in_frame(direction[b], across[b], x, y, z)
        edge = min(margin, length[b] / 3.0)
        if t < edge or t > length[b] - edge:
            continue
        p, q, _ = in_frame(direction[b], across[b], cx, cy, cz)
        square = p * p + q * q
        if square < 0.1 * (cx * cx + cy * cy + cz * cz):  # line of sight along the bar: its end face
            continue
        distance = math.sqrt(square)
        beside = (-q * u + p * v) / distance
        cell = math.floor(beside / CELL_M) + CELLS // 2
        if cell < 0 or cell >= CELLS:
            continue
        view = int((math.atan2(q, p) + math.pi) * VIEWS / (2.0 * math.pi)) % VIEWS
        part = min(PARTS - 1, int(PARTS * t / length[b]))
        h = histogram[b, part, view, cell]
        w = 1.0 / square  # range noise grows with the distance
        h[0] += 1.0
        h[1] += w
        h[2] += w * u
        h[3] += w * v


@njit(cache=True)
def direction_of(view):  # type: ignore[no-untyped-def]
    """Cosine and sine of the middle of a bin of viewing directions."""
    angle = (view + 0.5) * 2.0 * math.pi / VIEWS - math.pi
    return math.cos(angle), math.sin(angle)


@njit(cache=True)
def cells_of(histogram, length):  # type: ignore[no-untyped-def]
    """Non-empty cells of a bar ``(C, 7)``: u, v, weight, cosine and sine of the direction, position along from the
    middle, number of the direction."""
    parts = len(histogram)
    found = np.empty((parts * VIEWS * CELLS, 7))
    n = 0
    for part in range(parts):
        for view in range(VIEWS):
            cosine, sine = direction_of(view)
            for cell in range(CELLS):
                h = histogram[part, view, cell]
                if h[0] >= 3.0:
                    found[n, 0], found[n, 1], found[n, 2] = h[2] / h[1], h[3] / h[1], h[1]
                    found[n, 3], found[n, 4] = cosine, sine
                    found[n, 5] = ((part + 0.5) / parts - 0.5) * length
                    found[n, 6] = view
                    n += 1
    return found[:n]


@njit(cache=True)
def merged_cells(histogram):  # type: ignore[no-untyped-def]
    """The `cells_of` a bar with its parts merged: fewer cells, which suffice for a search."""
    return cells_of(np.expand_dims(histogram.sum(axis=0), 0), 0.0)


@njit(cache=True)
def edges_of(histogram):  # type: ignore[no-untyped-def]
    """Edges of the outline ``(R, 6)`` from each direction with enough points: low and high edge, cosine and sine of the
    direction, weight, number of the direction. An edge is where the number of points falls to half of that inside,
    since blur moves as many points out as in."""
    found = np.empty((VIEWS, 6))
    n = 0
    for view in range(VIEWS):
        count, weight = histogram[:, view, :, 0].sum(axis=0), histogram[:, view, :, 1].sum()
        total = count.sum()
        if total < 60.0:
            continue
        # Half of the mean count over points, not cells; for a uniform strip, this is half of its level.
        half_level = 0.5 * (count * count).sum() / total
        middle = int((count * np.arange(CELLS)).sum() / total + 0.5)
        if count[middle] < half_level:
            middle = int(np.argmax(count))
        inside = True
        for side in range(2):
            step, cell = 2 * side - 1, middle
            while 0 < cell < CELLS - 1 and count[cell] >= half_level:
                cell += step
            inside &= 0 < cell < CELLS - 1
            if inside:
                level, outside = count[cell - step], count[cell]
                edge = cell + 0.5 - step * (half_level - outside) / max(level - outside, 1e-9)
                found[n, side] = edge * CELL_M - CELLS * CELL_M / 2
        if not inside:
            continue
        found[n, 2], found[n, 3] = direction_of(view)
        found[n, 4], found[n, 5] = weight, view
        n += 1
    return found[:n]
