"""Round tubes: least-squares fit of a circle to the points of a bar, and the choice between it and an angle section.

The near face of a circle of radius r lies at the depth √(r² − y²) at a place y beside its axis. So depths alone tell
its radius and its axis, from one side as well as from all. The two flanges of an angle section, which needs the edges
of its outline, too (`fusion.section_fit`), may follow an arc. So the two are compared by depths alone, to which the
angle section is fitted anew, free of the edges; and where both explain them about as well, the bar is taken for an
angle section.
"""

import math

import numpy as np
from numba import njit

from steelnb.fusion.section_fit import fit_section, profiles, robust, section_step
from steelnb.fusion.sections import cells_of, merged_cells, outline

RADII_M = np.array([0.015, 0.03, 0.06, 0.12])
"""Where the search starts."""
RADIUS_MIN_M, RADIUS_MAX_M, WIDEST_M = 0.005, 0.15, 0.12
"""Bounds of the search, and the largest radius of a tube: nearly flat faces are arcs of 14 cm and more, and one of them
was taken for a tube on the development seed 13."""
COST_SHARE_MAX, LIKELIHOOD_MIN = 0.75, 25.0
"""A bar is round if a circle leaves at most this share of the squared depths that the best angle section leaves, and is
likelier by so much: half the number of cells times the logarithm of that share, as normal residuals of unknown variance
have it. In 7000 fits to angle sections with the development seeds 11 and 12, both sensors and flights, with true and
with corrected poses, the least share beyond 100 cells was 0.86, and the largest likelihood 15."""
SEARCH_STEPS, STEPS = 10, 6
PLACE = 5
"""Unknowns: two of place, two of slope, and the radius."""


@njit(cache=True, nogil=True)
def fit_rounds(histogram, length, fitted):  # type: ignore[no-untyped-def]
    """Put the circle in place of the `Sections` that were ``fitted`` to the bars of a histogram ``(B, PARTS, VIEWS,
    CELLS, 4)`` where their points are those of a round tube; ``length (B,)`` metres. Its diameter stands for the
    flange, and its turn is NaN.

    The bars of one structure resemble each other, and a thin bar seen from one side tells little. So where some bar is
    clearly round, the likelihoods of all bars together say what the others are, unless one of them clearly differs.
    """
    face, side = profiles()
    n = len(length)
    place, normal, cost = np.empty((n, PLACE)), np.empty((n, PLACE, PLACE + 1)), np.empty(n)  # of the circles
    unclear, pooled = np.zeros(n, np.bool_), 0.0
    for b in range(n):
        if np.isnan(fitted.flange[b]):
            continue
        cells = cells_of(histogram[b], length[b])
        cost[b] = fit_circle(cells, merged_cells(histogram[b]), place[b], normal[b])
        if place[b, 4] > WIDEST_M:
            continue
        unclear[b] = True
        bound = min(COST_SHARE_MAX, math.exp(-2.0 * LIKELIHOOD_MIN / len(cells)))
        if not cost[b] <= bound * _angle_cost(cells, fitted, b):
            continue  # most bars, whose sections need not be fitted again
        least = _least_angle_cost(histogram[b], cells, face, side)
        if cost[b] <= bound * least:
            unclear[b] = False
            pooled += 0.5 * len(cells) * math.log(least / cost[b])
            _make_round(fitted, b, cells, cost[b], place[b], normal[b])
    if pooled == 0.0:
        return
    likelihood = np.zeros(n)
    for b in range(n):
        if unclear[b]:
            cells = cells_of(histogram[b], length[b])
            least = _least_angle_cost(histogram[b], cells, face, side)
            likelihood[b] = 0.5 * len(cells) * math.log(least / cost[b])
            pooled += likelihood[b]
    if pooled <= 0.0:
        return
    for b in range(n):
        if unclear[b] and likelihood[b] > -LIKELIHOOD_MIN:
            _make_round(fitted, b, cells_of(histogram[b], length[b]), cost[b], place[b], normal[b])


@njit(cache=True)
def _angle_cost(cells, fitted, b):  # type: ignore[no-untyped-def]
    """Cost of the depths alone at the section that was fitted to depths and edges."""
    corner, place = np.empty((6, 2)), np.empty(4)
    outline(fitted.turn[b], fitted.flange[b], corner)
    place[:2], place[2:] = fitted.centre[b], fitted.slope[b]
    return section_step(cells, np.empty((0, 6)), corner, place, np.empty((4, 5)))


@njit(cache=True)
def _least_angle_cost(histogram, cells, face, side):  # type: ignore[no-untyped-def]
    """Cost of an angle section that is fitted to the depths alone."""
    return fit_section(cells, merged_cells(histogram), np.empty((0, 6)), face, side, np.empty(2), np.empty(2))[4]


@njit(cache=True)
def _make_round(fitted, b, cells, cost, place, normal):  # type: ignore[no-untyped-def]
    """Put a circle at ``place (5,)`` in place of the section of bar b."""
    total = cells[:, 2].sum()
    inverse = np.linalg.inv(normal[:, :PLACE] + 1e-6 * total * np.eye(PLACE)) * cost / len(cells)
    fitted.centre[b], fitted.slope[b] = place[:2], place[2:4]
    fitted.flange[b], fitted.turn[b] = 2.0 * place[4], np.nan
    fitted.spread[b] = math.sqrt(inverse[0, 0] + inverse[1, 1])
    fitted.tilt[b] = math.sqrt(inverse[2, 2] + inverse[3, 3])


@njit(cache=True)
def fit_circle(cells, merged, place, normal):  # type: ignore[no-untyped-def]
    """Fit a circle to the `cells_of` a bar from those of its whole length at once; fills ``place (5,)`` (u, v, their
    slopes, radius) and the normal equations ``(5, 6)`` there. The cost."""
    total, low, start = cells[:, 2].sum(), np.inf, np.zeros(PLACE)
    u = (merged[:, 0] * merged[:, 2]).sum() / merged[:, 2].sum()
    v = (merged[:, 1] * merged[:, 2]).sum() / merged[:, 2].sum()
    for k in range(len(RADII_M)):
        place[0], place[1], place[2], place[3], place[4] = u, v, 0.0, 0.0, RADII_M[k]
        for _ in range(SEARCH_STEPS):
            circle_step(merged, place, normal)
            _move(place, normal, total)
        cost = circle_step(merged, place, normal)
        if cost < low:
            low = cost
            start[:] = place
    place[:] = start
    for _ in range(STEPS):
        circle_step(cells, place, normal)
        _move(place, normal, total)
    return circle_step(cells, place, normal)


@njit(cache=True)
def _move(place, normal, total):  # type: ignore[no-untyped-def]
    step = np.linalg.solve(normal[:, :PLACE] + 1e-3 * total * np.eye(PLACE), normal[:, PLACE].copy())
    place += np.minimum(np.maximum(step, -0.03), 0.03)
    place[4] = min(max(place[4], RADIUS_MIN_M), RADIUS_MAX_M)


@njit(cache=True)
def circle_step(cells, place, normal):  # type: ignore[no-untyped-def]
    """Cost of a circle at ``place``; fills the normal equations ``(5, 6)``."""
    normal[:, :] = 0.0
    cost, radius, jacobian = 0.0, place[4], np.empty(PLACE)
    for k in range(len(cells)):
        cosine, sine, along = cells[k, 3], cells[k, 4], cells[k, 5]
        u, v = cells[k, 0] - place[0] - along * place[2], cells[k, 1] - place[1] - along * place[3]
        beside, weight = -sine * u + cosine * v, cells[k, 2]
        if abs(beside) < 0.999 * radius:
            front = math.sqrt(radius * radius - beside * beside)
            residual, rise = cosine * u + sine * v - front, -beside / front
            ju, jv, jr = -cosine - rise * sine, -sine + rise * cosine, -radius / front
            weight /= 1.0 + rise * rise
        else:  # beside the tube
            side = math.copysign(1.0, beside)
            residual = beside - side * radius
            ju, jv, jr = sine, -cosine, -side
        loss, weight = robust(residual, weight)
        cost += loss
        jacobian[0], jacobian[1], jacobian[2], jacobian[3], jacobian[4] = ju, jv, ju * along, jv * along, jr
        for i in range(PLACE):
            for j in range(PLACE):
                normal[i, j] += weight * jacobian[i] * jacobian[j]
            normal[i, PLACE] -= weight * jacobian[i] * residual
    return cost
