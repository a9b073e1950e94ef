"""Groups of points → bars, the same way for every method: cut, merge, sort; then every point to its nearest axis."""

from collections.abc import Callable

import numpy as np
from numba import njit

from steelnb.config import SegmentationSettings
from steelnb.datatypes import Array, IntArray, Lines, Segments
from steelnb.errors import SettingsError
from steelnb.hough import cut_and_sort, suggest_dx
from steelnb.hough.kernels import fit_line
from steelnb.hough.lines import checked_points
from steelnb.hough.pieces import merge, sort

REACH = 1.2
"""A point belongs to an axis within this many dx. A little more than dx: lines cut the edges of wide sections off."""
SHADOW = 1.25
"""Points within this many dx of a bar are not searched again: else wide bars come out doubled."""
BEYOND_M = 0.05
"""A bar takes points so far beyond its ends."""
OWN_SHARE_MIN = 0.33
"""Least share that a bar has of all points within twice the reach. What has less is a chord between two bars at their
joint, made of the rims of both: half of all wrong segments, against one in a hundred of the right ones."""
ROUNDS = 3
"""Of assigning points and fitting again; after three the axes rest."""


def prepared(
    points: Array, settings: SegmentationSettings | None, dx: float | None
) -> tuple[Array, SegmentationSettings, float]:
    """What every method begins with: points checked, settings and dx where none are given. Raises as `detect_lines`."""
    points = checked_points(points)
    dx = suggest_dx(points) if dx is None else dx
    if not 0 < dx < np.inf:
        raise SettingsError(f"dx = {dx}: expected a length above 0 m")
    return points, settings or SegmentationSettings(), dx


def bars_of_groups(points: Array, label: IntArray, settings: SegmentationSettings) -> Segments:
    """Bars of groups of points ``(N, 3)``: the principal axis of each, cut at gaps, merged, sorted.

    ``label (N,)`` is the group of each point from 0, or −1 for none.
    """
    groups = int(label.max(initial=-1)) + 1
    order = np.argsort(label, kind="stable")
    begin = np.searchsorted(label[order], np.arange(groups + 1))
    px, py, pz = np.ascontiguousarray(points.T)
    anchor, direction = _axes(px, py, pz, order, begin)
    return bars_of_lines(points, Lines(anchor, direction, np.diff(begin), label), settings)


def bars_of_lines(points: Array, lines: Lines, settings: SegmentationSettings) -> Segments:
    """Bars along lines, cut, merged and sorted as the settings say."""
    return cut_and_sort(
        points, lines, settings.gap_max_m, settings.points_min, settings.pca_ratio_min, settings.radius_max_m, 0.0,
        settings.length_min_m, settings.merge_distance_m,
    )  # fmt: skip


def in_passes(find: Callable[[Array], Segments], points: Array, dx: float, settings: SegmentationSettings) -> Segments:
    """The bars found in the points, and those found in what the first ones leave over.

    A line that crosses many bars takes some points of each. It does not pass for a bar; its points get a second chance.
    """
    first = find(points)
    left = points[nearest_bar(points, first, SHADOW * dx, dx) < 0]
    if len(left) < settings.points_min or np.linalg.norm(np.ptp(left, axis=0)) <= 2 * dx:
        return first
    return Segments.joined((first, find(left)))


def refine(points: Array, bars: Segments, dx: float, settings: SegmentationSettings) -> Segments:
    """Fit each bar to all points ``(N, 3)`` whose nearest axis is its own, merge what has become one, sort, again.

    What a method took for a bar may be half of its width, or two thirds of its length. Bars that hold too few of the
    points around them are dropped in the end.
    """
    px, py, pz = np.ascontiguousarray(points.T)
    for left in reversed(range(ROUNDS)):
        label = nearest_bar(points, bars, REACH * dx, BEYOND_M)
        order = np.argsort(label, kind="stable")
        begin = np.searchsorted(label[order], np.arange(len(bars) + 1))
        piece = np.column_stack([begin[:-1], begin[1:]])
        piece = piece[np.diff(piece, axis=1).ravel() >= 2]
        if left and settings.merge_distance_m > 0:
            # Half a bar is seen through others: two pieces on one axis, now that it is known well, are the same bar.
            order, piece = merge(px, py, pz, order, piece, settings.merge_distance_m, 2 * settings.gap_max_m)
        bounds = (0.0, np.inf, 0.0) if left else (settings.pca_ratio_min, settings.radius_max_m, 0.0)
        bars = Segments(*sort(px, py, pz, order, piece, *bounds, 0.0 if left else settings.length_min_m))
    around = _count_around(px, py, pz, bars.start, bars.direction, bars.length, 2 * REACH * dx)
    return bars.take((bars.count >= settings.points_min) & (bars.count >= OWN_SHARE_MIN * around))


def nearest_bar(points: Array, bars: Segments, distance: float, beyond: float) -> IntArray:
    """Index ``(N,)`` of the axis nearest to each point ``(N, 3)`` and within ``distance`` metres of it, −1 for none.

    An axis reaches ``beyond`` metres past the ends of its bar.
    """
    px, py, pz = np.ascontiguousarray(points.T)
    return np.asarray(_nearest_bar(px, py, pz, bars.start, bars.direction, bars.length, distance, beyond))


@njit(cache=True)
def _nearest_bar(px, py, pz, start, direction, length, distance, beyond):
    label = np.full(len(px), -1, np.int64)
    least = np.full(len(px), distance * distance)
    for k in range(len(length)):
        sx, sy, sz = start[k, 0], start[k, 1], start[k, 2]
        ux, uy, uz = direction[k, 0], direction[k, 1], direction[k, 2]
        last = length[k] + beyond
        for i in range(len(px)):
            x, y, z = px[i] - sx, py[i] - sy, pz[i] - sz
            t = x * ux + y * uy + z * uz
            squared = x * x + y * y + z * z - t * t
            if squared < least[i] and -beyond <= t <= last:
                least[i], label[i] = squared, k
    return label


@njit(cache=True)
def _count_around(px, py, pz, start, direction, length, distance):
    """How many points lie within ``distance`` of each bar, between its ends."""
    count = np.zeros(len(length), np.int64)
    for k in range(len(length)):
        sx, sy, sz = start[k, 0], start[k, 1], start[k, 2]
        ux, uy, uz = direction[k, 0], direction[k, 1], direction[k, 2]
        for i in range(len(px)):
            x, y, z = px[i] - sx, py[i] - sy, pz[i] - sz
            t = x * ux + y * uy + z * uz
            if 0.0 <= t <= length[k] and x * x + y * y + z * z - t * t <= distance * distance:
                count[k] += 1
    return count


@njit(cache=True)
def _axes(px, py, pz, order, begin):
    groups = len(begin) - 1
    anchor, direction = np.zeros((groups, 3)), np.zeros((groups, 3))
    for g in range(groups):
        chosen = order[begin[g] : begin[g + 1]]
        _, _, mx, my, mz, ux, uy, uz = fit_line(px, py, pz, chosen, len(chosen))
        anchor[g, 0], anchor[g, 1], anchor[g, 2] = mx, my, mz
        direction[g, 0], direction[g, 1], direction[g, 2] = ux, uy, uz
    return anchor, direction
