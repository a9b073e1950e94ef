"""What section a bar has and where its axis runs, from the points of one bar seen from known directions.

A Time-of-Flight sensor measures the near face of a bar, and the axis lies somewhere behind it: how far, and to which
side, depends on the section and on how it is turned. Both show. From each direction the outline of the section is as
wide as the points lie beside the line of sight, and their mean depth follows its near faces. `fit_sections` fits an
equal-leg angle section (flange, turn and place unknown; thickness 1/12 of the flange, as rolled angles have about) to
both at once. The axis of a bar is the line through the centroids of its sections.

Range noise acts along the line of sight only, so it blurs the depth, which is averaged, and not the outline.
"""

import math

import numpy as np
from numba import njit

from steelnb.datatypes import Array

VIEWS, CELLS, PARTS = 24, 32, 6
"""Bins: directions of 15°, 1 cm beside the line of sight, and pieces along a bar."""
CELL_M = 0.01
THICKNESS = 1 / 12
TURNS = 24
FLANGES_M = np.array([0.025, 0.032, 0.04, 0.05, 0.063, 0.08, 0.1, 0.125, 0.16, 0.2])
ROBUST_M = 0.03
OUTLINE_WEIGHT = 0.5
"""Of an edge of the outline against all the depths seen from its direction."""
TELL_APART_M = 0.003
"""Two fits whose root mean square residuals differ by much less than this are equally likely; they are averaged."""
_REACH_M = CELLS * CELL_M / 2


def empty_histogram(bars: int) -> Array:
    """For each bar, piece, direction and cell: number, weight, and weighted sums of the two coordinates across."""
    return np.zeros((bars, PARTS, VIEWS, CELLS, 4))


def frames(direction: Array) -> Array:
    """Two unit vectors ``(B, 2, 3)`` across each direction ``(B, 3)``, right-handed with it."""
    helper = np.where(np.abs(direction[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(helper, direction)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(direction, first)], axis=1)


@njit(cache=True)
def look(points, sensor, bar, start, direction, length, across, margin, histogram):  # type: ignore[no-untyped-def]
    """Sort points ``(N, 3)`` seen from ``sensor (3,)`` into the histograms of their bars ``(N,)``, −1 for none.

    Points within ``margin`` of a bar's ends are left out, for there others join it, but never more than a third of it.
    """
    for i in range(len(points)):
        b = bar[i]
        if b < 0:
            continue
        x, y, z = points[i, 0] - start[b, 0], points[i, 1] - start[b, 1], points[i, 2] - start[b, 2]
        t = x * direction[b, 0] + y * direction[b, 1] + z * direction[b, 2]
        edge = min(margin, length[b] / 3.0)
        if t < edge or t > length[b] - edge:
            continue
        e1, e2 = across[b, 0], across[b, 1]
        u, v = x * e1[0] + y * e1[1] + z * e1[2], x * e2[0] + y * e2[1] + z * e2[2]
        cx, cy, cz = sensor[0] - points[i, 0], sensor[1] - points[i, 1], sensor[2] - points[i, 2]
        p, q = cx * e1[0] + cy * e1[1] + cz * e1[2], cx * e2[0] + cy * e2[1] + cz * e2[2]
        square = p * p + q * q
        if square < 0.1 * (cx * cx + cy * cy + cz * cz):  # along the bar: one sees its end
            continue
        distance = math.sqrt(square)
        beside = (-q * u + p * v) / distance
        cell = math.floor(beside / CELL_M) + CELLS // 2
        if cell < 0 or cell >= CELLS:
            continue
        view = int((math.atan2(q, p) + math.pi) * VIEWS / (2.0 * math.pi)) % VIEWS
        part = min(PARTS - 1, int(PARTS * t / length[b]))
        # Range noise grows with the distance, and acts on the depth by its share across the bar.
        h = histogram[b, part, view, cell]
        w = 1.0 / square
        h[0] += 1.0
        h[1] += w
        h[2] += w * u
        h[3] += w * v


@njit(cache=True)
def fit_sections(histogram, length, centre, slope, flange, turn, spread, tilt):  # type: ignore[no-untyped-def]
    """Fit an angle section to each bar's histogram ``(B, PARTS, VIEWS, CELLS, 4)``.

    Fills ``centre (B, 2)``, the axis across the bar in the middle of its length, ``slope (B, 2)`` metres per metre,
    ``flange (B,)`` metres, ``turn (B,)`` radians, and ``spread (B,)`` and ``tilt (B,)``, the standard deviations of the
    axis's place and, in radians, of its direction; NaN for a bar with too few points.
    """
    for b in range(len(length)):
        flange[b] = spread[b] = tilt[b] = np.nan
        cells = _cells(histogram[b], length[b])
        rows = _outlines(histogram[b])
        if len(cells) < 8 or len(rows) < 1:
            continue
        _fit(
            cells,
            _cells(_as_one(histogram[b]), 0.0),
            rows,
            centre[b],
            slope[b],
            flange[b : b + 1],
            turn[b : b + 1],
            spread[b : b + 1],
            tilt[b : b + 1],
        )


@njit(cache=True)
def _as_one(histogram):  # type: ignore[no-untyped-def]
    """All pieces of a bar as its first: fewer cells, enough to search with."""
    one = np.zeros_like(histogram)
    for part in range(PARTS):
        one[0] += histogram[part]
    return one


@njit(cache=True)
def _cells(histogram, length):  # type: ignore[no-untyped-def]
    """Non-empty cells of a bar: u, v, weight, cosine and sine of the view, position along from the middle."""
    found = np.empty((PARTS * VIEWS * CELLS, 6))
    n = 0
    for part in range(PARTS):
        for view in range(VIEWS):
            angle = (view + 0.5) * 2.0 * math.pi / VIEWS - math.pi
            for cell in range(CELLS):
                h = histogram[part, view, cell]
                if h[0] >= 3.0:
                    found[n, 0], found[n, 1], found[n, 2] = h[2] / h[1], h[3] / h[1], h[1]
                    found[n, 3], found[n, 4] = math.cos(angle), math.sin(angle)
                    found[n, 5] = ((part + 0.5) / PARTS - 0.5) * length
                    n += 1
    return found[:n]


@njit(cache=True)
def _outlines(histogram):  # type: ignore[no-untyped-def]
    """For each view with enough points: low and high edge of the outline, cosine, sine, weight.

    An edge is where the points fall to half of what they are inside: there, blur moves as many out as in.
    """
    found = np.empty((VIEWS, 5))
    n = 0
    for view in range(VIEWS):
        count, weight = np.zeros(CELLS), 0.0
        for part in range(PARTS):
            for cell in range(CELLS):
                count[cell] += histogram[part, view, cell, 0]
                weight += histogram[part, view, cell, 1]
        total = count.sum()
        if total < 60.0:
            continue
        # The level inside: the mean over points, which weighs full cells most; over a uniform strip it is its level.
        half = 0.5 * (count * count).sum() / total
        middle = int((count * np.arange(CELLS)).sum() / total + 0.5)
        if count[middle] < half:
            middle = int(np.argmax(count))
        low = middle
        while low > 0 and count[low] >= half:
            low -= 1
        high = middle
        while high < CELLS - 1 and count[high] >= half:
            high += 1
        if low == 0 or high == CELLS - 1:
            continue
        inside, outside = count[low + 1], count[low]
        edge_low = low + 0.5 + (half - outside) / max(inside - outside, 1e-9)
        inside, outside = count[high - 1], count[high]
        edge_high = high + 0.5 - (half - outside) / max(inside - outside, 1e-9)
        angle = (view + 0.5) * 2.0 * math.pi / VIEWS - math.pi
        found[n, 0], found[n, 1] = edge_low * CELL_M - _REACH_M, edge_high * CELL_M - _REACH_M
        found[n, 2], found[n, 3], found[n, 4] = math.cos(angle), math.sin(angle), weight
        n += 1
    return found[:n]


@njit(cache=True)
def _outline(turn, flange, corner):  # type: ignore[no-untyped-def]
    """Corners ``(6, 2)`` of an angle section about its centroid."""
    t = THICKNESS * flange
    c = (flange * flange + flange * t - t * t) / (2.0 * (2.0 * flange - t))
    xs = (0.0, flange, flange, t, t, 0.0)
    ys = (0.0, 0.0, t, t, flange, flange)
    cosine, sine = math.cos(turn), math.sin(turn)
    for k in range(6):
        x, y = xs[k] - c, ys[k] - c
        corner[k, 0], corner[k, 1] = cosine * x - sine * y, sine * x + cosine * y


@njit(cache=True)
def front_face(corner, cosine, sine, beside):  # type: ignore[no-untyped-def]
    """How far towards the viewer the outline is at a place beside its centroid, and its slope; −1e9 where it is not."""
    front, rise = -1e9, 0.0
    for i in range(6):
        j = (i + 1) % 6
        b0, b1 = -sine * corner[i, 0] + cosine * corner[i, 1], -sine * corner[j, 0] + cosine * corner[j, 1]
        if (b0 <= beside < b1) or (b1 <= beside < b0):
            d0, d1 = cosine * corner[i, 0] + sine * corner[i, 1], cosine * corner[j, 0] + sine * corner[j, 1]
            s = (d1 - d0) / (b1 - b0)
            if d0 + s * (beside - b0) > front:
                front, rise = d0 + s * (beside - b0), s
    return front, rise


@njit(cache=True)
def _nearest_edge(corner, cosine, sine, beside):  # type: ignore[no-untyped-def]
    nearest, edge = 1e9, 0.0
    for i in range(6):
        b = -sine * corner[i, 0] + cosine * corner[i, 1]
        if abs(beside - b) < nearest:
            nearest, edge = abs(beside - b), b
    return edge


@njit(cache=True)
def outlines(turn, flange):  # type: ignore[no-untyped-def]
    """Corners ``(B, 6, 2)`` of angle sections about their centroids."""
    corner = np.empty((len(turn), 6, 2))
    for b in range(len(turn)):
        _outline(turn[b], flange[b], corner[b])
    return corner


@njit(cache=True)
def _step(cells, rows, corner, place, sloped, normal):  # type: ignore[no-untyped-def]
    """Cost of a section at ``place`` (u, v and their slopes); fills the normal equations ``(4, 5)``."""
    normal[:, :] = 0.0
    cost = 0.0
    jacobian = np.zeros(4)
    bound = ROBUST_M * ROBUST_M
    for k in range(len(cells)):
        cosine, sine, along = cells[k, 3], cells[k, 4], cells[k, 5]
        if not sloped:
            along = 0.0
        u, v = cells[k, 0] - place[0] - along * place[2], cells[k, 1] - place[1] - along * place[3]
        beside, depth = -sine * u + cosine * v, cosine * u + sine * v
        front, rise = front_face(corner, cosine, sine, beside)
        weight = cells[k, 2]
        if front > -1e8:
            residual = depth - front
            ju, jv = -cosine - rise * sine, -sine + rise * cosine
            weight /= 1.0 + rise * rise
        else:  # beside the section
            residual = beside - _nearest_edge(corner, cosine, sine, beside)
            ju, jv = sine, -cosine
        square = residual * residual
        cost += weight * bound * square / (bound + square)
        weight *= (bound / (bound + square)) ** 2  # Geman-McClure
        jacobian[0], jacobian[1], jacobian[2], jacobian[3] = ju, jv, ju * along, jv * along
        _add(normal, jacobian, residual, weight)
    for k in range(len(rows)):
        cosine, sine = rows[k, 2], rows[k, 3]
        low, high = 1e9, -1e9
        for i in range(6):
            beside = -sine * (corner[i, 0] + place[0]) + cosine * (corner[i, 1] + place[1])
            low, high = min(low, beside), max(high, beside)
        jacobian[0], jacobian[1], jacobian[2], jacobian[3] = sine, -cosine, 0.0, 0.0
        for side in range(2):
            residual = rows[k, side] - (low if side == 0 else high)
            square = residual * residual
            weight = OUTLINE_WEIGHT * rows[k, 4]
            cost += weight * bound * square / (bound + square)
            weight *= (bound / (bound + square)) ** 2
            _add(normal, jacobian, residual, weight)
    return cost


@njit(cache=True)
def _add(normal, jacobian, residual, weight):  # type: ignore[no-untyped-def]
    for i in range(4):
        for j in range(4):
            normal[i, j] += weight * jacobian[i] * jacobian[j]
        normal[i, 4] -= weight * jacobian[i] * residual


@njit(cache=True)
def _settle(cells, rows, corner, place, sloped, normal, steps):  # type: ignore[no-untyped-def]
    """Gauss-Newton from ``place``, changed in place; the cost before the last step."""
    cost = 0.0
    total = cells[:, 2].sum()
    for _ in range(steps):
        cost = _step(cells, rows, corner, place, sloped, normal)
        size = 4 if sloped else 2
        matrix, right = normal[:size, :size].copy(), normal[:size, 4].copy()
        for i in range(size):
            matrix[i, i] += 1e-3 * total
        move = np.linalg.solve(matrix, right)
        for i in range(size):
            place[i] += min(max(move[i], -0.03), 0.03)
    return cost


@njit(cache=True)
def _fit(cells, merged, rows, centre, slope, flange, found_turn, spread, tilt):  # type: ignore[no-untyped-def]
    corner, normal = np.empty((6, 2)), np.empty((4, 5))
    total = cells[:, 2].sum() + OUTLINE_WEIGHT * 2.0 * rows[:, 4].sum()
    mean_u = (cells[:, 0] * cells[:, 2]).sum() / cells[:, 2].sum()
    mean_v = (cells[:, 1] * cells[:, 2]).sum() / cells[:, 2].sum()
    tried = np.empty((TURNS * len(FLANGES_M), 5))
    place = np.zeros(4)
    n = 0
    for f in range(len(FLANGES_M)):
        for k in range(TURNS):
            turn = 2.0 * math.pi * k / TURNS
            _outline(turn, FLANGES_M[f], corner)
            place[:] = 0.0
            place[0], place[1] = mean_u, mean_v
            cost = _settle(merged, rows, corner, place, False, normal, 4)
            tried[n, 0], tried[n, 1], tried[n, 2] = cost, FLANGES_M[f], turn
            tried[n, 3], tried[n, 4] = place[0], place[1]
            n += 1
    best = np.argmin(tried[:, 0])
    low, b, turn = np.inf, tried[best, 1], tried[best, 2]
    place[:] = 0.0
    place[0], place[1] = tried[best, 3], tried[best, 4]
    kept = place.copy()
    for size in (0.12, 0.06, 0.03):  # share of the flange, and of a turn by 60°
        b0, turn0 = b, turn
        for i in range(-1, 2):
            for j in range(-1, 2):
                _outline(turn0 + j * size, b0 * (1.0 + i * size), corner)
                place[:] = kept
                cost = _settle(cells, rows, corner, place, True, normal, 4)
                if cost < low:
                    low, b, turn = cost, b0 * (1.0 + i * size), turn0 + j * size
                    kept[:] = place
    # Fits that explain the points as well say the same, or not: their mean and spread.
    weight = u = v = uu = 0.0
    lowest = tried[:, 0].min()
    for k in range(len(tried)):
        w = math.exp(-0.5 * (tried[k, 0] - lowest) / total / (TELL_APART_M * TELL_APART_M))
        weight += w
        u += w * tried[k, 3]
        v += w * tried[k, 4]
        uu += w * (tried[k, 3] ** 2 + tried[k, 4] ** 2)
    u, v = u / weight, v / weight
    variance = max(uu / weight - u * u - v * v, 0.0)
    centre[0], centre[1] = kept[0] + u - tried[best, 3], kept[1] + v - tried[best, 4]
    slope[0], slope[1] = kept[2], kept[3]
    found_turn[0] = turn
    # How well the tilt is known, from the residuals as they are.
    _outline(turn, b, corner)
    cost = _step(cells, rows, corner, kept, True, normal)
    inverse = np.linalg.inv(normal[:, :4] + 1e-6 * total * np.eye(4))
    tilt[0] = math.sqrt((inverse[2, 2] + inverse[3, 3]) * cost / (len(cells) + 2 * len(rows)))
    flange[0], spread[0] = b, math.sqrt(variance + low / total / max(len(cells), 1))
