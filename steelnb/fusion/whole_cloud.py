"""The bars of a merged cloud, without scans and poses: lines on ridges of its density, surfaces left out."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from steelnb.core.types import Array, IntArray, Segments
from steelnb.fusion.candidates import (
    GRIDS,
    LENGTH_MIN_M,
    bars_on_ridges,
    beyond_ends,
    merge_pieces,
    split_bends,
)
from steelnb.fusion.joints import REACH_M, between_joints, find_joints
from steelnb.fusion.refit import FIT_TUBES, refitted, widths_of
from steelnb.fusion.ridges import TUBE_M, VOXEL_M, Ridges
from steelnb.hough.freedom import ALONG_M, FREE_MIN, freedom_of, nearest_bar
from steelnb.hough.lines import DX_PER_SPACING, spacing
from steelnb.hough.whole_structure.search import MIN_VOTES, within
from steelnb.points import VoxelMap
from steelnb.points.surfaces import Surface, Surfaces

RISE_M, SUM_VOXELS = 0.2, 1.8
"""See `merge_pieces`, and ``sum_m`` in `ridge_points`, in voxels."""
SURE_M = 0.8
"""A bar that is shorter than this needs a bar at an end, and a bar or a surface at the other: where a flight has seen
half of a member, it lies askew."""
BEND_SHARE = 0.95
"""``share_max`` in `split_bends`: all points tell bends that are small beside the section."""
TUBES_MIN = 40
"""Minimum size of a cloud in tubes: the bars of a small model are thinner than those of a tower."""
WIDER, WIDTH_MAX, KEPT_MIN = (2, 4), 3.0, 0.9
"""Wider tubes to try, in multiples of the default; the maximum median width of bars that fit in a tube, in its radii;
and the minimum share of the default's length that lies inside theirs."""
REST_MIN, MODEL_MIN = 0.2, 0.5
"""Minimum share of the points on no surface that lie on no bar, for another search with wider tubes among them; and for
one with narrower tubes in the whole cloud, as of a scale model, which counts if it leaves less than the first."""
STEEL_MAX = 0.9
"""A cloud is searched again if the points on no surface call for a tube below this share of that of the whole cloud:
ground may be sampled more sparsely than steel."""
OFF_MIN = 0.05
"""A cloud with a smaller share of its points off all surfaces has no bars worth a search with wider tubes."""


@dataclass(frozen=True, eq=False)
class CloudBars:
    """The bars of a cloud, strongest first, and the surfaces that were left out.

    ``freedom (B,)``: share of the points around a bar that lie on it, 0 to 1 (`freedom_of`); ``width_m (B,)``;
    ``surfaces``; ``surface (N,)``: number of the surface that each point of the cloud lies on, or −1;
    ``voxel_m``: edge of the voxels in which the points were accumulated; ``tube_m``: radius of the tubes;
    ``typical_m``: median width of the bars before those were dropped that do not stand free, NaN if there were none.
    """

    bars: Segments
    freedom: Array
    width_m: Array
    surfaces: list[Surface]
    surface: IntArray
    voxel_m: float
    tube_m: float
    typical_m: float

    def take(self, index: IntArray) -> "CloudBars":
        """The same with some bars, in this order."""
        return replace(self, bars=self.bars.take(index), freedom=self.freedom[index], width_m=self.width_m[index])

    @property
    def fit_tubes(self) -> bool:
        """Whether bars were found, and most fit in the tube. In a wider bar, lines along its sides pass for bars."""
        return len(self.bars) > 0 and self.typical_m <= WIDTH_MAX * self.tube_m

    @property
    def all_on_surfaces(self) -> bool:
        """Whether less than `OFF_MIN` of the points lie on no surface."""
        return float((self.surface < 0).mean()) < OFF_MIN

    def share_inside(self, bars: Segments) -> float:
        """Share of the length of other bars that lies inside these: one wide bar may hold several lines along its
        sides. 1 if there are none."""
        if not len(bars):
            return 1.0
        ends = zip(bars.start, bars.end, bars.length, strict=True)
        along = np.concatenate([np.linspace(a, b, 2 + int(length / ALONG_M))[:-1] for a, b, length in ends])
        return float((nearest_bar(along, self.bars, 0.5 * WIDTH_MAX * self.tube_m, self.tube_m) >= 0).mean())

    def scaled(self, scale: float) -> "CloudBars":
        """The same with all lengths multiplied."""
        bars = replace(
            self.bars, start=scale * self.bars.start, end=scale * self.bars.end, radius=scale * self.bars.radius
        )
        surfaces = [surface.scaled(scale) for surface in self.surfaces]
        lengths = {name: scale * getattr(self, name) for name in ("width_m", "voxel_m", "tube_m", "typical_m")}
        return replace(self, bars=bars, surfaces=surfaces, **lengths)

    def off(self, points: Array) -> Array:
        """Those of the cloud's points ``(N, 3)`` that lie on no surface and on no bar: ``(M, 3)``."""
        rest, half_m = points[self.surface < 0], FIT_TUBES * np.maximum(0.5 * self.width_m, self.tube_m)
        for bar in range(len(self.bars)):
            rest = rest[nearest_bar(rest, self.bars.take(np.array([bar])), float(half_m[bar]), self.tube_m) < 0]
        return rest

    def share_off(self, points: Array) -> float:
        """Share of the points ``(N, 3)`` on no surface that lie on no bar; 0 if all lie on surfaces."""
        return len(self.off(points)) / max(int(np.count_nonzero(self.surface < 0)), 1)

    def joined(self, wider: "CloudBars") -> "CloudBars":
        """These bars and wider ones, the strongest first."""
        bars = Segments.joined([self.bars, wider.bars])
        order = np.argsort(np.append(-self.bars.count, -wider.bars.count), kind="stable")
        freedom, width_m = np.append(self.freedom, wider.freedom), np.append(self.width_m, wider.width_m)
        return replace(self, bars=bars, freedom=freedom, width_m=width_m).take(order)


def bars_of_cloud(
    points: Array, tube_m: float | None = None, voxel_m: float | None = None, min_votes: int = MIN_VOTES
) -> CloudBars:
    """Find the bars of a cloud ``(N, 3)``, metres, z up, finite.

    Points are accumulated in voxels of edge ``voxel_m``, by default two thirds of the tube, and only voxels on ridges
    of their weight remain: range noise spreads the rest. Surfaces are left out (`surfaces_of`). Lines through the rest
    are split at bends, refitted to all points, extended to their joints and merged (`fusion.candidates`,
    `fusion.joints`). A bar stands free (`freedom_of`), and if it is short, its ends meet others.

    ``tube_m``: radius of the tube that holds a bar's points. All lengths of the search are proportional to it. By
    default, it is that of `default_tube`, for the points on no surface if that is less (`STEEL_MAX`); if the bars do
    not fit in it, twice and four times that are tried. If they leave more than `REST_MIN` of the points on no surface,
    bars of these widths are sought in those; if they leave more than `MODEL_MIN`, narrower tubes are tried, down to the
    spacing of the points.
    ``min_votes``: minimum number of ridge voxels of a bar.
    """
    least_m = (voxel_m or 0.0) * TUBE_M / VOXEL_M
    narrow_m = tube_m or max(default_tube(points), least_m)
    found = _bars_at_scale(points, narrow_m / TUBE_M, voxel_m, min_votes)
    if tube_m is not None:
        return found
    steel = points[found.surface < 0]
    of_steel_m = max(default_tube(steel), least_m) if len(steel) > min_votes else narrow_m
    if of_steel_m < STEEL_MAX * narrow_m:
        narrow_m = of_steel_m
        found = _bars_at_scale(points, narrow_m / TUBE_M, voxel_m, min_votes)
    tries = (_bars_at_scale(points, each * narrow_m / TUBE_M, voxel_m, min_votes) for each in WIDER)
    if not found.fit_tubes and not found.all_on_surfaces:
        found = next((each for each in tries if each.fit_tubes and each.share_inside(found.bars) >= KEPT_MIN), found)
    rest, off = found.off(points), np.count_nonzero(found.surface < 0)
    for wider in WIDER:
        if len(rest) < max(REST_MIN * off, OFF_MIN * len(points)):
            break
        more = _bars_at_scale(rest, wider * found.tube_m / TUBE_M, voxel_m, min_votes)
        if more.fit_tubes:
            found = found.joined(more)
            rest = found.off(points)
    if len(rest) > MODEL_MIN * off and not found.all_on_surfaces:
        tubes, least = (narrow_m / 2**k for k in range(1, 6)), DX_PER_SPACING * spacing(points, 4)
        tries = (_bars_at_scale(points, each / TUBE_M, voxel_m, min_votes) for each in tubes if each >= least)
        found = next((each for each in tries if each.share_off(points) < REST_MIN), found)
    return found


def default_tube(points: Array) -> float:
    """Default radius of the tube of a bar, metres: 6 cm, or more for sparse clouds; at most a fortieth of the diagonal.

    Sparse clouds have 1.2 times the median distance of the points ``(N, 3)`` to their fourth nearest neighbours. In a
    cloud that was thinned by a voxel filter, this distance is the edge of the voxels, while nearest neighbours may be
    close together on both sides of a boundary.
    """
    diagonal_m = float(np.linalg.norm(np.ptp(points, axis=0)))
    return min(max(TUBE_M, DX_PER_SPACING * spacing(points, 4)), diagonal_m / TUBES_MIN)


def _bars_at_scale(points: Array, scale: float, voxel_m: float | None, min_votes: int) -> CloudBars:
    """`bars_of_cloud` with tubes of this many times `TUBE_M`."""
    found = _bars_in_tubes(points / scale, voxel_m / scale if voxel_m else VOXEL_M, min_votes)
    return found if scale == 1.0 else found.scaled(scale)


def _bars_in_tubes(points: Array, voxel_m: float, min_votes: int) -> CloudBars:
    """`bars_of_cloud` with tubes of `TUBE_M`."""
    voxels = VoxelMap(voxel_m)
    voxels.insert(points)
    ridges = Ridges.of(voxels, SUM_VOXELS * voxel_m)
    free, surfaces = ridges.off_surfaces, ridges.surfaces
    label = surfaces.label_of(points)
    off, bars = points[label < 0], Segments.empty()
    if len(free) >= min_votes and np.linalg.norm(np.ptp(free, axis=0)) > 2 * LENGTH_MIN_M:
        bars = _tied(bars_on_ridges(free, TUBE_M, min_votes, GRIDS, RISE_M), off)
        bars, is_weak = refitted(off, split_bends(off, bars, FIT_TUBES * TUBE_M, BEND_SHARE))
        bars = _tied(bars, off, is_weak)
    width_m = widths_of(off, bars)
    freedom = freedom_of(ridges.points, bars, np.maximum(0.5 * width_m, TUBE_M))
    sure = (freedom >= FREE_MIN) & ((bars.length >= SURE_M) | _held(bars, surfaces))
    typical_m = float(np.median(width_m)) if len(bars) else math.nan
    bars, freedom, width_m = bars.take(sure), freedom[sure], width_m[sure]
    return CloudBars(bars, freedom, width_m, surfaces.described(label), label, voxel_m, TUBE_M, typical_m)


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
    number, beyond = np.arange(len(bars)), beyond_ends(bars, REACH_M, 0.5 * TUBE_M)
    at_surface = surfaces.label_of(beyond.reshape(-1, 3)).reshape(beyond.shape[:3]).max(axis=1) >= 0
    others = (bars.take(number != k) for k in number)
    held = [
        within(beyond[:, :, k].reshape(-1, 3), each, 1.5 * TUBE_M).reshape(2, -1).any(axis=1)
        for k, each in zip(number, others, strict=True)
    ]
    at_bar = np.array(held, dtype=bool).reshape(len(bars), 2).T
    return np.asarray((at_bar | at_surface).all(axis=0) & at_bar.any(axis=0))
