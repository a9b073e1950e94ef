"""Round tubes: least-squares fit of a circle to the points of a bar, and the choice between it and an angle section.

The near face of a circle of radius r lies at the depth √(r² − y²) at the position y beside its axis. So depths alone
determine radius and axis, from one side as well as from all. An angle section is fitted to depths and to the edges of
its outline (`fusion.section_fit`). Its two flanges may follow an arc, too. So the two are compared by depths alone, to
which the angle section is fitted anew. If both explain them about as well, the bar is an angle section.
"""

import math

import numpy as np
from numba import njit

from steelnb.fusion.section_fit import ROUND_DOF, angle_cost, least_angle_cost, profiles, section_step, settle
from steelnb.fusion.sections import cells_of, merged_cells

RADII_M = np.array([0.015, 0.03, 0.06, 0.12])
"""Initial radii of the search."""
TUBE_MAX_M = 0.12
"""Maximum radius of a tube: nearly flat faces are arcs of 14 cm and more."""
COST_SHARE_MAX, LIKELIHOOD_MIN = 0.75, 25.0
"""A bar is round if a circle leaves at most this share of the squared depths that the best angle section leaves, and if
its log-likelihood is larger by this much: half the number of cells times the logarithm of the share, as for normal
residuals of unknown variance. In 7000 fits to angle sections (development seeds 11 and 12, both sensors and flights,
true and corrected poses) the least share beyond 100 cells was 0.86, and the largest log-likelihood 15."""
SEARCH_STEPS, CIRCLE_STEPS = 10, 6


@njit(cache=True, nogil=True)
def fit_rounds(histogram, length, fitted):  # type: ignore[no-untyped-def]
    """Replace the `Sections` that were ``fitted`` to the bars of a histogram ``(B, PARTS, VIEWS, CELLS, 4)`` by circles
    if their points are those of round tubes; ``length (B,)`` metres. The flange is then the diameter, the turn NaN.

    The bars of one structure resemble each other, and a thin bar seen from one side has little information. So if some
    bar is clearly round, the likelihoods of all bars together decide on the others, unless one of them clearly differs.
    """
    face, side = profiles()
    n = len(length)
    state, normal, cost = np.empty((n, ROUND_DOF)), np.empty((n, ROUND_DOF, ROUND_DOF + 1)), np.empty(n)
    likelihood, is_round = np.full(n, -np.inf), np.zeros(n, np.bool_)
    for b in range(n):
        if not np.isfinite(fitted.flange[b]):
            continue
        cells = cells_of(histogram[b], length[b])
        cost[b] = fit_circle(cells, merged_cells(histogram[b]), state[b], normal[b])
        if state[b, 4] > TUBE_MAX_M:
            continue
        likelihood[b] = np.nan  # as yet
        bound = min(COST_SHARE_MAX, math.exp(-2.0 * LIKELIHOOD_MIN / len(cells)))
        if cost[b] <= bound * angle_cost(cells, fitted, b):  # false for most bars, and saves a fit
            least = least_angle_cost(histogram[b], cells, face, side)
            likelihood[b] = 0.5 * len(cells) * math.log(least / cost[b])
            is_round[b] = cost[b] <= bound * least
    if not is_round.any():
        return
    pooled = 0.0
    for b in range(n):
        if np.isnan(likelihood[b]):
            cells = cells_of(histogram[b], length[b])
            least = least_angle_cost(histogram[b], cells, face, side)
            likelihood[b] = 0.5 * len(cells) * math.log(least / cost[b])
        if likelihood[b] > -np.inf:
            pooled += likelihood[b]
    for b in range(n):
        if is_round[b] or (pooled > 0.0 and likelihood[b] > -LIKELIHOOD_MIN):
            _make_round(fitted, b, cells_of(histogram[b], length[b]), cost[b], state[b], normal[b])


@njit(cache=True)
def _make_round(fitted, b, cells, cost, state, normal):  # type: ignore[no-untyped-def]
    """Replace the section of bar b by a circle at ``state (5,)``."""
    total = cells[:, 2].sum()
    inverse = np.linalg.inv(normal[:, :ROUND_DOF] + 1e-6 * total * np.eye(ROUND_DOF)) * cost / len(cells)
    fitted.centre[b], fitted.slope[b] = state[:2], state[2:4]
    fitted.flange[b], fitted.turn[b] = 2.0 * state[4], np.nan
    fitted.spread[b] = math.sqrt(inverse[0, 0] + inverse[1, 1])
    fitted.tilt[b] = math.sqrt(inverse[2, 2] + inverse[3, 3])


@njit(cache=True)
def fit_circle(cells, merged, state, normal):  # type: ignore[no-untyped-def]
    """Fit a circle to the `cells_of` a bar, after a search with its `merged_cells`; returns the cost.

    Fills ``state (5,)`` (u, v, their slopes, radius) and the normal equations ``(5, 6)`` there.
    """
    total, low, start = cells[:, 2].sum(), np.inf, np.zeros(ROUND_DOF)
    no_edges, corner = np.empty((0, 6)), np.full((6, 2), np.nan)
    u = (merged[:, 0] * merged[:, 2]).sum() / merged[:, 2].sum()
    v = (merged[:, 1] * merged[:, 2]).sum() / merged[:, 2].sum()
    for k in range(len(RADII_M)):
        state[0], state[1], state[2], state[3] = u, v, 0.0, 0.0
        corner[0, 0] = state[4] = RADII_M[k]
        settle(merged, no_edges, corner, state, normal, total, SEARCH_STEPS)
        cost = section_step(merged, no_edges, corner, state, normal)
        if cost < low:
            low = cost
            start[:] = state
    state[:] = start
    corner[0, 0] = state[4]
    settle(cells, no_edges, corner, state, normal, total, CIRCLE_STEPS)
    return section_step(cells, no_edges, corner, state, normal)
