"""Lines → segments: cut at gaps, merge collinear pieces, filter by shape (the report's "segments sorting").

A piece is a range (first, one past last) in ``order``, which holds indices of points.
"""

import math

import numpy as np

from steelnb.core.checks import check_length, checked_integer, checked_number, checked_points
from steelnb.core.kernels import njit
from steelnb.core.types import Array, Lines, Segments
from steelnb.hough.lines import default_dx, detect_lines
from steelnb.hough.near_segments import freedom_of
from steelnb.hough.transform import fit_line
from steelnb.points.moments import NO_MOMENTS, add_moments, covariance, moments_about_mean, principal_axis, store
from steelnb.settings import HoughSettings

MERGE_ANGLE_COS = math.cos(math.radians(10))
"""Cosine of the maximum angle between merged pieces. Short pieces are tilted by up to dx over their length; a brace and
the leg that it meets differ by more."""


@njit(cache=True)
def cut(px, py, pz, order, begin, anchor, direction, gap_max, min_points):
    """Sort ``order`` along each line, in place, and cut it at gaps; returns the pieces ``(M, 2)``."""
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
def span(px, py, pz, chosen, mx, my, mz, ux, uy, uz):
    """Lowest and highest coordinate of points along the line through (mx, my, mz) with direction (ux, uy, uz)."""
    low, high = np.inf, -np.inf
    for i in chosen:
        t = (px[i] - mx) * ux + (py[i] - my) * uy + (pz[i] - mz) * uz
        low, high = min(low, t), max(high, t)
    return low, high


@njit(cache=True)
def _mean_and_axis(origin, m):
    """Mean ``(3,)`` and principal axis ``(3,)`` of points with moments ``m`` about an origin ``(3,)``."""
    xx, xy, xz, yy, yz, zz = covariance(m)
    _, _, ux, uy, uz = principal_axis(xx, xy, xz, yy, yz, zz)
    return origin + np.array([m[1], m[2], m[3]]) / m[0], np.array([ux, uy, uz])


@njit(cache=True)
def merge(px, py, pz, order, piece, distance, gap_max):
    """Merge collinear pieces; returns a new ``order`` and the merged pieces in it.

    Starting from the piece with the most points, absorb every piece of similar direction whose ends are both within
    ``distance`` of its axis and which leaves no gap above ``gap_max`` along it. The axis is refitted after each, and
    the search is repeated until no piece is absorbed.
    """
    n = len(piece)
    mean, moment, axis, ends = np.empty((n, 3)), np.empty((n, 10)), np.empty((n, 3)), np.empty((n, 2, 3))
    for k in range(n):
        chosen = order[piece[k, 0] : piece[k, 1]]
        mean[k, 0], mean[k, 1], mean[k, 2], m = moments_about_mean(px, py, pz, chosen, len(chosen))
        store(m, moment[k])
        _, axis[k] = _mean_and_axis(mean[k], m)
        low, high = span(px, py, pz, chosen, mean[k, 0], mean[k, 1], mean[k, 2], axis[k, 0], axis[k, 1], axis[k, 2])
        ends[k, 0], ends[k, 1] = mean[k] + low * axis[k], mean[k] + high * axis[k]
    strongest = np.argsort(-moment[:, 0], kind="mergesort")
    group = np.full(n, -1)
    merged = np.empty(len(order), order.dtype)
    rows = np.empty_like(piece)
    groups = used = 0
    for root in strongest:
        if group[root] >= 0:
            continue
        group[root] = groups
        m = add_moments(NO_MOMENTS, moment[root], 0.0, 0.0, 0.0)
        line_mean, line_axis = mean[root].copy(), axis[root].copy()
        low, high = ends[root, 0].copy(), ends[root, 1].copy()
        grown = True
        while grown:
            grown = False
            a, b = (low - line_mean) @ line_axis, (high - line_mean) @ line_axis
            for k in strongest:
                if group[k] >= 0 or not _is_collinear(line_mean, line_axis, a, b, axis[k], ends[k], distance, gap_max):
                    continue
                group[k] = groups
                offset = mean[k] - mean[root]
                m = add_moments(m, moment[k], offset[0], offset[1], offset[2])
                line_mean, line_axis = _mean_and_axis(mean[root], m)
                # The extremes of all four ends along the new axis.
                a = b = (low - line_mean) @ line_axis
                for end in (high, ends[k, 0], ends[k, 1]):
                    t = (end - line_mean) @ line_axis
                    a, b = min(a, t), max(b, t)
                low, high = line_mean + a * line_axis, line_mean + b * line_axis
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
def _is_collinear(line_mean, line_axis, a, b, axis, ends, distance, gap_max):
    """Whether a piece with ``axis`` and ``ends`` lies along the line (line_mean, line_axis) from ``a`` to ``b``."""
    if abs(axis[0] * line_axis[0] + axis[1] * line_axis[1] + axis[2] * line_axis[2]) < MERGE_ANGLE_COS:
        return False
    low, high = np.inf, -np.inf
    for e in range(2):
        x, y, z = ends[e, 0] - line_mean[0], ends[e, 1] - line_mean[1], ends[e, 2] - line_mean[2]
        t = x * line_axis[0] + y * line_axis[1] + z * line_axis[2]
        if x * x + y * y + z * z - t * t > distance * distance:
            return False
        low, high = min(low, t), max(high, t)
    return low <= b + gap_max and high >= a - gap_max


@njit(cache=True)
def filter_pieces(px, py, pz, order, piece, pca_ratio_min, radius_max, density_min, length_min):
    """Fit each piece; returns (start, end, count, radius) of those within the bounds, as in `Segments`."""
    start, end = np.zeros((len(piece), 3)), np.zeros((len(piece), 3))
    count, radius = np.zeros(len(piece), np.int64), np.zeros(len(piece))
    size = 0
    for row in range(len(piece)):
        chosen = order[piece[row, 0] : piece[row, 1]]
        n = len(chosen)
        along, across, mx, my, mz, ux, uy, uz = fit_line(px, py, pz, chosen, n)
        low, high = span(px, py, pz, chosen, mx, my, mz, ux, uy, uz)
        length = high - low
        rms = math.sqrt(across / n)
        if (
            along >= pca_ratio_min * (along + across)
            and rms <= radius_max
            and n >= density_min * length
            and length > 0.0
            and length >= length_min
        ):
            start[size, 0], start[size, 1], start[size, 2] = mx + low * ux, my + low * uy, mz + low * uz
            end[size, 0], end[size, 1], end[size, 2] = mx + high * ux, my + high * uy, mz + high * uz
            count[size] = n
            radius[size] = rms
            size += 1
    return start[:size], end[:size], count[:size], radius[:size]


@njit(cache=True)
def counts_near(px, py, pz, start, direction, length, distance):
    """Number of points within ``distance`` of each axis."""
    count = np.zeros(len(length), np.int64)
    for k in range(len(length)):
        sx, sy, sz = start[k, 0], start[k, 1], start[k, 2]
        ux, uy, uz = direction[k, 0], direction[k, 1], direction[k, 2]
        for i in range(len(px)):
            x, y, z = px[i] - sx, py[i] - sy, pz[i] - sz
            t = x * ux + y * uy + z * uz
            count[k] += x * x + y * y + z * z - t * t <= distance * distance and 0.0 <= t <= length[k]
    return count


HALF_WIDTH = 3.0
"""Half the width of a segment in root mean square distances of its points, for its freedom."""
GAP = 4.0
"""Maximum gap of a segment in dx: default of ``gap_max``; compiled into kernels (njit)."""


def detect_segments(
    points: Array,
    dx: float | None = None,
    min_votes: int = 2,
    max_lines: int | None = None,
    granularity: int = 4,
    gap_max: float | None = None,
    pca_ratio_min: float = 0.0,
    radius_max: float = math.inf,
    density_min: float = 0.0,
    length_min: float = 0.0,
    skip_weak: bool = True,
    free_min: float = 0.0,
) -> Segments:
    """Find line segments: Hough lines (`detect_lines`), cut at gaps between their points and filtered by shape.

    Parameters
    ----------
    points, dx, min_votes, max_lines, granularity: as in `detect_lines`.
    gap_max: maximum gap between consecutive points of a segment, metres; default 4 dx.
    pca_ratio_min: minimum share of the variance along the segment, 0–1.
    radius_max: maximum root mean square distance of the points to the axis, metres.
    density_min: minimum number of points per metre.
    length_min: minimum length, metres.
    skip_weak: drop lines with fewer than ``min_votes`` points and go on, unlike the published program.
    free_min: minimum freedom of a segment (`freedom_of`), 0–1; `FREE_MIN` leaves out lines on walls and on the ground.

    Returns `Segments` in the frame of the points. Their ends are the extreme points projected onto the fitted axis.
    Raises `InputError` as `detect_lines`.

    >>> import numpy as np
    >>> two = [np.linspace([0, 0, 0], [0, 0, 2], 80), np.linspace([0, 0, 3], [0, 0, 4], 40)]  # in line, 1 m apart
    >>> detect_segments(np.concatenate(two), dx=0.1, min_votes=20).length.round(3).tolist()
    [2.0, 1.0]
    """
    dx = default_dx(points) if dx is None else dx
    checked_number(free_min, "free_min", 0, 1)
    lines = detect_lines(points, dx, min_votes, max_lines, granularity, skip_weak)
    found = cut_and_sort(
        points, lines, GAP * dx if gap_max is None else gap_max, min_votes, pca_ratio_min, radius_max, density_min,
        length_min,
    )  # fmt: skip
    if not free_min:
        return found
    half_m = np.maximum(HALF_WIDTH * found.radius, 0.5 * dx)
    return found.take(np.flatnonzero(freedom_of(checked_points(points), found, half_m, free_min) >= free_min))


def detect_segments_with(points: Array, settings: HoughSettings) -> Segments:
    """`detect_segments` with an experiment's settings."""
    return detect_segments(
        points, settings.dx_m, settings.min_votes, settings.max_lines, settings.granularity, settings.gap_max_m,
        settings.pca_ratio_min, settings.dx_m, settings.density_min_per_m, settings.length_min_m,
        settings.skip_weak,
    )  # fmt: skip


def cut_and_sort(
    points: Array,
    lines: Lines,
    gap_max: float,
    min_points: int,
    pca_ratio_min: float,
    radius_max: float,
    density_min: float,
    length_min: float,
    merge_distance: float = 0.0,
) -> Segments:
    """Cut the points ``(N, 3)`` of each line at gaps, and keep the pieces within the bounds of `detect_segments`.

    Pieces with fewer than ``min_points`` points are dropped first. Collinear pieces within ``merge_distance``, metres,
    are merged before the bounds are applied; 0 turns merging off. Raises `InputError`.
    """
    points = checked_points(points)
    check_length(lines.label, "lines.label", len(points), "one a point")
    gap_max = checked_number(gap_max, "gap_max", above=0, infinite=True)
    checked_integer(min_points, "min_points", 0)
    pca_ratio_min = checked_number(pca_ratio_min, "pca_ratio_min", 0, 1)
    radius_max = checked_number(radius_max, "radius_max", above=0, infinite=True)
    density_min = checked_number(density_min, "density_min", 0)
    length_min = checked_number(length_min, "length_min", 0)
    merge_distance = checked_number(merge_distance, "merge_distance", 0)
    order = np.argsort(lines.label, kind="stable")
    begin = np.searchsorted(lines.label[order], np.arange(len(lines) + 1))
    px, py, pz = np.ascontiguousarray(points.T)
    piece = cut(px, py, pz, order, begin, lines.anchor, lines.direction, gap_max, max(min_points, 2))
    if merge_distance > 0:
        order, piece = merge(px, py, pz, order, piece, merge_distance, gap_max)
    return Segments(*filter_pieces(px, py, pz, order, piece, pca_ratio_min, radius_max, density_min, length_min))
