"""Compiled parts of the sorting of lines: cut at gaps, merge parallel copies, fit and keep what passes.

A piece is a row (first, one past last) of positions in ``order``, which holds indices of points.
"""

import math

import numpy as np
from numba import njit

from steelnb.hough.kernels import fit_line, principal_axis

MERGE_ANGLE_COS = math.cos(math.radians(10))
"""Short copies are tilted by up to dx over their length, but a brace that meets a leg is not a copy of it."""


@njit(cache=True)
def cut(px, py, pz, order, begin, anchor, direction, gap_max, min_points):
    """Sort the points of each line along it, in place in ``order``; rows (first, one past last) of the pieces in it."""
    piece = np.empty((len(order) // min_points + 1, 2), np.int64)
    pieces = 0
    for line in range(len(anchor)):
        members = order[begin[line] : begin[line + 1]]
        along_line = np.empty(len(members))
        for k in range(len(members)):
            i = members[k]
            along_line[k] = (
                (px[i] - anchor[line, 0]) * direction[line, 0]
                + (py[i] - anchor[line, 1]) * direction[line, 1]
                + (pz[i] - anchor[line, 2]) * direction[line, 2]
            )
        sorting = np.argsort(along_line, kind="mergesort")
        members[:] = members[sorting]
        first = 0
        for k in range(1, len(members) + 1):
            if k < len(members) and along_line[sorting[k]] - along_line[sorting[k - 1]] <= gap_max:
                continue
            if k - first >= min_points:
                piece[pieces, 0], piece[pieces, 1] = begin[line] + first, begin[line] + k
                pieces += 1
            first = k
    return piece[:pieces]


@njit(cache=True)
def moments(px, py, pz, chosen):
    """Count, mean and the six sums of squares and products about the mean, of some points."""
    m = np.zeros(10)
    m[0] = len(chosen)
    for i in chosen:
        m[1] += px[i]
        m[2] += py[i]
        m[3] += pz[i]
    m[1:4] /= m[0]
    for i in chosen:
        x, y, z = px[i] - m[1], py[i] - m[2], pz[i] - m[3]
        m[4] += x * x
        m[5] += x * y
        m[6] += x * z
        m[7] += y * y
        m[8] += y * z
        m[9] += z * z
    return m


@njit(cache=True)
def add(a, b):
    """Moments of two sets of points together: exact, since the sums about the means only move by the parallel-axis
    theorem."""
    n = a[0] + b[0]
    x, y, z = b[1] - a[1], b[2] - a[2], b[3] - a[3]
    w = a[0] * b[0] / n
    m = a + b
    m[1], m[2], m[3] = a[1] + x * b[0] / n, a[2] + y * b[0] / n, a[3] + z * b[0] / n
    m[4] += w * x * x
    m[5] += w * x * y
    m[6] += w * x * z
    m[7] += w * y * y
    m[8] += w * y * z
    m[9] += w * z * z
    return m


@njit(cache=True)
def _span(px, py, pz, chosen, m, u):
    """First and last position of points along the axis through the mean of ``m`` with direction ``u``."""
    low, high = np.inf, -np.inf
    for i in chosen:
        t = (px[i] - m[1]) * u[0] + (py[i] - m[2]) * u[1] + (pz[i] - m[3]) * u[2]
        low, high = min(low, t), max(high, t)
    return low, high


@njit(cache=True)
def merge(px, py, pz, order, piece, distance, gap_max):
    """Join the pieces that are copies of one bar: (points of the groups one after the other, rows as of `cut`).

    The piece with most points comes first and takes in every piece of nearly its direction whose two ends are within
    ``distance`` of its axis and which leaves no gap along it, then again with the axis of both, until none is left.
    """
    n = len(piece)
    moment, axis, ends = np.empty((n, 10)), np.empty((n, 3)), np.empty((n, 2, 3))
    for k in range(n):
        chosen = order[piece[k, 0] : piece[k, 1]]
        m = moments(px, py, pz, chosen)
        _, _, axis[k, 0], axis[k, 1], axis[k, 2] = principal_axis(m[4], m[5], m[6], m[7], m[8], m[9])
        low, high = _span(px, py, pz, chosen, m, axis[k])
        moment[k] = m
        ends[k, 0], ends[k, 1] = m[1:4] + low * axis[k], m[1:4] + high * axis[k]
    strongest = np.argsort(-moment[:, 0], kind="mergesort")
    group = np.full(n, -1)
    merged = np.empty(len(order), order.dtype)
    rows = np.empty_like(piece)
    groups = used = 0
    for root in strongest:
        if group[root] >= 0:
            continue
        group[root] = groups
        m, u = moment[root].copy(), axis[root].copy()
        low, high = ends[root, 0].copy(), ends[root, 1].copy()
        grown = True
        while grown:
            grown = False
            a, b = (low - m[1:4]) @ u, (high - m[1:4]) @ u
            for k in strongest:
                if group[k] >= 0 or not _is_copy(m, u, a, b, axis[k], ends[k], distance, gap_max):
                    continue
                group[k] = groups
                m = add(m, moment[k])
                _, _, u[0], u[1], u[2] = principal_axis(m[4], m[5], m[6], m[7], m[8], m[9])
                # Where the extremes of all four ends lie on the new axis.
                a = b = (low - m[1:4]) @ u
                for end in (high, ends[k, 0], ends[k, 1]):
                    t = (end - m[1:4]) @ u
                    a, b = min(a, t), max(b, t)
                low, high = m[1:4] + a * u, m[1:4] + b * u
                grown = True
        groups += 1
    for g in range(groups):
        rows[g, 0] = used
        for k in range(n):
            if group[k] == g:
                size = piece[k, 1] - piece[k, 0]
                merged[used : used + size] = order[piece[k, 0] : piece[k, 1]]
                used += size
        rows[g, 1] = used
    return merged, rows[:groups]


@njit(cache=True)
def _is_copy(m, u, a, b, axis, ends, distance, gap_max):
    """Whether a piece with an ``axis`` and two ``ends`` lies along the axis (m, u) from ``a`` to ``b``."""
    if abs(axis[0] * u[0] + axis[1] * u[1] + axis[2] * u[2]) < MERGE_ANGLE_COS:
        return False
    low, high = np.inf, -np.inf
    for e in range(2):
        x, y, z = ends[e, 0] - m[1], ends[e, 1] - m[2], ends[e, 2] - m[3]
        t = x * u[0] + y * u[1] + z * u[2]
        if x * x + y * y + z * z - t * t > distance * distance:
            return False
        low, high = min(low, t), max(high, t)
    return low <= b + gap_max and high >= a - gap_max


@njit(cache=True)
def sort(px, py, pz, order, piece, pca_ratio_min, radius_max, density_min, length_min):
    """Fit each piece; (start, end, count, radius) of those that pass the bounds, as in `Segments`."""
    start, end = np.zeros((len(piece), 3)), np.zeros((len(piece), 3))
    count, radius = np.zeros(len(piece), np.int64), np.zeros(len(piece))
    kept = 0
    for row in range(len(piece)):
        chosen = order[piece[row, 0] : piece[row, 1]]
        n = len(chosen)
        along, across, mx, my, mz, ux, uy, uz = fit_line(px, py, pz, chosen, n)
        low, high = np.inf, -np.inf
        for i in chosen:
            t = (px[i] - mx) * ux + (py[i] - my) * uy + (pz[i] - mz) * uz
            low, high = min(low, t), max(high, t)
        length = high - low
        spread = math.sqrt(across / n)
        if (
            along >= pca_ratio_min * (along + across)
            and spread <= radius_max
            and n >= density_min * length
            and length > 0.0
            and length >= length_min
        ):
            start[kept, 0], start[kept, 1], start[kept, 2] = mx + low * ux, my + low * uy, mz + low * uz
            end[kept, 0], end[kept, 1], end[kept, 2] = mx + high * ux, my + high * uy, mz + high * uz
            count[kept] = n
            radius[kept] = spread
            kept += 1
    return start[:kept], end[:kept], count[:kept], radius[:kept]
