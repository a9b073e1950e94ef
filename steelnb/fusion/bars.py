"""Bars of a voxel map: ridges of its weight, tubes along them (`hough.tubes`), and collinear pieces merged.

Ridges are the voxels along bars, without the range noise around them, and without the surfaces, where lines in any
direction would pass for bars.
"""

import math
from dataclasses import dataclass

import numpy as np

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray, Segments
from steelnb.fusion.joints import REACH_M
from steelnb.hough.tubes import find_tubes
from steelnb.points import VoxelMap, voxel_grid
from steelnb.points.kdtree import advance, columns_of, gather
from steelnb.points.surfaces import Surfaces, surfaces_of
from steelnb.points.voxel_map import offsets_within

TUBE_M, RIDGE_TUBE_M, THIN_M, VOXEL_M = 0.06, 0.03, 0.02, 0.04
"""Radius of the tube that contains a bar's points, and of the narrowest in which ridges are sought; edge of the voxels
that thin the ridges, and of those that accumulate the scans. These and the other lengths and shares of reconstruction
were tuned with ``starling2`` on ``zigzag`` and ``loops`` flights around the towers ``tapered`` and ``light``."""
RIDGE_RADIUS_M, RIDGE_SHARE, CONTRACT_M = 0.15, 0.2, 0.08
"""See `ridge_points`."""
CELL, CELL_VOXELS = 2.5, 1.5
"""Edge of the cells in which surfaces are sought, in multiples of `VOXEL_M`, and its minimum in voxels of the map."""


@dataclass(frozen=True, eq=False)
class Ridges:
    """The ridges of a voxel map: ``points (R, 3)``, metres, thinned to a few in a tube's radius, and the
    ``surfaces`` of the map, in which no bars are sought."""

    voxels: VoxelMap
    points: Array
    surfaces: Surfaces

    @classmethod
    def of(cls, voxels: VoxelMap, sum_m: float = 0.0) -> "Ridges":
        """Those of a map; ``sum_m`` as in `ridge_points`."""
        points = voxel_grid(ridge_points(voxels, RIDGE_RADIUS_M, RIDGE_SHARE, CONTRACT_M, sum_m=sum_m), THIN_M)
        cell_m = max(CELL * VOXEL_M, CELL_VOXELS * voxels.voxel_m)
        return cls(voxels, points, surfaces_of(voxels, voxel_grid(points, TUBE_M / math.sqrt(3)), cell_m))

    @property
    def off_surfaces(self) -> Array:
        """The points that lie on no surface ``(N, 3)``."""
        return self.points[self.surfaces.label_of(self.points) < 0]


def ridge_points(
    voxels: VoxelMap,
    radius_m: float,
    share_min: float,
    contract_m: float,
    sum_m: float = 0.0,
) -> Array:
    """Points on ridges ``(R, 3)``, metres, in the frame of the map.

    Range noise spreads the points of a bar along the rays, into voxels of little weight. So a voxel is kept if it
    has at least ``share_min`` of the largest weight within ``radius_m``. Its mean is then moved, once, to the weighted
    mean of the kept voxels within ``contract_m``.

    ``sum_m``: radius in which weights are summed first. In sparse clouds, and in those thinned by a voxel filter, most
    voxels have one point, so that only their neighbours tell a bar from the noise around it.
    """
    key, mean, weight, voxel_m = voxels.keys(), voxels.means(), voxels.weights(), voxels.voxel_m
    order = np.argsort(key, kind="stable")  # the same on every processor: keys differ, and it has no vector code
    key, mean, weight = key[order], mean[order], weight[order]
    if sum_m > 0.0:
        weight = _summed(key, weight, columns_of(offsets_within(sum_m, voxel_m)))
    is_ridge = _ridge(key, weight, columns_of(offsets_within(radius_m, voxel_m)), share_min)
    around = columns_of(offsets_within(contract_m + math.sqrt(3) * voxel_m, voxel_m))
    contracted = _contract(key[is_ridge], mean[is_ridge], weight[is_ridge], around, contract_m)
    return np.asarray(contracted[np.argsort(order[is_ridge], kind="stable")])  # in the order of the map


@njit(cache=True, nogil=True)
def _summed(key, weight, around):  # type: ignore[no-untyped-def]
    """Sum of the weights of the voxels around each voxel; their keys are sorted."""
    total = np.zeros(len(key))
    first, last = np.zeros(len(around.low), np.int64), np.zeros(len(around.low), np.int64)
    at, others = np.full(len(around.place), -1), np.empty(len(around.place), np.int64)
    for n in range(len(key)):
        advance(key, n, around, first, last)
        for k in range(gather(key, n, around, first, last, at, others)):
            total[n] += weight[others[k]]
    return total


@njit(cache=True, nogil=True)
def _ridge(key, weight, around, share_min):  # type: ignore[no-untyped-def]
    """Mask of the voxels that are kept."""
    is_ridge = weight > 0.0
    first, last = np.zeros(len(around.low), np.int64), np.zeros(len(around.low), np.int64)
    for n in range(len(key)):
        if not is_ridge[n]:
            continue
        bound = weight[n] / share_min
        advance(key, n, around, first, last)
        for c in range(len(first)):
            for k in range(first[c], last[c]):
                is_ridge[n] &= weight[k] <= bound
    return is_ridge


@njit(cache=True, nogil=True)
def _contract(key, mean, weight, around, radius):  # type: ignore[no-untyped-def]
    """Weighted means of the voxels within a radius of each voxel."""
    contracted = mean.copy()
    first, last = np.zeros(len(around.low), np.int64), np.zeros(len(around.low), np.int64)
    at, others = np.full(len(around.place), -1), np.empty(len(around.place), np.int64)
    for n in range(len(key)):
        advance(key, n, around, first, last)
        total = x = y = z = 0.0
        for k in range(gather(key, n, around, first, last, at, others)):
            other = others[k]
            dx, dy, dz = mean[other, 0] - mean[n, 0], mean[other, 1] - mean[n, 1], mean[other, 2] - mean[n, 2]
            if dx * dx + dy * dy + dz * dz <= radius * radius:
                w = weight[other]
                total += w
                x += w * mean[other, 0]
                y += w * mean[other, 1]
                z += w * mean[other, 2]
        contracted[n, 0], contracted[n, 1], contracted[n, 2] = x / total, y / total, z / total
    return contracted


IN_LINE_RAD, PIECE_GAP_MAX_M = math.radians(4), 0.3
"""Maximum angle between two pieces of one bar, and maximum gap between them."""
COPY_RAD, COPY_SHARE = math.radians(15), 0.6
"""Maximum angle of a copy to a stronger bar, and minimum share of its samples within `REACH_M` of it."""
SAMPLES = 9
"""Number of samples along a bar."""


def find_bars(ridges: Ridges, rise_m: float = math.inf) -> tuple[Segments, str]:
    """The bars on ridges, strongest first, with axes in the middle of their points; and the reason if none.

    ``rise_m``: see `merge_pieces`.
    """
    points = ridges.off_surfaces
    others = len(ridges.points) - len(points)
    bars = merge_pieces(find_tubes(points, RIDGE_TUBE_M).found()[0], rise_m=rise_m)
    if len(bars):
        return bars, ""
    more = f" ({others} more lie on surfaces)" if others else ""
    return bars, f"none of {len(points)} points on ridges{more} lie along a line"


def beyond_ends(bars: Segments, reach_m: float, tube_m: float) -> Array:
    """Points ``(2, S, B, 3)`` from the start and the end of each bar outwards, up to ``reach_m``, half a tube apart."""
    extension = np.arange(0, reach_m + 1e-9, 0.5 * tube_m)[:, None, None] * bars.direction
    return np.stack([bars.start - extension, bars.end + extension])


def merge_pieces(bars: Segments, width_m: Array | None = None, rise_m: float = math.inf) -> Segments:
    """Join the pieces of bars, drop copies of stronger bars, and sort by strength.

    Pieces are almost parallel, at most `PIECE_GAP_MAX_M` apart and offset by at most `TUBE_M`. Across the other, the
    shorter one rises by no more than that, or they meet at a bend. A joined bar has the moments of its pieces, each
    taken as a uniform bar of its points.

    A copy lies mostly within `REACH_M` of a stronger bar, at a small angle, and rises across it by at most ``rise_m``
    metres over its length. The rise distinguishes it from a brace at an acute angle to its chord: a line through the
    points of a tube rises by at most its radius, a brace of 1 m at 12° by 0.2 m. By default, both are dropped.

    The two other merges are given something else. `hough.segments.merge` has the points of the pieces, and
    requires both ends near the axis. `SegmentMap` has moments of many scans, and merges whatever it would associate.

    The widths ``width_m (B,)``, NaN if unknown, widen the bounds, since points of an angle section lie up to 0.8
    flanges from its centroid, and the middles of its faces half a flange apart.
    """
    width = np.zeros(len(bars)) if width_m is None else np.nan_to_num(width_m)
    while len(bars):
        order = np.argsort(-bars.count, kind="stable")
        bars, width = bars.take(order), width[order]
        bounds = ((REACH_M, 0.8), (TUBE_M, 0.5), (rise_m, 0.8))
        copy, aside, rise = (np.maximum(bound, share * width) for bound, share in bounds)
        fate = _fates(bars.start, bars.direction, bars.length, copy, aside, rise)
        remains = fate == np.arange(len(bars))
        if remains.all():
            break
        bars, width = _joined(bars, fate), width[remains]
    return bars


def _joined(bars: Segments, fate: IntArray) -> Segments:
    """The remaining bars, each joined with the pieces that ``fate`` assigns to it."""
    remaining = np.flatnonzero(fate == np.arange(len(bars)))
    joined = bars.take(remaining)
    for k in np.flatnonzero(np.bincount(fate[fate >= 0])[remaining] > 1):
        pieces = bars.take(np.flatnonzero(fate == remaining[k]))
        weight = pieces.count / pieces.count.sum()
        mean = weight @ pieces.middle
        offset, half_run = pieces.middle - mean, 0.5 * (pieces.end - pieces.start)
        own, between = (np.einsum("k,ki,kj->ij", weight, each, each) for each in (half_run, offset))
        covariance = own / 3 + between
        value, vector = np.linalg.eigh(covariance)
        axis = vector[:, 2]
        along = (np.concatenate([pieces.start, pieces.end]) - mean) @ axis
        joined.start[k], joined.end[k] = mean + along.min() * axis, mean + along.max() * axis
        joined.count[k] = pieces.count.sum()
        joined.radius[k] = math.sqrt(max(value[0] + value[1], 0.0) + float(weight @ pieces.radius**2))
    return joined


@njit(cache=True)
def _fates(start, direction, length, copy, aside, rise):  # type: ignore[no-untyped-def]
    """The stronger bar that each bar is joined to, its own index if none, −1 for a copy; at most one join per bar."""
    n = len(length)
    fate = np.arange(n)
    taken = np.zeros(n, np.bool_)
    for j in range(1, n):
        for i in range(j):
            if fate[i] != i:
                continue
            apart = 0.0
            for k in range(3):  # scalar, since most pairs are rejected here
                middle = start[j, k] + 0.5 * length[j] * direction[j, k]
                apart += (middle - start[i, k] - 0.5 * length[i] * direction[i, k]) ** 2
            if math.sqrt(apart) > 0.5 * (length[i] + length[j]) + PIECE_GAP_MAX_M + copy[i]:
                continue
            cosine = abs((direction[i] * direction[j]).sum())
            if cosine < math.cos(COPY_RAD):
                continue
            near, low, high = 0, 1e9, -1e9
            for k in range(SAMPLES):
                r = start[j] + (k + 0.5) / SAMPLES * length[j] * direction[j] - start[i]
                t = (r * direction[i]).sum()
                low, high = min(low, t), max(high, t)
                distance = math.sqrt(max((r * r).sum() - t * t, 0.0))
                if distance <= copy[i] and -copy[i] <= t <= length[i] + copy[i]:
                    near += 1
            sine = math.sqrt(max(1.0 - cosine * cosine, 0.0))
            if near >= COPY_SHARE * SAMPLES and length[j] * sine <= rise[i]:
                fate[j] = -1
                break
            if cosine < math.cos(IN_LINE_RAD) or taken[i] or taken[j] or max(low - length[i], -high) > PIECE_GAP_MAX_M:
                continue
            if min(length[i], length[j]) * sine > aside[i]:
                continue
            # Distance in the middle of the gap or of the overlap.
            t = 0.5 * (min(max(low, 0.0), length[i]) + min(max(high, 0.0), length[i]))
            r = start[i] + t * direction[i] - start[j]
            s = (r * direction[j]).sum()
            if math.sqrt(max((r * r).sum() - s * s, 0.0)) <= aside[i]:
                fate[j] = i
                taken[i] = taken[j] = True
                break
    return fate
