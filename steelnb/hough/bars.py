"""From lines or groups of points to bars, the same for every method of `peers`: cut, merge, sort, and re-fit."""

from collections.abc import Callable

import numpy as np
from numba import njit

from steelnb.errors import InputError
from steelnb.hough.dx import default_dx, distinct_points
from steelnb.hough.pieces import merge, sort
from steelnb.hough.segments import cut_and_sort
from steelnb.hough.transform import fit_line
from steelnb.types import Array, IntArray, Lines, Segments

POINTS_MIN, GAP_MAX_M, MERGE_DISTANCE_M, LENGTH_MIN_M = 15, 0.25, 0.12, 0.3
"""What every method takes for a bar, so that they differ in nothing but how they find it: points of one group are cut
where they leave a gap, pieces within the distance of one axis become one, and those with enough points, long enough and
thin, stay. Chosen for the Hough transform on development seeds 11 to 16."""
PCA_RATIO_MIN, RADIUS_MAX_M = 0.9, 0.07
"""Least share of the variance of a bar's points along it, and their largest root mean square distance to its axis."""
REACH = 1.2
"""A point belongs to an axis within this many dx. A little more than dx: lines cut the edges of wide sections off."""
SHADOW = 1.25
"""Points within this many dx of a bar are not searched again: else wide bars come out doubled."""
BEYOND_M = 0.05
"""Distance past its ends, metres, within which a bar takes points."""
OWN_SHARE_MIN = 0.33
"""Least share of a bar in all points within twice `REACH`. Below are chords between two bars at their joint, made of
the rims of both: half of all wrong segments, against one in a hundred of the right ones (seeds 11 to 16)."""
ROUNDS = 3
"""Rounds of assigning points and fitting again; after three the axes no longer move."""


def prepared(points: Array, dx: float | None, points_min: int) -> tuple[Array, float]:
    """Checked points ``(N, 3)``, and dx in metres (default `default_dx`). Raises as `detect_lines`."""
    points, _, _ = distinct_points(points)
    dx = default_dx(points) if dx is None else dx
    if not 0 < dx < np.inf:
        raise InputError(f"dx = {dx}: expected a length above 0 m")
    if points_min < 2:
        raise InputError(f"points_min = {points_min}: expected at least 2")
    return points, dx


def bars_of_groups(points: Array, label: IntArray, points_min: int = POINTS_MIN) -> Segments:
    """Bars of groups of points ``(N, 3)``: the principal axis of each, cut at gaps, merged, sorted.

    ``label (N,)`` is the group of each point from 0, or −1 for none.
    """
    px, py, pz = np.ascontiguousarray(points.T)
    groups = [np.flatnonzero(label == g) for g in range(int(label.max(initial=-1)) + 1)]
    fits = np.array([fit_line(px, py, pz, group, len(group)) for group in groups]).reshape(-1, 8)
    count = np.array([len(group) for group in groups], dtype=np.int64)
    return bars_of_lines(points, Lines(fits[:, 2:5], fits[:, 5:], count, label), points_min)


def bars_of_lines(points: Array, lines: Lines, points_min: int = POINTS_MIN) -> Segments:
    """Bars along lines, cut, merged and sorted."""
    return cut_and_sort(
        points, lines, GAP_MAX_M, points_min, PCA_RATIO_MIN, RADIUS_MAX_M, 0.0, LENGTH_MIN_M, MERGE_DISTANCE_M,
    )  # fmt: skip


def in_passes(find: Callable[[Array], Segments], points: Array, dx: float, points_min: int = POINTS_MIN) -> Segments:
    """The bars found in the points, and those found in the points that the first ones leave.

    A line across many bars takes some points of each and is then dropped; the second pass has those points again.
    """
    first = find(points)
    left = points[nearest_bar(points, first, SHADOW * dx, dx) < 0]
    if len(left) < points_min or np.linalg.norm(np.ptp(left, axis=0)) <= 2 * dx:
        return first
    return Segments.joined((first, find(left)))


def refine(points: Array, bars: Segments, dx: float, points_min: int = POINTS_MIN) -> Segments:
    """Fit each bar to all points ``(N, 3)`` whose nearest axis is its own, merge collinear ones, sort; `ROUNDS` times.

    A method's bar may cover half of the true width, or two thirds of the length. Bars with too few of the points around
    them are dropped in the end.
    """
    px, py, pz = np.ascontiguousarray(points.T)
    for left in reversed(range(ROUNDS)):
        label = nearest_bar(points, bars, REACH * dx, BEYOND_M)
        order = np.argsort(label, kind="stable")
        begin = np.searchsorted(label[order], np.arange(len(bars) + 1))
        piece = np.column_stack([begin[:-1], begin[1:]])
        piece = piece[np.diff(piece, axis=1).ravel() >= 2]
        if left:
            # Half a bar is seen through others: two pieces on one axis, now that it is known well, are the same bar.
            order, piece = merge(px, py, pz, order, piece, MERGE_DISTANCE_M, 2 * GAP_MAX_M)
        bounds = (0.0, np.inf, 0.0) if left else (PCA_RATIO_MIN, RADIUS_MAX_M, 0.0)
        bars = Segments(*sort(px, py, pz, order, piece, *bounds, 0.0 if left else LENGTH_MIN_M))
    _, around = _assign(px, py, pz, bars.start, bars.direction, bars.length, 2 * REACH * dx, 0.0)
    return bars.take((bars.count >= points_min) & (bars.count >= OWN_SHARE_MIN * around))


def nearest_bar(points: Array, bars: Segments, distance: float, beyond: float) -> IntArray:
    """Index ``(N,)`` of the axis nearest to each point ``(N, 3)`` and within ``distance`` metres of it, −1 for none.

    An axis extends ``beyond`` metres past the ends of its bar.
    """
    px, py, pz = np.ascontiguousarray(points.T)
    return np.asarray(_assign(px, py, pz, bars.start, bars.direction, bars.length, distance, beyond)[0])


@njit(cache=True)
def _assign(px, py, pz, start, direction, length, distance, beyond):
    """Nearest axis of each point (−1 for none in reach), and number of points in reach of each axis."""
    label, count = np.full(len(px), -1, np.int64), np.zeros(len(length), np.int64)
    least = np.full(len(px), distance * distance)
    for k in range(len(length)):
        sx, sy, sz = start[k, 0], start[k, 1], start[k, 2]
        ux, uy, uz = direction[k, 0], direction[k, 1], direction[k, 2]
        last = length[k] + beyond
        for i in range(len(px)):
            x, y, z = px[i] - sx, py[i] - sy, pz[i] - sz
            t = x * ux + y * uy + z * uz
            squared = x * x + y * y + z * z - t * t
            if squared <= distance * distance and -beyond <= t <= last:
                count[k] += 1
                if squared < least[i]:
                    least[i], label[i] = squared, k
    return label, count
