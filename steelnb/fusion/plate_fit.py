"""Plates: the fit of a plane to the points of a bar, and the choice between it and an angle section.

Lines in the points of decks and gussets look like bars. An angle section explains the depths of a plate about as well
as a plane does. But its thickness sets views from either side a centimetre apart, and so the poses that they were taken
from. A plate may be as thick as those poses drift, so it has one face, the one that most of its points lie on.
"""

import math

import numpy as np
from numba import njit

from steelnb.fusion.section_fit import DEPTH_SCALE_M, angle_cost, least_angle_cost, profiles
from steelnb.fusion.sections import cells_of

WIDTH_MIN_M, COST_SHARE_MAX, VIEWS_MIN, FEW_VIEWS_SHARE_MAX = 0.16, 1.5, 5, 0.75
"""Points are those of a plate if they spread at least so wide, and planes leave at most a share of the squared depths
that the best angle section leaves: the first one, or the second if they were seen from fewer directions (`sections`),
from which an angle may show one flange alone. Of 40 bars on plates of the report's tower (development seed 11) this
tells 22, the largest; of 340 on angles, there and on the tapered tower, none. Two of 210 members of the tapered tower
pass for plates up one face with seed 1."""
STEPS = 8


@njit(cache=True, nogil=True)
def fit_plates(histogram, length, fitted):  # type: ignore[no-untyped-def]
    """Replace the `Sections` that were ``fitted`` to the bars of a histogram ``(B, PARTS, VIEWS, CELLS, 4)`` by planes
    if their points are those of plates; ``length (B,)`` metres. The flange is then infinite, and the turn is the
    direction that the face looks in."""
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
    more points, their mean ``(3,)``, across and along the bar from its middle, and the normal towards the viewer.
    """
    points, share, bound = np.column_stack((cells[:, 0], cells[:, 1], cells[:, 5])), cells[:, 2], DEPTH_SCALE_M**2
    weight, is_front, normal = share.copy(), np.ones(len(cells), np.bool_), np.zeros(3)
    from_mean, middle, square = points.copy(), np.zeros(3), np.zeros(len(cells))
    for _ in range(STEPS):
        most = 0.0
        for front in (True, False):
            chosen = is_front == front
            total = weight[chosen].sum()
            if total > 0.0:
                mean = weight[chosen] @ points[chosen] / total
                from_mean[chosen] = points[chosen] - mean
                if total > most:
                    most = total
                    middle[:] = mean
        normal = np.linalg.eigh((from_mean * weight.reshape(-1, 1)).T @ from_mean)[1][:, 0].copy()
        square = (from_mean @ normal) ** 2
        weight = share * (bound / (bound + square)) ** 2  # Geman-McClure, as for angle sections
        is_front = cells[:, 3] * normal[0] + cells[:, 4] * normal[1] > 0.0
    if share[is_front].sum() < 0.5 * share.sum():
        normal = -normal
    beside = (from_mean[:, 1] * normal[0] - from_mean[:, 0] * normal[1]) / math.hypot(normal[0], normal[1])
    width = math.sqrt(12.0 * (share * beside * beside).sum() / share.sum())
    return (share * bound * square / (bound + square)).sum(), width, middle, normal
