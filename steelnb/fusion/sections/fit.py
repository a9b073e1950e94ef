"""The section of each bar: an angle, a round tube or a plate, whichever explains the depths of its points
(`fit_sections`).

An angle section (`fit_section`) has a flange, a rotation, and the position and slope of its axis, the line through the
centroids of its sections. The width of its outline and the depth of its near faces are fitted together, to the
histograms of `sections.histogram`. A grid search over flanges and rotations, which looks faces up in a table, is
followed by Gauss-Newton.

Its two flanges can follow an arc, and explain the depths of a plate about as well as a plane does. So the shapes are
compared by depths alone, to which the angle section is fitted again. A tube, or a plate seen from few directions, must
explain them clearly better.

At the position y beside its axis, the near face of a circle of radius r has the depth √(r² − y²). Depths alone thus
determine radius and axis, even if all are seen from one side.

Lines in the points of decks and gussets look like bars. Modelled as an angle section, a plate would have two faces a
centimetre apart, which would shift the poses that see either. A plate's thickness cannot be distinguished from the
drift of these poses, so a plate has only one face, on the side with more points.
"""

import math
from typing import NamedTuple

import numpy as np

from steelnb.core.kernels import njit
from steelnb.core.robust import weighted_geman_mcclure
from steelnb.core.types import Array, IntArray
from steelnb.fusion.sections.histogram import VIEWS, cells_of, direction_of, edges_of, merged_cells
from steelnb.fusion.sections.shapes import (
    ANGLE,
    PLATE,
    THICKNESS,
    TUBE,
    UNKNOWN,
    angle_outline,
    front_face,
    nearest_edge,
)

TURNS = VIEWS
"""Number of rotations in the search. A section rotated by one step looks the same from the next direction."""
PROFILE = 128
"""Number of cells of a face in the table of the search; each is at most 1.1 % of the flange wide."""
FLANGES_M = np.array([0.025, 0.032, 0.04, 0.05, 0.063, 0.08, 0.1, 0.125, 0.16, 0.2])
DEPTH_SCALE_M = 0.03
OUTLINE_WEIGHT = 0.5
"""Weight of an edge of the outline relative to all depths from its direction."""
ROUND_DOF = 5
"""Degrees of freedom of a round section: position (2), slope (2), radius. The rotation of an angle is searched for."""
RADIUS_MIN_M, RADIUS_MAX_M = 0.005, 0.15
"""Bounds of the radius."""
TELL_APART_M = 0.003
"""Fits whose root mean square residuals differ by much less are about equally likely, and are averaged."""


class Profiles(NamedTuple):
    """Table of the near face of an angle section with flange 1 from each direction: ``face (VIEWS, PROFILE, 2)``, depth
    and slope of `front_face` across its width, and ``side (VIEWS, 2)``, its two edges. ``thickness``: share of the
    flange. Other flanges follow by scaling, and other rotations by a shift of the direction."""

    thickness: float
    face: Array
    side: Array


@njit(cache=True)
def profiles(thickness):  # type: ignore[no-untyped-def]
    """The `Profiles` of angle sections of a ``thickness``."""
    corner = np.empty((6, 2))
    angle_outline(0.0, 1.0, thickness, corner)
    face, side = np.empty((VIEWS, PROFILE, 2)), np.empty((VIEWS, 2))
    for view in range(VIEWS):
        cosine, sine = direction_of(view)
        beside = -sine * corner[:, 0] + cosine * corner[:, 1]
        side[view, 0], side[view, 1] = beside.min(), beside.max()
        for k in range(PROFILE):
            at = side[view, 0] + (k + 0.5) / PROFILE * (side[view, 1] - side[view, 0])
            face[view, k, 0], face[view, k, 1], _ = front_face(ANGLE, corner, cosine, sine, at)
    return Profiles(thickness, face, side)


@njit(cache=True)
def robust(residual, weight):  # type: ignore[no-untyped-def]
    """Cost and weight of a residual, or of an array of them, under Geman-McClure with the scale `DEPTH_SCALE_M`."""
    weight, loss = weighted_geman_mcclure(residual * residual, DEPTH_SCALE_M * DEPTH_SCALE_M, weight)
    return loss, weight


@njit(cache=True)
def _gauss_newton_by_table(cells, rows, profile, flange, turn, state, steps):  # type: ignore[no-untyped-def]
    """`gauss_newton` without slopes, at the rotation number ``turn``, faces from the table `profiles`; in scalars."""
    face, side, cost = profile.face, profile.side, 0.0
    total = cells[:, 2].sum()
    for _ in range(steps):
        cost = uu = uv = vv = ru = rv = 0.0
        for k in range(len(cells)):
            cosine, sine = cells[k, 3], cells[k, 4]
            view = (int(cells[k, 6]) - turn) % VIEWS
            u, v = cells[k, 0] - state[0], cells[k, 1] - state[1]
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
            loss, weight = robust(residual, weight)
            cost += loss
            uu += weight * ju * ju
            uv += weight * ju * jv
            vv += weight * jv * jv
            ru -= weight * ju * residual
            rv -= weight * jv * residual
        for k in range(len(rows)):
            cosine, sine = rows[k, 2], rows[k, 3]
            view = (int(rows[k, 5]) - turn) % VIEWS
            middle = -sine * state[0] + cosine * state[1]
            for end in range(2):
                residual = rows[k, end] - middle - flange * side[view, end]
                loss, weight = robust(residual, OUTLINE_WEIGHT * rows[k, 4])
                cost += loss
                uu += weight * sine * sine
                uv -= weight * sine * cosine
                vv += weight * cosine * cosine
                ru -= weight * sine * residual
                rv += weight * cosine * residual
        uu += 1e-3 * total
        vv += 1e-3 * total
        determinant = uu * vv - uv * uv
        state[0] += min(max((vv * ru - uv * rv) / determinant, -0.03), 0.03)
        state[1] += min(max((uu * rv - uv * ru) / determinant, -0.03), 0.03)
    return cost


@njit(cache=True)
def section_step(cells, rows, corner, state, normal):  # type: ignore[no-untyped-def]
    """Cost of a section at ``state (D,)``: u, v, their slopes, and the radius of a round one; D = 4 or 5.

    Fills the normal equations ``(D, D + 1)``.
    """
    normal[:, :] = 0.0
    cost, kind = 0.0, TUBE if len(state) == ROUND_DOF else ANGLE
    jacobian = np.zeros(len(state))
    for k in range(len(cells)):
        cosine, sine, along = cells[k, 3], cells[k, 4], cells[k, 5]
        u, v = cells[k, 0] - state[0] - along * state[2], cells[k, 1] - state[1] - along * state[3]
        beside, depth = -sine * u + cosine * v, cosine * u + sine * v
        front, rise, _ = front_face(kind, corner, cosine, sine, beside)
        weight = cells[k, 2]
        if front > -1e8:
            residual = depth - front
            ju, jv = -cosine - rise * sine, -sine + rise * cosine
            weight /= 1.0 + rise * rise
            if kind == TUBE:
                jacobian[4] = -state[4] / front
        else:  # beside the section
            edge = nearest_edge(kind, corner, cosine, sine, beside)
            residual = beside - edge
            ju, jv = sine, -cosine
            if kind == TUBE:
                jacobian[4] = -math.copysign(1.0, edge)
        jacobian[0], jacobian[1], jacobian[2], jacobian[3] = ju, jv, ju * along, jv * along
        cost += _add_residual(normal, jacobian, residual, weight)
    for k in range(len(rows)):
        cosine, sine = rows[k, 2], rows[k, 3]
        low, high = 1e9, -1e9
        for i in range(6):
            beside = -sine * (corner[i, 0] + state[0]) + cosine * (corner[i, 1] + state[1])
            low, high = min(low, beside), max(high, beside)
        jacobian[0], jacobian[1], jacobian[2], jacobian[3] = sine, -cosine, 0.0, 0.0
        cost += _add_residual(normal, jacobian, rows[k, 0] - low, OUTLINE_WEIGHT * rows[k, 4])
        cost += _add_residual(normal, jacobian, rows[k, 1] - high, OUTLINE_WEIGHT * rows[k, 4])
    return cost


@njit(cache=True)
def _add_residual(normal, jacobian, residual, weight):  # type: ignore[no-untyped-def]
    """Add a residual with its Jacobian ``(D,)`` to normal equations ``(D, D + 1)``; returns its `robust` cost."""
    size = len(jacobian)
    loss, weight = robust(residual, weight)
    for i in range(size):
        for j in range(size):
            normal[i, j] += weight * jacobian[i] * jacobian[j]
        normal[i, size] -= weight * jacobian[i] * residual
    return loss


@njit(cache=True)
def gauss_newton(cells, rows, corner, state, normal, total, steps):  # type: ignore[no-untyped-def]
    """Damped Gauss-Newton from ``state (D,)``, in place, at most 3 cm or 0.03 a step. Returns the cost before the last.

    ``total``: weight of all points. The ``corner`` of a round section follows its radius.
    """
    cost, size = 0.0, len(state)
    for _ in range(steps):
        cost = section_step(cells, rows, corner, state, normal)
        step = np.linalg.solve(normal[:, :size] + 1e-3 * total * np.eye(size), normal[:, size].copy())
        state += np.minimum(np.maximum(step, -0.03), 0.03)
        if size == ROUND_DOF:
            corner[0, 0] = state[4] = min(max(state[4], RADIUS_MIN_M), RADIUS_MAX_M)
    return cost


@njit(cache=True)
def fit_section(cells, merged, rows, profile, centre, slope):  # type: ignore[no-untyped-def]
    """Fit an angle section to the `cells_of` and `edges_of` a bar, after a search that uses its `merged_cells` and the
    `Profiles`, whose thickness it has.

    Returns flange, turn, spread and tilt (`fit.Sections`), and the least cost; fills ``centre (2,)`` and
    ``slope (2,)``.
    """
    corner, normal = np.empty((6, 2)), np.empty((4, 5))
    inside = cells[:, 2].sum()
    total = inside + OUTLINE_WEIGHT * 2.0 * rows[:, 4].sum()
    mean_u, mean_v = (cells[:, 0] * cells[:, 2]).sum() / inside, (cells[:, 1] * cells[:, 2]).sum() / inside
    tried = np.empty((TURNS * len(FLANGES_M), 5))
    state = np.zeros(4)
    for n in range(len(tried)):
        f, k = n // TURNS, n % TURNS
        state[0], state[1] = mean_u, mean_v
        cost = _gauss_newton_by_table(merged, rows, profile, FLANGES_M[f], k, state, 4)
        tried[n, 0], tried[n, 1], tried[n, 2] = cost, FLANGES_M[f], 2.0 * math.pi * k / TURNS
        tried[n, 3:] = state[:2]
    best = np.argmin(tried[:, 0])
    low, flange, turn = np.inf, tried[best, 1], tried[best, 2]
    state[:2] = tried[best, 3:]
    best_state = state.copy()
    for size in (0.12, 0.06, 0.03):  # relative to the flange, and radians
        flange0, turn0 = flange, turn
        for i in range(-1, 2):
            for j in range(-1, 2):
                if i == j == 0 and low < np.inf:  # the best of the previous round
                    continue
                angle_outline(turn0 + j * size, flange0 * (1.0 + i * size), profile.thickness, corner)
                state[:] = best_state
                cost = gauss_newton(cells, rows, corner, state, normal, inside, 2 if low < np.inf else 4)
                if cost < low:
                    low, flange, turn = cost, flange0 * (1.0 + i * size), turn0 + j * size
                    best_state[:] = state
    # Mean and spread of all fits in the search, weighted by likelihood.
    weight = np.exp(-0.5 * (tried[:, 0] - tried[:, 0].min()) / total / (TELL_APART_M * TELL_APART_M))
    u, v = (weight * tried[:, 3]).sum() / weight.sum(), (weight * tried[:, 4]).sum() / weight.sum()
    square = (weight * (tried[:, 3] ** 2 + tried[:, 4] ** 2)).sum() / weight.sum()
    variance = max(square - u * u - v * v, 0.0)
    centre[0], centre[1] = best_state[0] + u - tried[best, 3], best_state[1] + v - tried[best, 4]
    slope[0], slope[1] = best_state[2], best_state[3]
    # Standard deviation of the direction, from the actual residuals.
    angle_outline(turn, flange, profile.thickness, corner)
    cost = section_step(cells, rows, corner, best_state, normal)
    inverse = np.linalg.inv(normal[:, :4] + 1e-6 * total * np.eye(4))
    tilt = math.sqrt((inverse[2, 2] + inverse[3, 3]) * cost / (len(cells) + 2 * len(rows)))
    return flange, turn, math.sqrt(variance + low / total / max(len(cells), 1)), tilt, low


RADII_M = np.array([0.015, 0.03, 0.06, 0.12])
"""Initial radii of the search."""
TUBE_MAX_M = float(RADII_M.max())
"""Maximum radius of a tube. Circles fitted to nearly flat faces have radii of 14 cm and more."""
CLEARLY_BETTER, LIKELIHOOD_MIN = 0.75, 25.0
"""A bar is round if the cost of a circle is at most this share of that of the best angle section, and if its
log-likelihood is larger by this much: minus half the number of cells times the logarithm of the share, as for normal
residuals of unknown variance. In 7000 fits to angle sections (development seeds 11 and 12, both sensors and flights,
true and corrected poses), the smallest share above 100 cells was 0.86, and the largest log-likelihood ratio 15."""
SEARCH_STEPS, CIRCLE_STEPS = 10, 6
PLATE_MIN_M, PLATE_SHARE_MAX, VIEWS_MIN = 0.16, 1.5, 5
"""A bar is a plate if its points are at least this wide, and the cost of planes is at most a share of that of the best
angle section: `PLATE_SHARE_MAX`, or `CLEARLY_BETTER` if the bar was seen from fewer than `VIEWS_MIN` directions, from
which only one flange of an angle may be visible. Of 40 bars on plates of the report's tower (development seed 11), this
recognises the 22 largest; of 340 on angles, there and on the tapered tower, it accepts none. On a flight up one face of
the tapered tower (seed 1), it mistakes two of 210 members for plates."""
SLOPE_MAX = 0.3
"""Largest slope of a plate along the bar. A plane that the line of the bar pierces is not a plate."""
PLANE_STEPS = 8


class Sections(NamedTuple):
    """Sections fitted to B bars; ``kind (B,)`` of each (`sections.shapes`), unknown with too few points.

    ``centre (B, 2)``: position of the axis across the bar, in the middle of its length, metres; ``slope (B, 2)``,
    metres per metre; ``flange (B,)``, metres, and ``turn (B,)``, radians, NaN if the kind has none; ``spread (B,)`` and
    ``tilt (B,)``: standard deviations of the position of the axis, metres, and of its direction, radians.
    """

    kind: IntArray
    centre: Array
    slope: Array
    flange: Array
    turn: Array
    spread: Array
    tilt: Array


@njit(cache=True, nogil=True)
def fit_sections(histogram, length, thickness=THICKNESS):  # type: ignore[no-untyped-def]
    """Fit `Sections` to the bars of a histogram ``(B, PARTS, VIEWS, CELLS, 4)``; ``length (B,)`` metres; ``thickness``
    of angle sections as a share of their flanges.

    The bars of one structure resemble each other, and a thin bar seen from one side has little information. So if some
    bar is clearly round, the pooled likelihood decides on all others, except those that clearly are angle sections.
    """
    n = len(length)
    none = np.full((3, n), np.nan)
    fitted = Sections(np.full(n, UNKNOWN), np.zeros((n, 2)), np.zeros((n, 2)), none[0], np.zeros(n), none[1], none[2])
    profile = profiles(thickness)
    state, normal, cost = np.empty((n, ROUND_DOF)), np.empty((n, ROUND_DOF, ROUND_DOF + 1)), np.empty(n)
    likelihood, is_round = np.full(n, -np.inf), np.zeros(n, np.bool_)
    for b in range(n):
        cells, rows, merged = cells_of(histogram[b], length[b]), edges_of(histogram[b]), merged_cells(histogram[b])
        if len(cells) < 8 or len(rows) < 1:
            continue
        fitted.flange[b], fitted.turn[b], fitted.spread[b], fitted.tilt[b], _ = fit_section(
            cells, merged, rows, profile, fitted.centre[b], fitted.slope[b]
        )
        fitted.kind[b] = ANGLE
        angle = angle_cost(cells, fitted, b, thickness)
        if _make_plate(fitted, b, cells, merged, angle, profile):
            continue
        cost[b] = fit_circle(cells, merged, state[b], normal[b])
        if state[b, 4] > TUBE_MAX_M:
            continue
        likelihood[b] = np.nan  # as yet
        bound = min(CLEARLY_BETTER, math.exp(-2.0 * LIKELIHOOD_MIN / len(cells)))
        if cost[b] <= bound * angle:  # false for most bars, and saves a fit
            least = least_angle_cost(cells, merged, profile)
            likelihood[b] = 0.5 * len(cells) * math.log(least / cost[b])
            is_round[b] = cost[b] <= bound * least
    if not is_round.any():
        return fitted
    pooled = 0.0
    for b in range(n):
        if np.isnan(likelihood[b]):
            cells = cells_of(histogram[b], length[b])
            least = least_angle_cost(cells, merged_cells(histogram[b]), profile)
            likelihood[b] = 0.5 * len(cells) * math.log(least / cost[b])
        if likelihood[b] > -np.inf:
            pooled += likelihood[b]
    for b in range(n):
        if is_round[b] or (pooled > 0.0 and likelihood[b] > -LIKELIHOOD_MIN):
            _make_round(fitted, b, cells_of(histogram[b], length[b]), cost[b], state[b], normal[b])
    return fitted


@njit(cache=True)
def angle_cost(cells, fitted, b, thickness):  # type: ignore[no-untyped-def]
    """Cost of the depths for the angle section of bar b as fitted to depths and edges."""
    corner, state = np.empty((6, 2)), np.empty(4)
    angle_outline(fitted.turn[b], fitted.flange[b], thickness, corner)
    state[:2], state[2:] = fitted.centre[b], fitted.slope[b]
    return section_step(cells, np.empty((0, 6)), corner, state, np.empty((4, 5)))


@njit(cache=True)
def least_angle_cost(cells, merged, profile):  # type: ignore[no-untyped-def]
    """Cost of an angle section that is fitted to the depths alone."""
    return fit_section(cells, merged, np.empty((0, 6)), profile, np.empty(2), np.empty(2))[4]


@njit(cache=True)
def _make_plate(fitted, b, cells, merged, angle, profile):  # type: ignore[no-untyped-def]
    """Replace the section of bar b by a plane if its points are those of a plate; returns whether they are.

    ``angle``: its `angle_cost`.
    """
    cost, width, middle, normal = fit_planes(cells)
    bound = PLATE_SHARE_MAX if np.unique(cells[:, 6]).size >= VIEWS_MIN else CLEARLY_BETTER
    if not (width >= PLATE_MIN_M and cost <= bound * angle):  # saves a fit
        return False
    if not cost <= bound * least_angle_cost(cells, merged, profile):
        return False
    across = normal[:2] / (normal[0] ** 2 + normal[1] ** 2)
    fitted.slope[b] = -normal[2] * across
    fitted.centre[b] = middle[:2] - middle[2] * fitted.slope[b]
    fitted.kind[b], fitted.flange[b], fitted.turn[b] = PLATE, np.nan, math.atan2(normal[1], normal[0])
    return True


@njit(cache=True)
def fit_planes(cells):  # type: ignore[no-untyped-def]
    """Fit a pair of parallel planes to the `cells_of` a bar, one to the cells seen from each side.

    Returns their cost; the width of the points across the bar, as of a uniform strip, metres; and for the side with
    more points, their mean ``(3,)``, across and along the bar from its middle, and the normal towards the viewer. The
    cost is infinite if the planes are too steep along the bar (`SLOPE_MAX`).
    """
    points, share = np.column_stack((cells[:, 0], cells[:, 1], cells[:, 5])), cells[:, 2].copy()
    loss, weight, towards, from_mean = share, share, np.ones(len(cells)), points.copy()
    normal, middle, fuller = np.zeros(3), np.zeros(3), np.ones(len(cells), np.bool_)
    for _ in range(PLANE_STEPS):
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


@njit(cache=True)
def _make_round(fitted, b, cells, cost, state, normal):  # type: ignore[no-untyped-def]
    """Replace the section of bar b by a circle at ``state (5,)``."""
    total = cells[:, 2].sum()
    inverse = np.linalg.inv(normal[:, :ROUND_DOF] + 1e-6 * total * np.eye(ROUND_DOF)) * cost / len(cells)
    fitted.centre[b], fitted.slope[b] = state[:2], state[2:4]
    fitted.kind[b], fitted.flange[b], fitted.turn[b] = TUBE, 2.0 * state[4], np.nan
    fitted.spread[b] = math.sqrt(inverse[0, 0] + inverse[1, 1])
    fitted.tilt[b] = math.sqrt(inverse[2, 2] + inverse[3, 3])


@njit(cache=True)
def fit_circle(cells, merged, state, normal):  # type: ignore[no-untyped-def]
    """Fit a circle to the `cells_of` a bar, after a search with its `merged_cells`; returns the cost.

    Fills ``state (5,)`` (u, v, their slopes, radius) and the normal equations ``(5, 6)`` at that state.
    """
    total, low, start = cells[:, 2].sum(), np.inf, np.zeros(ROUND_DOF)
    no_edges, corner = np.empty((0, 6)), np.zeros((6, 2))
    u = (merged[:, 0] * merged[:, 2]).sum() / merged[:, 2].sum()
    v = (merged[:, 1] * merged[:, 2]).sum() / merged[:, 2].sum()
    for k in range(len(RADII_M)):
        state[0], state[1], state[2], state[3] = u, v, 0.0, 0.0
        corner[0, 0] = state[4] = RADII_M[k]
        gauss_newton(merged, no_edges, corner, state, normal, total, SEARCH_STEPS)
        cost = section_step(merged, no_edges, corner, state, normal)
        if cost < low:
            low = cost
            start[:] = state
    state[:] = start
    corner[0, 0] = state[4]
    gauss_newton(cells, no_edges, corner, state, normal, total, CIRCLE_STEPS)
    return section_step(cells, no_edges, corner, state, normal)
