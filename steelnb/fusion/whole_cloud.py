"""The bars of a merged cloud, without scans and poses: lines on ridges of its density, surfaces left out."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from steelnb.core.types import Array, Segments
from steelnb.fusion.candidates import (
    GRIDS,
    LENGTH_MIN_M,
    bars_on_ridges,
    beyond_ends,
    merge_pieces,
    split_bends,
)
from steelnb.fusion.cloud_bars import OFF_MIN, CloudBars
from steelnb.fusion.joints import REACH_M, between_joints, find_joints
from steelnb.fusion.objects import APART, at_bars, objects_of
from steelnb.fusion.refit import FIT_TUBES, refitted, widths_of
from steelnb.fusion.ridges import TUBE_M, VOXEL_M, Ridges
from steelnb.hough.freedom import FREE_MIN, freedom_of
from steelnb.hough.lines import DX_PER_SPACING, spacing
from steelnb.hough.plates import on_plates
from steelnb.hough.whole_structure.search import MIN_VOTES
from steelnb.points import VoxelMap
from steelnb.points.surfaces import Surfaces

RISE_M, SUM_VOXELS = 0.2, 1.8
"""See `merge_pieces`, and ``sum_m`` in `ridge_points`, in voxels."""
SURE_M = 0.8
"""A bar that is shorter than this needs a bar at an end, and a bar or a surface at the other: where a flight has seen
half of a member, it lies askew."""
BEND_SHARE = 0.95
"""``share_max`` in `split_bends`: all points tell bends that are small beside the section."""
TUBES_MIN = 40
"""Minimum size of a cloud in tubes: the bars of a small model are thinner than those of a tower."""
NARROWER, WIDER = tuple(2 ** (-k / 2) for k in range(1, 11)), (2, 4)
"""Other tubes to try, in multiples of the first."""
OBJECT_MIN = 0.02
"""Minimum size of an object that narrower tubes search, as a share of the points on no surface. Smaller ones are tufts
of grass and ends of bars."""
REST_MIN, KEPT_MIN = 0.2, 0.9
"""Minimum share of the points on no surface that lie on no bar, for wider tubes among them: bars of narrower tubes
leave less of their object. And the minimum share of the first bars' length inside wider ones that replace them."""
LATTICE_REST_MAX = 0.4
"""What bars of narrower tubes may leave if they form a lattice: some members of a slim mast have too few points."""
STEEL_CHANGE = 0.9
"""A cloud is searched again if the tube that the points on no surface call for and that of the whole cloud differ by
more than this factor: ground may be sampled more sparsely than steel or, around a scanner's tripod, more densely."""


def bars_of_cloud(
    points: Array,
    tube_m: float | None = None,
    voxel_m: float | None = None,
    min_votes: int = MIN_VOTES,
    on_stage: Callable[[str], None] | None = None,
) -> CloudBars:
    """Find the bars of a cloud ``(N, 3)``, metres, z up, finite.

    Points are accumulated in voxels of edge ``voxel_m``, by default two thirds of the tube, and only voxels on ridges
    of their weight remain: range noise spreads the rest. Surfaces are left out (`surfaces_of`). Lines through the rest
    are split at bends, refitted to all points, extended to their joints and merged (`fusion.candidates`,
    `fusion.joints`). A bar lies on no plate (`on_plates`) and stands free (`freedom_of`), and if it is short, its ends
    meet others. Bars of trees and vehicles are left out (`in_structures`).

    ``tube_m``: radius of the tube that holds a bar's points. All lengths of the search are proportional to it. By
    default, it is that of `default_tube`, for the points on no surface if that differs (`STEEL_CHANGE`), and what bars
    leave is searched in other tubes (`NARROWER`, `WIDER`).
    ``min_votes``: minimum number of ridge voxels of a bar. ``on_stage`` is told each search by its name.
    """
    least_m = (voxel_m or 0.0) * TUBE_M / VOXEL_M

    def search(points: Array, tube_m: float) -> CloudBars:
        if on_stage is not None:
            on_stage(f"searching {len(points)} points in tubes of {tube_m:.2g} m")
        scale = tube_m / TUBE_M
        found = _bars_in_tubes(points / scale, voxel_m / scale if voxel_m else VOXEL_M, min_votes)
        return found if scale == 1.0 else found.scaled(scale, points)

    found = search(points, tube_m or max(default_tube(points), least_m))
    if tube_m is None:
        of_steel_m = max(default_tube(found.steel), least_m) if len(found.steel) > min_votes else found.tube_m
        if min(of_steel_m, found.tube_m) < STEEL_CHANGE * max(of_steel_m, found.tube_m):
            found = search(points, of_steel_m)
        if not found.all_on_surfaces:
            found = _in_wider_tubes(_in_narrower_tubes(found, least_m, search), search)
    return found.of_structures()


TubeSearch = Callable[[Array, float], CloudBars]
"""Points, and the radius of the tubes → their bars."""


def _in_narrower_tubes(found: CloudBars, least_m: float, search: TubeSearch) -> CloudBars:
    """The bars, and those of objects beside them that narrower tubes explain: masts whose members are close together,
    and models. The narrowest tube is ``least_m``, or what the distance of the object's points allows."""
    rest, slim = found.steel[found.is_off], found
    number = objects_of(rest, APART * found.tube_m)
    large = np.flatnonzero(np.bincount(number) > OBJECT_MIN * len(found.steel))
    for each in (rest[number == k] for k in large):
        narrowest_m = max(least_m, DX_PER_SPACING * spacing(each, 4))
        tubes = dict.fromkeys(max(multiple * found.tube_m, narrowest_m) for multiple in NARROWER)
        tries = (search(each, tube_m) for tube_m in tubes if tube_m < found.tube_m)
        best, least = None, 1.0
        for bars in tries:
            share = bars.share_off
            if share < least and (share < REST_MIN or (share < LATTICE_REST_MAX and bars.is_lattice)):
                best, least = bars, share
            if best is not None and (share > least or least < OFF_MIN):
                break
        slim = slim.joined(best) if best is not None else slim
    if len(found.bars) or not len(slim.bars) or np.bincount(number).max() == len(found.points):
        return slim
    whole = search(found.points, slim.tube_m)  # surfaces end nearer to slim members then
    return whole if whole.share_off < REST_MIN else slim


def _in_wider_tubes(found: CloudBars, search: TubeSearch) -> CloudBars:
    """The bars of wider tubes if those hold them, and else these, and wider ones among the points that they leave."""
    if not found.fit_tubes:
        tries = (search(found.points, multiple * found.tube_m) for multiple in WIDER)
        found = next((each for each in tries if each.fit_tubes and each.share_inside(found.bars) >= KEPT_MIN), found)
    for multiple in WIDER:
        rest = found.steel[found.is_off]
        if len(rest) < max(REST_MIN * len(found.steel), OFF_MIN * len(found.points)):
            break
        more = search(rest, multiple * found.tube_m)
        found = found.joined(more) if more.fit_tubes else found
    return found


def default_tube(points: Array) -> float:
    """Default radius of the tube of a bar, metres: 6 cm, or more for sparse clouds; at most a fortieth of the diagonal.

    Sparse clouds have 1.2 times the median distance of the points ``(N, 3)`` to their fourth nearest neighbours. In a
    cloud that was thinned by a voxel filter, this distance is the edge of the voxels, while nearest neighbours may be
    close together on both sides of a boundary.
    """
    diagonal_m = float(np.linalg.norm(np.ptp(points, axis=0)))
    return min(max(TUBE_M, DX_PER_SPACING * spacing(points, 4)), diagonal_m / TUBES_MIN)


def _bars_in_tubes(points: Array, voxel_m: float, min_votes: int) -> CloudBars:
    """`bars_of_cloud` with tubes of `TUBE_M`."""
    voxels = VoxelMap(voxel_m)
    voxels.insert(points)
    ridges = Ridges.of(voxels, SUM_VOXELS * voxel_m)
    free, surfaces = ridges.off_surfaces, ridges.surfaces
    label = surfaces.label_of(points)
    off, bars = points[label < 0], Segments.empty()
    if len(free) >= min_votes and np.linalg.norm(np.ptp(free, axis=0)) > 2 * LENGTH_MIN_M:
        bars = _tied(bars_on_ridges(free, min_votes, GRIDS, RISE_M), off)
        bars, is_weak = refitted(off, split_bends(off, bars, FIT_TUBES * TUBE_M, BEND_SHARE))
        bars = _tied(bars, off, is_weak)
    width_m = widths_of(off, bars)
    half_m, typical_m = np.maximum(0.5 * width_m, TUBE_M), float(np.median(width_m)) if len(bars) else math.nan
    on_bar = ~on_plates(free, bars, half_m, TUBE_M)
    bars, width_m = bars.take(on_bar), width_m[on_bar]
    freedom = freedom_of(ridges.points, bars, half_m[on_bar])
    sure = (freedom >= FREE_MIN) & ((bars.length >= SURE_M) | _held(bars, surfaces))
    bars, freedom, width_m = bars.take(sure), freedom[sure], width_m[sure]
    described = surfaces.described(label)
    return CloudBars(points, bars, freedom, width_m, described, label, voxel_m, TUBE_M, TUBE_M, typical_m)


def _tied(bars: Segments, points: Array, is_weak: NDArray[np.bool_] | None = None) -> Segments:
    """The bars, extended to their joints and merged: points at a joint belong to one bar, so the others have gaps
    there. The axes of those in the mask ``is_weak (B,)`` run from joint to joint."""
    width_m = widths_of(points, bars)
    joint, tie, tied = find_joints(bars, width_m)
    if is_weak is not None:
        tied = between_joints(tied, joint, tie, is_weak)
    return merge_pieces(tied, width_m, RISE_M)


def _held(bars: Segments, surfaces: Surfaces) -> NDArray[np.bool_]:
    """Whether an end of each bar, extended a little, meets another bar, and the other end one or a surface ``(B,)``."""
    beyond = beyond_ends(bars, REACH_M, 0.5 * TUBE_M)
    at_surface = surfaces.label_of(beyond.reshape(-1, 3)).reshape(beyond.shape[:3]).max(axis=1) >= 0
    at_bar = at_bars(bars, TUBE_M)
    return np.asarray((at_bar | at_surface.T).all(axis=1) & at_bar.any(axis=1))
