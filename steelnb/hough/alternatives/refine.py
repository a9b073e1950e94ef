"""Bars from lines or groups of points: cut, merge, filter and refit. Shared by all methods."""

from collections.abc import Callable

import numpy as np

from steelnb.core.types import Array, IntArray, Lines, Segments
from steelnb.hough.freedom import nearest_bar
from steelnb.hough.segments import cut_and_sort
from steelnb.hough.segments_kernels import counts_near, filter_pieces, merge
from steelnb.hough.transform import fit_line
from steelnb.hough.whole_structure.search import EXCLUDE_DX

POINTS_MIN, GAP_MAX_M, MERGE_DISTANCE_M, LENGTH_MIN_M = 15, 0.25, 0.12, 0.3
"""Minimum number of points, maximum gap, maximum distance of merged pieces, and minimum length of a bar. Shared by all
methods for a fair comparison. Chosen for the Hough transform on development seeds 11 to 16."""
PCA_RATIO_MIN, RADIUS_MAX_M = 0.9, 0.07
"""Minimum share of the variance of a bar's points along it, and their maximum root mean square distance to its axis."""
ASSIGN_DX = 1.2
"""Maximum distance of a bar's points from its axis, in dx. It exceeds 1 since lines miss the edges of wide sections."""
END_MARGIN_M = 0.05
"""A bar also takes points up to this far past its ends."""
OWN_SHARE_MIN = 0.33
"""Minimum share of the points within twice `ASSIGN_DX` of a bar that belong to it. Chords between two bars at a joint
fall below it. It rejects half of all wrong segments and one in a hundred correct ones (seeds 11 to 16)."""
ROUNDS = 3
"""Rounds of assignment and refit; after three the axes no longer move."""


def bars_of_groups(points: Array, label: IntArray, points_min: int = POINTS_MIN) -> Segments:
    """Bars along the principal axes of groups of points ``(N, 3)``, cut at gaps, merged and filtered.

    ``label (N,)`` is the group of each point, counted from 0, or −1 for none.
    """
    px, py, pz = np.ascontiguousarray(points.T)
    groups = [np.flatnonzero(label == g) for g in range(int(label.max(initial=-1)) + 1)]
    fits = np.array([fit_line(px, py, pz, group, len(group)) for group in groups]).reshape(-1, 8)
    count = np.array([len(group) for group in groups], dtype=np.int64)
    return bars_of_lines(points, Lines(fits[:, 2:5], fits[:, 5:], count, label), points_min)


def bars_of_lines(points: Array, lines: Lines, points_min: int = POINTS_MIN) -> Segments:
    """Bars along lines, cut at gaps, merged and filtered."""
    return cut_and_sort(
        points, lines, GAP_MAX_M, points_min, PCA_RATIO_MIN, RADIUS_MAX_M, 0.0, LENGTH_MIN_M, MERGE_DISTANCE_M,
    )  # fmt: skip


def in_passes(find: Callable[[Array], Segments], points: Array, dx: float, points_min: int = POINTS_MIN) -> Segments:
    """Bars found in the points, and bars found in a second pass over the points that are on none of the first.

    A line across many bars takes points of each before it is dropped; the second pass can use those points again.
    """
    first = find(points)
    remaining = points[nearest_bar(points, first, EXCLUDE_DX * dx, dx) < 0]
    if len(remaining) < points_min or np.linalg.norm(np.ptp(remaining, axis=0)) <= 2 * dx:
        return first
    return Segments.joined((first, find(remaining)))


def refine(points: Array, bars: Segments, dx: float, points_min: int = POINTS_MIN) -> Segments:
    """Refit each bar to all points ``(N, 3)`` that are nearest to its axis, and merge collinear bars, `ROUNDS` times.

    A detected bar may cover half of the true width or two thirds of the length. At the end, bars that fail the bounds
    or own too few of the points around them are dropped.
    """
    px, py, pz = np.ascontiguousarray(points.T)
    for round_ in range(ROUNDS):
        final = round_ == ROUNDS - 1
        label = nearest_bar(points, bars, ASSIGN_DX * dx, END_MARGIN_M)
        order = np.argsort(label, kind="stable")
        begin = np.searchsorted(label[order], np.arange(len(bars) + 1))
        piece = np.column_stack([begin[:-1], begin[1:]])
        piece = piece[np.diff(piece, axis=1).ravel() >= 2]
        if not final:
            # Join the pieces of a partly occluded bar: its axis is now known well enough to bridge wider gaps.
            order, piece = merge(px, py, pz, order, piece, MERGE_DISTANCE_M, 2 * GAP_MAX_M)
        bounds = (PCA_RATIO_MIN, RADIUS_MAX_M, 0.0, LENGTH_MIN_M) if final else (0.0, np.inf, 0.0, 0.0)
        bars = Segments(*filter_pieces(px, py, pz, order, piece, *bounds))
    around = counts_near(px, py, pz, bars.start, bars.direction, bars.length, 2 * ASSIGN_DX * dx)
    return bars.take((bars.count >= points_min) & (bars.count >= OWN_SHARE_MIN * around))
