"""Plates: the fit of a plane to the points of a bar, and the choice between it and an angle section.

Lines in the points of decks and gussets look like bars. An angle section explains the depths of a plate about as well
as a plane does. But its thickness sets the views of the two sides a centimetre apart, and with them the poses. How
thick a plate is cannot be told from the drift of those poses, so it has only one face, on the side with more points.
"""

import math

import numpy as np
from numba import njit

from steelnb.fusion.section_fit import angle_cost, least_angle_cost, profiles, robust
from steelnb.fusion.sections import cells_of

WIDTH_MIN_M, COST_SHARE_MAX, VIEWS_MIN, FEW_VIEWS_SHARE_MAX = 0.16, 1.5, 5, 0.75
"""A bar is a plate if its points spread at least this wide, and planes leave at most a share of the squared depths that
the best angle section leaves: the first share, or the second if the bar was seen from fewer directions than
`VIEWS_MIN`, from which an angle may show one flange alone. Of 40 bars on plates of the report's tower (development
seed 11) this tells 22, the largest; of 340 on angles, there and on the tapered tower, none. Two of 210 members of the
tapered tower pass for plates up one face with seed 1."""
SLOPE_MAX = 0.3
"""Largest slope of a plate along the bar: a line lies in its plate. A plane that the line pierces is none."""
STEPS = 8


@njit(cache=True, nogil=True)
def fit_plates(histogram, length, fitted):  # type: ignore[no-untyped-def]
    """Replace the `Sections` that were ``fitted`` to the bars of a histogram ``(B, PARTS, VIEWS, CELLS, 4)`` by planes
    if their points are those of plates; ``length (B,)`` metres. The flange is then infinite, and the turn is the
    direction that the plate faces."""
    face, side = profiles()
    for b in range(len(length)):
        if np.isnan(fitted.flange[b]):
            continue
        cells = cells_of(histogram[b], length[b])
        cost, width, middle, normal = fit_planes(cells)
        bound = COST_SHARE_MAX if np.unique(cells[:, 6]).size >= VIEWS_MIN else FEW_VIEWS_SHARE_MAX
        if not (width >= WIDTH_MIN_M and cost <= bound * angle_cost(cells, fitted, b)):  # saves a fit
            continue
        if cost <= bound * least_angle_cost(histogram[b], cells, face, side):
            across = normal[:2] / (normal[0] ** 2 + normal[1] ** 2)
            fitted.slope[b] = -normal[2] * across
            fitted.centre[b] = middle[:2] - middle[2] * fitted.slope[b]
            fitted.flange[b], fitted.turn[b] = np.inf, math.atan2(normal[1], normal[0])


@njit(cache=True)
def fit_planes(cells):  # type: ignore[no-untyped-def]
    """Fit a pair of parallel planes to the `cells_of` a bar, one to those seen from either side.

    Returns their cost and the width of the points across the bar, that of a uniform strip, metres; and of the side with
    more points, their mean ``(3,)``, across and along the bar from its middle, and the normal towards the viewer. The
    cost is infinite if the planes lie across the bar (`SLOPE_MAX`).
    """
    points, share = np.column_stack((cells[:, 0], cells[:, 1], cells[:, 5])), cells[:, 2].copy()
    loss, weight, towards, from_mean = share, share, np.ones(len(cells)), points.copy()
    normal, middle, fuller = np.zeros(3), np.zeros(3), np.ones(len(cells), np.bool_)
    for _ in range(STEPS):
        most = 0.0
        for front in (True, False):
            side = (towards > 0.0) == front
            total = weight[side].sum()
            if total > 0.0:
                mean = weight[side] @ points[side] / total
                from_mean[side] = points[side] - mean
                if total > most:
                    most, middle, fuller = total, mean, side
        normal = np.linalg.eigh((from_mean * weight.reshape(-1, 1)).T @ from_mean)[1][:, 0].copy()
        loss, weight = robust(from_mean @ normal, share)
        towards = cells[:, 3] * normal[0] + cells[:, 4] * normal[1]
    if towards[fuller].sum() < 0.0:
        normal = -normal
    across = math.hypot(normal[0], normal[1])
    if abs(normal[2]) > SLOPE_MAX * across:
        return np.inf, 0.0, middle, normal
    beside = (from_mean[:, 1] * normal[0] - from_mean[:, 0] * normal[1]) / across
    width = math.sqrt(12.0 * (share * beside * beside).sum() / share.sum())
    return loss.sum(), width, middle, normal
