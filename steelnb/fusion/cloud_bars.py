"""The bars of a merged cloud, without scans and poses: lines on ridges of its density, off surfaces (`bars_of_cloud`).

In this order: bars refitted to their points, and their widths (`refitted`); those of structures, told from lines in
trees and vehicles by what lies around them and where they end (`in_structures`); what was found (`CloudBars`); and the
search.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steelnb.core.geometry import connected
from steelnb.core.robust import geman_mcclure
from steelnb.core.types import Array, IntArray, Segments
from steelnb.fusion.bars import TUBE_M, VOXEL_M, Ridges, beyond_ends, merge_pieces
from steelnb.fusion.joints import REACH_M, TILT_DETERMINED_RAD, between_joints, find_joints
from steelnb.hough.lines import spacing
from steelnb.hough.near_segments import nearest_bar, within
from steelnb.hough.tubes import COST, NEIGHBOUR, find_tubes
from steelnb.points import VoxelMap
from steelnb.points.surfaces import Surface, Surfaces
from steelnb.points.voxel_map import pack

HALF_WIDTH_SHARE = 0.9
"""Share of a bar's points that lie within half its width of its axis."""
FIT_TUBES, FIT_ROUNDS, FIT_SCALE = 1.5, 3, 1.5
"""See `refitted`: distance of points in tube radii, rounds of weights, and the scale of these in
median distances."""
TURN_MAX_RAD = math.radians(20)
POINTS_MIN = 8
"""Minimum number of points of a bar that is refitted."""


def refitted(points: Array, bars: Segments) -> tuple[Segments, NDArray[np.bool_]]:
    """The bars, each along the principal axis of the ``points (N, 3)`` that are nearest to it, and a mask ``(B,)`` of
    those whose points do not determine their direction.

    Contracted voxels give the direction of a short bar to some ten degrees only, its points to a few. Points have
    Geman-McClure weights, since some of them lie on bars that were not found. A bar is extended to those past its ends,
    up to a tube's radius. One that would turn by more than `TURN_MAX_RAD` keeps its axis.
    """
    start, end, is_weak, direction = bars.start.copy(), bars.end.copy(), np.ones(len(bars), dtype=bool), bars.direction
    for bar, own in enumerate(_own_points(points, bars, FIT_TUBES * TUBE_M, TUBE_M)):
        if len(own) < POINTS_MIN:
            continue
        weight = np.ones(len(own))
        for _ in range(FIT_ROUNDS):
            mean = weight @ own / weight.sum()
            offset = own - mean
            value, vector = np.linalg.eigh((weight[:, None] * offset).T @ offset / weight.sum())
            axis = vector[:, 2]
            squared = ((offset - (offset @ axis)[:, None] * axis) ** 2).sum(axis=1)
            weight, _ = geman_mcclure(squared, max(FIT_SCALE * math.sqrt(np.median(squared)), 1e-6))
        axis = axis * np.sign(axis @ direction[bar])
        if axis @ direction[bar] < math.cos(TURN_MAX_RAD):
            continue
        along = offset @ axis
        low, high = ((each[bar] - mean) @ axis for each in (bars.start, bars.end))
        start[bar], end[bar] = mean + min(low, along.min()) * axis, mean + max(high, along.max()) * axis
        tilt = math.sqrt(0.5 * max(value[0] + value[1], 0.0) / max(value[2] * len(own), 1e-12))
        is_weak[bar] = tilt > TILT_DETERMINED_RAD
    return replace(bars, start=start, end=end), is_weak


def _own_points(points: Array, bars: Segments, distance_m: float, margin_m: float = 0.0) -> Iterator[Array]:
    """For each bar, the points ``(K, 3)`` within this distance of its axis that are nearer to it than to others. An
    axis extends ``margin_m`` past the ends of its bar."""
    nearest = nearest_bar(points, bars, distance_m, margin_m)
    order = np.argsort(nearest, kind="stable")
    for first, last in itertools.pairwise(np.searchsorted(nearest[order], np.arange(len(bars) + 1))):
        yield points[order[first:last]]


def widths_of(points: Array, bars: Segments) -> Array:
    """Width ``(B,)`` of each bar, metres: twice the distance from its axis within which `HALF_WIDTH_SHARE` of its
    points lie. These are the ``points (N, 3)`` that are nearest to its axis and within two tube radii of it."""
    width_m, direction = np.full(len(bars), 2 * TUBE_M), bars.direction
    for bar, own in enumerate(_own_points(points, bars, 2 * TUBE_M)):
        if len(own):
            offset = own - bars.start[bar]
            across = offset - (offset @ direction[bar])[:, None] * direction[bar]
            width_m[bar] = 2 * np.quantile(np.linalg.norm(across, axis=1), HALF_WIDTH_SHARE)
    return width_m


STEP = 5.0
"""Length of the steps along an axis at which the points around it are counted, in radii of the tube."""
APART = 2.0
"""Edge of the cells of an object, in radii of the tube."""
ADJACENT = 1.8
"""Radius, in cells or voxels, that holds the 26 around each: those of one object, and those whose weights are summed
(``sum_m`` in `ridge_points`)."""
AROUND, EXPLAINED_MIN, EXPLAINED_SPARSE_MIN = 10.0, 0.9, 0.6
"""Distance to a structure of the points around it, in radii of the tube, and the minimum share of them on its bars.
Trees and cars have 0.1 to 0.7, towers 0.9 to 1, and 0.5 to 0.7 with trees that reach into them."""
HELD_MIN = 0.6
"""Minimum share of the bars that end at others or at a surface, where bars explain less. Lattices have 0.7 to 1, trees
up to 0.5."""
CLEAR_MIN, MOST = 0.9, 0.75
"""Where bars explain less: the minimum share of the points around a bar's axis, in the median along it, by which it is
clear of other things; and the minimum share of the length of bars that are. Some branches of a tree are clear."""
ALIKE_RAD, ALIKE_MIN = math.radians(3.0), 14.0
"""Angle within which two bars are parallel, and the minimum number of parallel pairs, in multiples of that of random
directions. Structures that end in the air have 18 to 260, trees 0 to 12; where members lean, a structure has fewer."""
BRANCHES, LOOSE_MAX = 20, 0.5
"""Minimum number of bars in all directions that are a tree: there are poles with many arms. And the maximum share of
them that end at others: trees have 0.1 to 0.2, and woods 0.4 to 0.5."""
CONTRAST_MIN = 1.0
"""Where bars explain less, a bar must be e times as dense as what lies around it. In a ball of random points lines have
0.2 to 1, in grass up to 1.5, and members 1 to 3."""
ALONE = 2
"""As many bars or fewer, such as a pole in a bush, need only stand free."""


def objects_of(points: Array, cell_m: float) -> IntArray:
    """Number of the object of each point ``(N,)``: what hangs together in cells of this edge."""
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    cells = np.floor(points / cell_m)
    _, one, cell = np.unique(pack(*cells.astype(np.int64).T), return_index=True, return_inverse=True)
    pair = cKDTree(cells[one]).query_pairs(ADJACENT, output_type="ndarray")
    return connected(pair, len(one))[cell]


def at_bars(bars: Segments, tube_m: float, these: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
    """Whether each end of each bar, extended a little, meets another bar, or another of ``these (B,)``: ``(B, 2)``."""
    these = np.ones(len(bars), dtype=bool) if these is None else these
    beyond = beyond_ends(bars, REACH_M / TUBE_M * tube_m, tube_m)
    owner = np.broadcast_to(np.where(these, np.cumsum(these) - 1, -1), beyond.shape[:3])
    meets = within(beyond.reshape(-1, 3), bars.take(these), 1.5 * tube_m, owner.ravel())
    return np.asarray(meets.reshape(owner.shape).any(axis=1).T)


def in_structures(
    points: Array,
    on_bar: NDArray[np.bool_],
    bars: Segments,
    tube_m: float,
    surface: Array,
    stands_out: NDArray[np.bool_],
    explained_min: float,
) -> NDArray[np.bool_]:
    """Whether each bar belongs to a structure ``(B,)``.

    Bars that hang together are a structure if they are at most `ALONE`, if most of the points around them lie on bars,
    if that is so along most of their length, or if most of them end at other bars or at surfaces. Trees without leaves
    stand as clear: bars that are not `prefabricated` must end at others, too. Pieces in which few do are one with those
    that points connect them to. Where bars explain less, those that do not stand out (``stands_out (B,)``) are none.

    ``points (N, 3)``: those on no surface; ``on_bar (N,)``: whether a point lies on a bar; ``surface (M, 3)``: the
    points on surfaces.
    """
    if not on_bar.any():
        return np.zeros(len(bars), dtype=bool)
    number, steel = objects_of(points[on_bar], APART * tube_m), cKDTree(points[on_bar], balanced_tree=False)
    distance, nearest = np.zeros(len(points)), np.cumsum(on_bar) - 1
    distance[~on_bar], nearest[~on_bar] = steel.query(points[~on_bar], distance_upper_bound=AROUND * tube_m)
    around = np.bincount(number[nearest[np.isfinite(distance)]], minlength=number.max() + 1)
    axes = [
        np.linspace(start, end, 3 + int(length / (STEP * TUBE_M)))[1:-1]
        for start, end, length in zip(bars.start, bars.end, bars.length, strict=True)
    ]
    own = _most_at(axes, steel, number)
    explained = np.bincount(number) >= explained_min * around
    stands_out = stands_out | explained[own]
    count = np.bincount(own, stands_out, len(around))
    is_structure = (count <= ALONE) | explained
    at_surface, clear = np.zeros((len(bars), 2), dtype=bool), np.zeros(len(bars), dtype=bool)
    if len(surface):
        nearby = cKDTree(surface, balanced_tree=False, compact_nodes=False)  # as in `spacing`
        at_surface = (nearby.query(np.stack([bars.start, bars.end]))[0] <= REACH_M / TUBE_M * tube_m).T
    is_held = np.asarray((at_surface | at_bars(bars, tube_m)).all(axis=1))
    doubtful = np.flatnonzero(~is_structure[own])
    every = cKDTree(points) if len(doubtful) else steel
    for bar in doubtful:
        on, near = (tree.query_ball_point(axes[bar], AROUND * tube_m, return_length=True) for tree in (steel, every))
        clear[bar] = np.median(on / np.maximum(near, 1)) >= CLEAR_MIN
    held, length_m, clear_m = (
        np.bincount(own, weight * stands_out, len(count)) for weight in (is_held, bars.length, bars.length * clear)
    )
    is_structure |= (held >= HELD_MIN * count) | (clear_m >= MOST * length_m)
    belongs = is_structure[own] & stands_out & (explained[own] | is_held | clear | (count <= ALONE)[own])
    is_ragged, is_near = held < LOOSE_MAX * count, np.isfinite(distance)
    if is_ragged.any():  # between two pieces of a tree, a branch may have too few points for a bar
        ragged = points[is_near][is_ragged[number[nearest[is_near]]]]
        piece = _most_at(axes, cKDTree(ragged), objects_of(ragged, APART * tube_m))
        own = np.where(is_ragged[own], len(count) + piece, own)
    for group in np.flatnonzero(np.bincount(own) >= BRANCHES):
        together = np.flatnonzero(own == group)
        loose = together[~prefabricated(bars.take(together), at_surface[together], tube_m)]
        belongs[loose] &= len(loose) < BRANCHES or is_held[loose].mean() >= LOOSE_MAX
    return belongs


def _most_at(axes: list[Array], points: cKDTree, number: IntArray) -> IntArray:
    """The object that most points of each axis are nearest to ``(B,)``; ``number (N,)``: that of each point."""
    return np.array([np.bincount(number[points.query(axis)[1]]).argmax() for axis in axes])


def prefabricated(bars: Segments, at_surface: NDArray[np.bool_], tube_m: float) -> NDArray[np.bool_]:
    """Whether each bar has one of a structure's few directions, stands on a surface, is part of a frame, or ends at
    such bars: ``(B,)``. Bars of a frame end at each other, or at surfaces, ``at_surface (B, 2)``. All bars are
    prefabricated unless hardly more are parallel than of random directions."""
    tree = cKDTree(np.concatenate([bars.direction, -bars.direction]))
    alike = tree.query_ball_point(bars.direction, 2 * math.sin(0.5 * ALIKE_RAD), return_length=True) - 1
    by_chance = (1 - math.cos(ALIKE_RAD)) * (len(bars) - 1)
    if alike.mean() >= ALIKE_MIN * by_chance:
        return np.ones(len(bars), dtype=bool)

    def held_by(these: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return np.asarray((at_surface | at_bars(bars, tube_m, these)).all(axis=1))

    frame = np.ones(len(bars), dtype=bool)
    while (frame & ~(held := held_by(frame))).any():
        frame &= held
    is_member = frame | at_surface.any(axis=1) | (alike >= max(ALONE, by_chance + 3 * math.sqrt(by_chance)))
    while (~is_member & (held := held_by(is_member))).any():
        is_member |= held
    return is_member


@dataclass(frozen=True, eq=False)
class CloudBars:
    """The bars of a cloud ``points (N, 3)``, the longest first, and the surfaces that were left out.

    ``confidence (B,)``: what each bar gains, nats (`hough.tubes`), and ``contrast (B,)``: each of its points;
    ``is_sure (B,)``: false for short ones that end at no other, and those of no structure; ``width_m (B,)``.
    ``surface (N,)``: number of the one of the ``surfaces`` that each point of the cloud lies on, or −1; ``apart_m``:
    distance of the points (`NEIGHBOUR`); ``tube_m``: radius of the tube that holds a bar; ``apart``: number of bars
    that belong to no structure (`in_structures`).
    """

    points: Array
    bars: Segments
    confidence: Array
    contrast: Array
    is_sure: NDArray[np.bool_]
    width_m: Array
    surfaces: list[Surface]
    surface: IntArray
    apart_m: float
    tube_m: float
    apart: int = 0

    def take(self, index: IntArray | NDArray[np.bool_]) -> "CloudBars":
        """The same with some bars, in this order."""
        names = ("confidence", "contrast", "is_sure", "width_m")
        return replace(self, bars=self.bars.take(index), **{name: getattr(self, name)[index] for name in names})

    def scaled(self, scale: float, points: Array) -> "CloudBars":
        """The same with all lengths multiplied; ``points (N, 3)``: the cloud at this scale."""
        bars = replace(
            self.bars, start=scale * self.bars.start, end=scale * self.bars.end, radius=scale * self.bars.radius
        )
        surfaces = [surface.scaled(scale) for surface in self.surfaces]
        lengths = {name: scale * getattr(self, name) for name in ("width_m", "apart_m", "tube_m")}
        return replace(self, points=points, bars=bars, surfaces=surfaces, **lengths)

    @cached_property
    def steel(self) -> Array:
        """The points on no surface ``(M, 3)``."""
        return self.points[self.surface < 0]

    def within(self, reach: float) -> NDArray[np.bool_]:
        """Whether each of the points on no surface lies within ``reach`` times the half-width of a bar, or times the
        tube if that is wider ``(M,)``."""
        reach_m = reach * np.maximum(0.5 * self.width_m, self.tube_m)
        return np.asarray(nearest_bar(self.steel, self.bars, reach_m, self.tube_m) >= 0)

    def judged(self) -> "CloudBars":
        """The same, without being sure of bars that belong to no structure."""
        is_sparse = self.apart_m >= NARROW_M / TUBE_M * self.tube_m
        explained_min = EXPLAINED_SPARSE_MIN if is_sparse else EXPLAINED_MIN
        sure = self.take(self.is_sure)
        on_bar, stands_out = sure.within(FIT_TUBES), sure.contrast >= CONTRAST_MIN
        surface = self.points[self.surface >= 0]
        belongs = in_structures(self.steel, on_bar, sure.bars, self.tube_m, surface, stands_out, explained_min)
        is_sure = self.is_sure.copy()
        is_sure[is_sure] = belongs
        return replace(self, is_sure=is_sure, apart=int(np.count_nonzero(~belongs)))


SURE_M = 0.8
"""A bar that is shorter than this needs a bar at an end, and a bar or a surface at the other: where a flight has seen
half of a member, it lies askew."""
NARROW_M = 0.04
"""Radius of the narrowest tube, metres. Where points are closer together, ridges are sought."""
TUBE_SPACINGS, CELL_SPACINGS, VOXEL_SPACINGS = 0.6, 1.3, 0.8
"""Minimum radius of a tube, length of its cells, and edge of voxels, in distances of fourth neighbours."""
TUBES_MIN = 40
"""Minimum size of a cloud in tubes: the bars of a small model are thinner than those of a tower."""


def bars_of_cloud(
    points: Array,
    tube_m: float | None = None,
    cost: float = COST,
    on_stage: Callable[[str], None] | None = None,
    keep_all: bool = False,
) -> CloudBars:
    """Find the bars of a cloud ``(N, 3)``, metres, z up, finite.

    Surfaces are left out (`surfaces_of`). Where points are closer together than bars are wide, only the ridges of their
    density remain. Bars are the tubes that gain at least ``cost`` nats among these (`hough.tubes`). They are extended
    to their joints, merged and refitted to all points (`fusion.joints`). If a bar is short, its ends meet others. Bars
    of trees and vehicles are left out (`in_structures`).

    ``tube_m``: radius of the tube that holds a bar's points; by default 6 cm, more where points are far apart
    (`TUBE_SPACINGS`), and at most a fortieth of the diagonal. All lengths of the search are proportional to it.
    ``on_stage`` is told what goes on. ``keep_all``: keep bars that are not sure.
    """
    apart_m = spacing(points, NEIGHBOUR)
    if tube_m is None:
        diagonal_m = float(np.linalg.norm(np.ptp(points, axis=0)))
        tube_m = min(max(TUBE_M, TUBE_SPACINGS * apart_m), diagonal_m / TUBES_MIN)
    if on_stage is not None:
        on_stage(f"searching {len(points)} points in tubes of {tube_m:.2g} m")
    scale = tube_m / TUBE_M
    found = _bars_in_tubes(points / scale, apart_m / scale, cost)
    found = (found if scale == 1.0 else found.scaled(scale, points)).judged()
    return found if keep_all else found.take(found.is_sure)


def _bars_in_tubes(points: Array, apart_m: float, cost: float) -> CloudBars:
    """`bars_of_cloud` with tubes of `TUBE_M`."""
    voxels = VoxelMap(max(VOXEL_M, VOXEL_SPACINGS * apart_m))
    voxels.insert(points)
    ridges = Ridges.of(voxels, ADJACENT * voxels.voxel_m)
    label = ridges.surfaces.label_of(points)
    off = points[label < 0]
    free = ridges.off_surfaces if apart_m < NARROW_M else off
    cell_m = max(2 * NARROW_M, CELL_SPACINGS * apart_m)
    search = find_tubes(free, NARROW_M, cell_m, cost)
    bars = _tied(search.found()[0], off)
    bars, is_weak = refitted(off, bars)
    bars = _tied(bars, off, is_weak)
    confidence, contrast = search.gains_of(bars)
    is_sure = (bars.length >= SURE_M) | _held(bars, ridges.surfaces)
    width_m, surfaces = widths_of(off, bars), ridges.surfaces.described(label)
    found = CloudBars(points, bars, confidence, contrast, is_sure, width_m, surfaces, label, apart_m, TUBE_M)
    order = np.argsort(-bars.length, kind="stable")
    return found.take(order[confidence[order] >= cost])


def _tied(bars: Segments, points: Array, is_weak: NDArray[np.bool_] | None = None) -> Segments:
    """The bars, extended to their joints and merged: points at a joint belong to one bar, so the others have gaps
    there. The axes of those in the mask ``is_weak (B,)`` run from joint to joint."""
    width_m = widths_of(points, bars)
    joint, tie, tied = find_joints(bars, width_m)
    if is_weak is not None:
        tied = between_joints(tied, joint, tie, is_weak)
    return merge_pieces(tied, width_m, REACH_M)


def _held(bars: Segments, surfaces: Surfaces) -> NDArray[np.bool_]:
    """Whether an end of each bar, extended a little, meets another bar, and the other end one or a surface ``(B,)``."""
    beyond = beyond_ends(bars, REACH_M, TUBE_M)
    at_surface = surfaces.label_of(beyond.reshape(-1, 3)).reshape(beyond.shape[:3]).max(axis=1) >= 0
    at_bar = at_bars(bars, TUBE_M)
    return np.asarray((at_bar | at_surface.T).all(axis=1) & at_bar.any(axis=1))
