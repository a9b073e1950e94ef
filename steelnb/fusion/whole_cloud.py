"""The bars of a merged cloud, without scans and poses: lines on ridges of its density, surfaces left out."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from steelnb.core.types import Array, IntArray, Segments
from steelnb.fusion.candidates import (
    CONTRACT_M,
    GRIDS,
    LENGTH_MIN_M,
    RIDGE_RADIUS_M,
    RIDGE_SHARE,
    TUBE_M,
    VOXEL_M,
    bars_on_ridges,
    is_held,
    merge_pieces,
)
from steelnb.fusion.joints import REACH_M, find_joints
from steelnb.fusion.ridges import ridge_points
from steelnb.hough.alternatives.refine import nearest_bar
from steelnb.hough.whole_structure.search import MIN_VOTES
from steelnb.points import VoxelMap, voxel_grid
from steelnb.points.surfaces import Surface, Surfaces

CELL, CELL_VOXELS = 2.5, 1.5
"""Edge of the cells in which surfaces are sought, in multiples of the default voxel, and its minimum in voxels."""
RISE_M = 0.2
"""See `merge_pieces`."""
FREE_MIN = 0.6
"""Minimum freedom of a bar. On a surface it is about a third."""
SLICE_M, REACH = 0.1, 3.0
"""Slices in which the freedom is measured, and how many half-widths around the axis."""
SURE_M = 0.8
"""A bar that is shorter than this needs a bar at each end: where a flight has seen half of a member, it lies askew."""
HALF_WIDTH_SHARE = 0.9
"""Share of a bar's points that lie within half its width of its axis."""


@dataclass(frozen=True)
class CloudBars:
    """The bars of a cloud, strongest first, and the surfaces that were left out.

    ``freedom (B,)``: share of the points around a bar that lie on it, 0 to 1 (`freedom_of`); ``width_m (B,)``;
    ``surfaces``, largest first; ``surface (N,)``: number of the surface that each point of the cloud lies on, or −1;
    ``voxel_m``: edge of the voxels in which the points were accumulated.
    """

    bars: Segments
    freedom: Array
    width_m: Array
    surfaces: list[Surface]
    surface: IntArray
    voxel_m: float

    def take(self, index: IntArray) -> "CloudBars":
        """The same with some bars, in this order."""
        return replace(self, bars=self.bars.take(index), freedom=self.freedom[index], width_m=self.width_m[index])


def bars_of_cloud(
    points: Array, tube_m: float = TUBE_M, voxel_m: float | None = None, min_votes: int = MIN_VOTES
) -> CloudBars:
    """Find the bars of a cloud ``(N, 3)``, metres, z up, finite.

    Points are accumulated in voxels of edge ``voxel_m``, by default two thirds of the tube, and only voxels on ridges
    of their weight remain: range noise spreads the rest. `Surfaces` of these are left out. Lines through what remains
    are split at bends, extended to their joints and merged (`fusion.candidates`, `fusion.joints`). A bar stands free
    (`freedom_of`), and if it is short, its ends meet other bars.

    ``tube_m``: radius of the tube that holds a bar's points. The lengths of the search grow with it; those of bends,
    joints and merging are fixed.
    ``min_votes``: minimum number of ridge voxels of a bar.
    """
    scale = tube_m / TUBE_M
    voxel_m = voxel_m or scale * VOXEL_M
    voxels = VoxelMap(voxel_m)
    voxels.insert(points)
    ridge = ridge_points(voxels, scale * RIDGE_RADIUS_M, RIDGE_SHARE, scale * CONTRACT_M)
    ridge = voxel_grid(ridge, tube_m / math.sqrt(3))
    surfaces = Surfaces.found_in(ridge, max(CELL * scale * VOXEL_M, CELL_VOXELS * voxel_m))
    free = ridge[surfaces.label_of(ridge) < 0]
    label = surfaces.label_of(points)
    off, bars = points[label < 0], Segments.empty()
    if len(free) >= min_votes and np.linalg.norm(np.ptp(free, axis=0)) > 2 * scale * LENGTH_MIN_M:
        bars = bars_on_ridges(free, tube_m, min_votes, GRIDS, RISE_M)
        # Points at a joint belong to one of its bars, so the others have gaps there.
        width_m = widths_of(off, bars, tube_m)
        bars = merge_pieces(find_joints(bars, width_m)[2], width_m, RISE_M)
    width_m = widths_of(off, bars, tube_m)
    freedom = freedom_of(ridge, bars, width_m, tube_m)
    long = bars.length >= scale * SURE_M
    sure = (freedom >= FREE_MIN) & (long | _held_by_others(bars, scale * REACH_M, tube_m))
    return CloudBars(bars.take(sure), freedom[sure], width_m[sure], surfaces.described(label), label, voxel_m)


def widths_of(points: Array, bars: Segments, tube_m: float) -> Array:
    """Width ``(B,)`` of each bar, metres: twice the distance from its axis within which `HALF_WIDTH_SHARE` of its
    points lie. These are the ``points (N, 3)`` that are nearest to its axis and within two tube radii of it."""
    nearest = nearest_bar(points, bars, 2 * tube_m, 0.0)
    width_m = np.full(len(bars), 2 * tube_m)
    order = np.argsort(nearest, kind="stable")
    first = np.searchsorted(nearest[order], np.arange(len(bars) + 1))
    for bar in range(len(bars)):
        own = points[order[first[bar] : first[bar + 1]]] - bars.start[bar]
        if len(own):
            across = own - (own @ bars.direction[bar])[:, None] * bars.direction[bar]
            width_m[bar] = 2 * np.quantile(np.linalg.norm(across, axis=1), HALF_WIDTH_SHARE)
    return width_m


def freedom_of(points: Array, bars: Segments, width_m: Array, tube_m: float) -> Array:
    """How free each bar stands ``(B,)``: the share of the ``points (N, 3)`` within `REACH` half-widths of its axis that
    lie within one, as the median over slices along it. Points on other bars do not count."""
    half_m = np.maximum(0.5 * width_m, tube_m)
    owner = nearest_bar(points, bars, float(half_m.max(initial=tube_m)), 0.0)
    freedom = np.zeros(len(bars))
    for bar in range(len(bars)):
        offset = points - bars.start[bar]
        along = offset @ bars.direction[bar]
        around = np.flatnonzero((along >= 0) & (along <= bars.length[bar]))
        across = offset[around] - along[around, None] * bars.direction[bar]
        distance = np.linalg.norm(across, axis=1)
        counts = (distance <= REACH * half_m[bar]) & ((owner[around] == bar) | (owner[around] < 0))
        slices = (along[around][counts] / SLICE_M).astype(np.int64)
        total = np.bincount(slices)
        inside = np.bincount(slices[distance[counts] <= half_m[bar]], minlength=len(total))
        if total.any():
            freedom[bar] = np.median(inside[total > 0] / total[total > 0])
    return freedom


def _held_by_others(bars: Segments, reach_m: float, tube_m: float) -> NDArray[np.bool_]:
    """`is_held` of each bar by all others ``(B,)``."""
    number = np.arange(len(bars))
    held = [
        is_held(bars.take(number == k), bars.take(number != k), reach_m, 0.5 * tube_m, 1.5 * tube_m) for k in number
    ]
    return np.array(held, dtype=bool).reshape(len(bars))
