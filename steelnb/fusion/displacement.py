"""How far a bar lies beside its place in a map, from the points that a flight has seen of it."""

import math

import numpy as np
from numba import njit
from scipy import stats

from steelnb.fusion import sections
from steelnb.fusion.known import KnownBars
from steelnb.types import Array

BENT = 0.01
"""One of the bars that have changed is bent, and has not moved, if the p-value of no bow is smaller."""
SIGMA_DEPTH_M, SIGMA_BESIDE_M, SIGMA_POINT_M = 0.004, 0.008, 0.02
"""Standard deviations of the place of a bar as seen from one direction, along a sixth of it: of its front faces, and of
the middle of its outline, which do not average out over points; and that of one point, which does."""
SIGMA_SHARE, SIGMA_M, SIGMA_BOW_M = 0.25, 0.003, 0.003
"""Systematic errors of the front faces of a mapped bar: a share of that of its axis, which sections seen from few sides
leave open, and a floor; and that of its straightness."""
FREE_SIGMA_M = 0.1
"""How far a bar may have moved in directions that its points do not tell."""
BESIDE_MAX_M, DEPTH_MAX_M = 0.03, 0.1
"""Points so far beside the outline of a bar, or before or behind its faces, are those of others."""
GROUP_POINTS_MIN, GROUPS_MIN, WHOLE_SHARE, STEP_MAX_M, STEPS = 20, 3, 0.8, 0.04, 8
"""Fewest points of a group and groups of a bar; least share of an outline whose middle counts; largest step of a face
within a cell; and steps of the solver. All settings were chosen on the development seeds 11 and 12."""


def displaced(histogram: Array, bars: KnownBars) -> tuple[Array, Array, Array, Array]:
    """Offset of each bar and its standard deviation, metres, and the p-values of no shift and of no bow, ``(B,)``; NaN
    for a bar with too few points.

    A displacement is a shift, a tilt and half a sine, across the bar. Whether there is any is told by the shift alone,
    which is the mean over the bar, also of a bent one: the ends of a bar hold points of others, above all where the map
    takes two bars for one, and would pass for a bow. Covariances are those of the measurements, enlarged where they
    contradict each other, and the systematic errors of the map.
    """
    n = len(bars)
    offset, sigma, p_moved, p_bent = np.full((4, n), np.nan)
    share = (np.arange(sections.PARTS) + 0.5) / sections.PARTS
    shape = np.stack([np.ones_like(share), 2 * share - 1, np.sin(np.pi * share)])  # (3, PARTS)
    for b in range(n):
        x, H, misfit, groups = _displacement(histogram[b], bars.corner[b], shape)
        if groups < GROUPS_MIN:
            continue
        spread, place = max(1.0, misfit / max(2 * groups - 6, 1)), (SIGMA_SHARE * bars.sigma_m[b]) ** 2 + SIGMA_M**2
        shift = np.linalg.solve(H[:2, :2], (H @ x)[:2])
        C = spread * np.linalg.inv(H[:2, :2]) + place * np.eye(2)
        bow = spread * np.linalg.inv(H)[4:, 4:] + SIGMA_BOW_M**2 * np.eye(2)
        p_moved[b] = stats.chi2.sf(shift @ np.linalg.solve(C, shift), 2)
        p_bent[b] = stats.chi2.sf(x[4:] @ np.linalg.solve(bow, x[4:]), 2)
        if p_bent[b] < BENT:
            shift, C = x[:2] + x[4:], C + bow
        offset[b] = np.linalg.norm(shift)
        sigma[b] = math.sqrt(shift @ C @ shift) / max(offset[b], 1e-12)
    return offset, sigma, p_moved, p_bent


@njit(cache=True)
def _displacement(histogram, corner, shape):  # type: ignore[no-untyped-def]
    """Least squares of the displacement (shift, tilt, bow; two coordinates each) of a bar from its histogram: the
    estimate ``(6,)``, its information ``(6, 6)``, the sum of squared residuals, and the number of groups of points,
    each seen from one direction on one part of the bar."""
    parts = len(histogram)
    x, H, g = np.zeros(6), np.zeros((6, 6)), np.zeros(6)
    J, misfit, groups = np.zeros(6), 0.0, 0
    for step in range(STEPS):
        H[:], g[:], misfit, groups = 0.0, 0.0, 0.0, 0
        for k in range(6):
            H[k, k] = FREE_SIGMA_M**-2.0
            g[k] = -x[k] * H[k, k]
        for part in range(parts):
            du = shape[0, part] * x[0] + shape[1, part] * x[2] + shape[2, part] * x[4]
            dv = shape[0, part] * x[1] + shape[1, part] * x[3] + shape[2, part] * x[5]
            for view in range(sections.VIEWS):
                h = histogram[part, view]
                angle = (view + 0.5) * 2.0 * math.pi / sections.VIEWS - math.pi
                cosine, sine = math.cos(angle), math.sin(angle)
                low, high = sections.extent(corner, cosine, sine)
                # The front faces: mean depth behind them, and mean derivatives.
                total, count, depth, au, av, beside = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                left, right = 1e9, -1e9
                for cell in range(sections.CELLS):
                    if h[cell, 0] < 1.0:
                        continue
                    u, v = h[cell, 2] / h[cell, 1] - du, h[cell, 3] / h[cell, 1] - dv
                    across = -sine * u + cosine * v
                    if across < low - BESIDE_MAX_M or across > high + BESIDE_MAX_M:
                        continue
                    total += h[cell, 0]
                    beside += h[cell, 0] * across
                    left, right = min(left, across), max(right, across)
                    front, rise = sections.front_face(corner, cosine, sine, across)
                    residual = cosine * u + sine * v - front
                    if front < -1e8 or abs(rise) > 2.0 or abs(residual) > DEPTH_MAX_M:
                        continue
                    before, _ = sections.front_face(corner, cosine, sine, across - sections.CELL_M)
                    after, _ = sections.front_face(corner, cosine, sine, across + sections.CELL_M)
                    if abs(after - before) > STEP_MAX_M:  # an edge: the mean of the cell is that of two faces
                        continue
                    count += h[cell, 0]
                    depth += h[cell, 0] * residual
                    au += h[cell, 0] * (cosine + rise * sine)
                    av += h[cell, 0] * (sine - rise * cosine)
                if total < GROUP_POINTS_MIN:
                    continue
                groups += 1
                for kind in range(2):
                    if kind == 0:
                        if count < 0.3 * total:
                            continue
                        r, a, b = depth / count, au / count, av / count
                        variance = SIGMA_DEPTH_M**2 + SIGMA_POINT_M**2 / count
                    else:
                        if right - left < WHOLE_SHARE * (high - low):  # partly hidden: its middle is not the outline's
                            continue
                        r, a, b = beside / total - 0.5 * (low + high), -sine, cosine
                        variance = SIGMA_BESIDE_M**2 + SIGMA_POINT_M**2 / total
                    for k in range(3):
                        J[2 * k], J[2 * k + 1] = shape[k, part] * a, shape[k, part] * b
                    misfit += r * r / variance
                    for k in range(6):
                        g[k] += J[k] * r / variance
                        for m in range(6):
                            H[k, m] += J[k] * J[m] / variance
        if step < STEPS - 1:
            x += np.linalg.solve(H, g)
    return x, H, misfit, groups
