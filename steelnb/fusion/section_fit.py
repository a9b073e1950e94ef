"""An equal-leg angle section fitted to what was seen of a bar (flange, turn, place and tilt of its axis).

The outline's width and the depth of the near faces are fitted at once, to the histograms of `fusion.sections`; the
thickness is 1/12 of the flange, as rolled angles have about. The axis of a bar is the line through the centroids of its
sections. A search through flanges and turns first, with the faces from a table; then Gauss-Newton.
"""

import math

import numpy as np
from numba import njit

from steelnb.fusion.sections import CELL_M, CELLS, PARTS, VIEWS, front_face, nearest_edge, outline

TURNS = VIEWS  # so that a turned section looks like another one from the next direction
PROFILE = 128
"""Cells of a section's face, as the search sees it: half a millimetre and less."""
FLANGES_M = np.array([0.025, 0.032, 0.04, 0.05, 0.063, 0.08, 0.1, 0.125, 0.16, 0.2])
ROBUST_M = 0.03
OUTLINE_WEIGHT = 0.5
"""Of an edge of the outline against all the depths seen from its direction."""
TELL_APART_M = 0.003
"""Two fits whose root mean square residuals differ by much less than this are equally likely; they are averaged."""
_REACH_M = CELLS * CELL_M / 2


@njit(cache=True)
def fit_sections(histogram, length, centre, slope, flange, turn, spread, tilt):  # type: ignore[no-untyped-def]
    """Fit an angle section to each bar's histogram ``(B, PARTS, VIEWS, CELLS, 4)``.

    Fills ``centre (B, 2)``, the axis across the bar in the middle of its length, ``slope (B, 2)`` metres per metre,
    ``flange (B,)`` metres, ``turn (B,)`` radians, and ``spread (B,)`` and ``tilt (B,)``, the standard deviations of the
    axis's place and, in radians, of its direction; NaN for a bar with too few points.
    """
    face, side = _profiles()
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
            face,
            side,
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
    """Non-empty cells of a bar: u, v, weight, cosine and sine of the view, position along from the middle, view."""
    found = np.empty((PARTS * VIEWS * CELLS, 7))
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
                    found[n, 6] = view
                    n += 1
    return found[:n]


@njit(cache=True)
def _outlines(histogram):  # type: ignore[no-untyped-def]
    """For each view with enough points: low and high edge of the outline, cosine, sine, weight, view.

    An edge is where the points fall to half of what they are inside: there, blur moves as many out as in.
    """
    found = np.empty((VIEWS, 6))
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
        found[n, 2], found[n, 3], found[n, 4], found[n, 5] = math.cos(angle), math.sin(angle), weight, view
        n += 1
    return found[:n]


@njit(cache=True)
def _profiles():  # type: ignore[no-untyped-def]
    """Near face of a section of flange 1 from each direction ``(VIEWS, PROFILE, 2)``: `front_face` beside its centroid,
    depth and slope; and how far it reaches to either side ``(VIEWS, 2)``. Other flanges and turns are the same in
    another scale and from another direction, as turns and directions are both whole steps."""
    corner = np.empty((6, 2))
    outline(0.0, 1.0, corner)
    face, side = np.empty((VIEWS, PROFILE, 2)), np.empty((VIEWS, 2))
    for view in range(VIEWS):
        angle = (view + 0.5) * 2.0 * math.pi / VIEWS - math.pi
        cosine, sine = math.cos(angle), math.sin(angle)
        beside = -sine * corner[:, 0] + cosine * corner[:, 1]
        side[view, 0], side[view, 1] = beside.min(), beside.max()
        for k in range(PROFILE):
            at = side[view, 0] + (k + 0.5) / PROFILE * (side[view, 1] - side[view, 0])
            face[view, k, 0], face[view, k, 1] = front_face(corner, cosine, sine, at)
    return face, side


@njit(cache=True)
def _place(cells, rows, face, side, flange, turn, place, steps):  # type: ignore[no-untyped-def]
    """Gauss-Newton for the place ``(2,)`` of a section with one of `FLANGES_M` and a whole number of turns, changed in
    place; the cost before the last step. The step of `_settle`, with faces from a table and no slope."""
    cost = 0.0
    total = cells[:, 2].sum()
    bound = ROBUST_M * ROBUST_M
    for _ in range(steps):
        cost = uu = uv = vv = ru = rv = 0.0
        for k in range(len(cells)):
            cosine, sine = cells[k, 3], cells[k, 4]
            view = (int(cells[k, 6]) - turn) % VIEWS
            u, v = cells[k, 0] - place[0], cells[k, 1] - place[1]
            beside, depth = -sine * u + cosine * v, cosine * u + sine * v
            low, high = flange * side[view, 0], flange * side[view, 1]
            weight = cells[k, 2]
            if low < beside < high:
                at = int((beside - low) / (high - low) * PROFILE)
                residual, rise = depth - flange * face[view, at, 0], face[view, at, 1]
                ju, jv = -cosine - rise * sine, -sine + rise * cosine
                weight /= 1.0 + rise * rise
            else:
                residual = beside - (low if beside <= low else high)
                ju, jv = sine, -cosine
            square = residual * residual
            cost += weight * bound * square / (bound + square)
            weight *= (bound / (bound + square)) ** 2  # Geman-McClure
            uu += weight * ju * ju
            uv += weight * ju * jv
            vv += weight * jv * jv
            ru -= weight * ju * residual
            rv -= weight * jv * residual
        for k in range(len(rows)):
            cosine, sine = rows[k, 2], rows[k, 3]
            view = (int(rows[k, 5]) - turn) % VIEWS
            middle = -sine * place[0] + cosine * place[1]
            for end in range(2):
                residual = rows[k, end] - middle - flange * side[view, end]
                square = residual * residual
                weight = OUTLINE_WEIGHT * rows[k, 4]
                cost += weight * bound * square / (bound + square)
                weight *= (bound / (bound + square)) ** 2
                uu += weight * sine * sine
                uv -= weight * sine * cosine
                vv += weight * cosine * cosine
                ru -= weight * sine * residual
                rv += weight * cosine * residual
        uu += 1e-3 * total
        vv += 1e-3 * total
        determinant = uu * vv - uv * uv
        place[0] += min(max((vv * ru - uv * rv) / determinant, -0.03), 0.03)
        place[1] += min(max((uu * rv - uv * ru) / determinant, -0.03), 0.03)
    return cost


@njit(cache=True)
def _step(cells, rows, corner, place, normal):  # type: ignore[no-untyped-def]
    """Cost of a section at ``place`` (u, v and their slopes); fills the normal equations ``(4, 5)``."""
    normal[:, :] = 0.0
    cost = 0.0
    jacobian = np.zeros(4)
    bound = ROBUST_M * ROBUST_M
    for k in range(len(cells)):
        cosine, sine, along = cells[k, 3], cells[k, 4], cells[k, 5]
        u, v = cells[k, 0] - place[0] - along * place[2], cells[k, 1] - place[1] - along * place[3]
        beside, depth = -sine * u + cosine * v, cosine * u + sine * v
        front, rise = front_face(corner, cosine, sine, beside)
        weight = cells[k, 2]
        if front > -1e8:
            residual = depth - front
            ju, jv = -cosine - rise * sine, -sine + rise * cosine
            weight /= 1.0 + rise * rise
        else:  # beside the section
            residual = beside - nearest_edge(corner, cosine, sine, beside)
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
def _settle(cells, rows, corner, place, normal, steps):  # type: ignore[no-untyped-def]
    """Gauss-Newton from ``place``, changed in place; the cost before the last step."""
    cost = 0.0
    total = cells[:, 2].sum()
    for _ in range(steps):
        cost = _step(cells, rows, corner, place, normal)
        matrix, right = normal[:, :4].copy(), normal[:, 4].copy()
        for i in range(4):
            matrix[i, i] += 1e-3 * total
        move = np.linalg.solve(matrix, right)
        for i in range(4):
            place[i] += min(max(move[i], -0.03), 0.03)
    return cost


@njit(cache=True)
def _fit(cells, merged, rows, face, side, centre, slope, flange, found_turn, spread, tilt):  # type: ignore[no-untyped-def]
    corner, normal = np.empty((6, 2)), np.empty((4, 5))
    total = cells[:, 2].sum() + OUTLINE_WEIGHT * 2.0 * rows[:, 4].sum()
    mean_u = (cells[:, 0] * cells[:, 2]).sum() / cells[:, 2].sum()
    mean_v = (cells[:, 1] * cells[:, 2]).sum() / cells[:, 2].sum()
    tried = np.empty((TURNS * len(FLANGES_M), 5))
    place = np.zeros(4)
    n = 0
    for f in range(len(FLANGES_M)):
        for k in range(TURNS):
            place[0], place[1] = mean_u, mean_v
            cost = _place(merged, rows, face, side, FLANGES_M[f], k, place, 4)
            tried[n, 0], tried[n, 1], tried[n, 2] = cost, FLANGES_M[f], 2.0 * math.pi * k / TURNS
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
                if i == j == 0 and low < np.inf:  # was the best of the round before
                    continue
                outline(turn0 + j * size, b0 * (1.0 + i * size), corner)
                place[:] = kept
                cost = _settle(cells, rows, corner, place, normal, 2 if low < np.inf else 4)
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
    outline(turn, b, corner)
    cost = _step(cells, rows, corner, kept, normal)
    inverse = np.linalg.inv(normal[:, :4] + 1e-6 * total * np.eye(4))
    tilt[0] = math.sqrt((inverse[2, 2] + inverse[3, 3]) * cost / (len(cells) + 2 * len(rows)))
    flange[0], spread[0] = b, math.sqrt(variance + low / total / max(len(cells), 1))
