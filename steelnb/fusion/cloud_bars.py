"""The bars of a merged cloud, without scans and poses: lines on ridges of its density, off surfaces (`bars_of_cloud`).

In this order: bars refitted to their points, and their widths (`refitted`); those of structures, told from lines in
trees and vehicles by what lies around them and where they end (`in_structures`); what was found (`CloudBars`); and the
search in tubes of several widths.
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
from steelnb.fusion.bars import (
    GRIDS,
    LENGTH_MIN_M,
    TUBE_M,
    VOXEL_M,
    Ridges,
    bars_on_ridges,
    beyond_ends,
    merge_pieces,
    split_bends,
)
from steelnb.fusion.joints import REACH_M, TILT_DETERMINED_RAD, between_joints, find_joints
from steelnb.hough.lines import DX_PER_SPACING, spacing
from steelnb.hough.near_segments import ALONG_M, FREE_MIN, freedom_of, nearest_bar, on_plates, within
from steelnb.hough.whole_structure import MIN_VOTES
from steelnb.points import VoxelMap
from steelnb.points.surfaces import Surface, Surfaces
from steelnb.points.voxel_map import pack

HALF_WIDTH_SHARE = 0.9
"""Share of a bar's points that lie within half its width of its axis."""
FIT_TUBES, FIT_ROUNDS, FIT_SCALE = 1.5, 3, 1.5
"""See `refitted`: distance of points in tube radii, rounds of weights, and the scale of these in
median distances."""
TURN_MAX_RAD = math.radians(20)


def refitted(points: Array, bars: Segments) -> tuple[Segments, NDArray[np.bool_]]:
    """The bars, each along the principal axis of the ``points (N, 3)`` that are nearest to it, and a mask ``(B,)`` of
    those whose points do not determine their direction.

    Contracted voxels give the direction of a short bar to some ten degrees only, its points to a few. Points have
    Geman-McClure weights, since some of them lie on bars that were not found. A bar is extended to those past its ends,
    up to a tube's radius. One that would turn by more than `TURN_MAX_RAD` keeps its axis.
    """
    start, end, is_weak, direction = bars.start.copy(), bars.end.copy(), np.ones(len(bars), dtype=bool), bars.direction
    for bar, own in enumerate(_own_points(points, bars, FIT_TUBES * TUBE_M, TUBE_M)):
        if len(own) < MIN_VOTES:
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


APART = 2.0
"""Edge of the cells of an object, in radii of the tube."""
ADJACENT = 1.8
"""Radius, in cells or voxels, that holds the 26 around each: those of one object, and those whose weights are summed
(``sum_m`` in `ridge_points`)."""
AROUND, EXPLAINED_MIN = 10.0, 0.7
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
    points: Array, on_bar: NDArray[np.bool_], bars: Segments, tube_m: float, surface: Array
) -> NDArray[np.bool_]:
    """Whether each bar belongs to a structure ``(B,)``.

    Bars that hang together are a structure if they are at most `ALONE`, if most of the points around them lie on bars,
    if that is so along most of their length, or if most of them end at other bars or at surfaces. Trees without leaves
    stand as clear: bars that are not `prefabricated` must end at others, too. Pieces in which few do are one with those
    that points connect them to.

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
        np.linspace(start, end, 3 + int(length / LENGTH_MIN_M))[1:-1]
        for start, end, length in zip(bars.start, bars.end, bars.length, strict=True)
    ]
    own = _most_at(axes, steel, number)
    count = np.bincount(own, minlength=len(around))
    is_structure = (count <= ALONE) | (np.bincount(number) >= EXPLAINED_MIN * around)
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
        np.bincount(own, weight, len(count)) for weight in (is_held, bars.length, bars.length * clear)
    )
    is_structure |= (held >= HELD_MIN * count) | (clear_m >= MOST * length_m)
    belongs = is_structure[own]
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


WIDTH_MAX = 3.0
"""Maximum median width of bars that fit in a tube, in its radii."""
OFF_MIN = 0.05
"""A cloud with a smaller share of its points off all surfaces has no bars worth a search in other tubes."""


@dataclass(frozen=True, eq=False)
class CloudBars:
    """The bars of a cloud ``points (N, 3)``, strongest first, and the surfaces that were left out.

    ``freedom (B,)``: share of the points around a bar that lie on it, 0 to 1 (`freedom_of`); ``width_m (B,)``;
    ``surfaces``; ``surface (N,)``: number of the surface that each point of the cloud lies on, or −1;
    ``voxel_m``: edge of the voxels in which the points were accumulated; ``tube_m``: radius of the tubes;
    ``narrowest_m``: radius of the narrowest tubes in which bars of slim members were found, else ``tube_m``;
    ``typical_m``: median width of the bars before those were dropped that do not stand free, NaN if there were none;
    ``apart``: number of bars that were dropped as part of no structure (`in_structures`).
    """

    points: Array
    bars: Segments
    freedom: Array
    width_m: Array
    surfaces: list[Surface]
    surface: IntArray
    voxel_m: float
    tube_m: float
    narrowest_m: float
    typical_m: float
    apart: int = 0

    def take(self, index: IntArray) -> "CloudBars":
        """The same with some bars, in this order."""
        return replace(self, bars=self.bars.take(index), freedom=self.freedom[index], width_m=self.width_m[index])

    @property
    def fit_tubes(self) -> bool:
        """Whether bars were found, and most fit in the tube. In a wider bar, lines along its sides pass for bars."""
        return len(self.bars) > 0 and self.typical_m <= WIDTH_MAX * self.tube_m

    @property
    def is_lattice(self) -> bool:
        """Whether most bars end at other bars, by the measure of `in_structures`."""
        return len(self.bars) > ALONE and at_bars(self.bars, self.tube_m).all(axis=1).mean() >= HELD_MIN

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

    def scaled(self, scale: float, points: Array) -> "CloudBars":
        """The same with all lengths multiplied; ``points (N, 3)``: the cloud at this scale."""
        bars = replace(
            self.bars, start=scale * self.bars.start, end=scale * self.bars.end, radius=scale * self.bars.radius
        )
        surfaces = [surface.scaled(scale) for surface in self.surfaces]
        lengths = {
            name: scale * getattr(self, name) for name in ("width_m", "voxel_m", "tube_m", "narrowest_m", "typical_m")
        }
        return replace(self, points=points, bars=bars, surfaces=surfaces, **lengths)

    @cached_property
    def steel(self) -> Array:
        """The points on no surface ``(M, 3)``."""
        return self.points[self.surface < 0]

    @cached_property
    def is_off(self) -> NDArray[np.bool_]:
        """Whether each of the points on no surface lies on no bar ``(M,)``."""
        return ~self.within(FIT_TUBES)

    def within(self, reach: float) -> NDArray[np.bool_]:
        """Whether each of the points on no surface lies within ``reach`` times the half-width of a bar, or times the
        tube if that is wider ``(M,)``."""
        reach_m = reach * np.maximum(0.5 * self.width_m, self.tube_m)
        return np.asarray(nearest_bar(self.steel, self.bars, reach_m, self.tube_m) >= 0)

    @property
    def share_off(self) -> float:
        """Share of the points on no surface that lie on no bar; 0 if all lie on surfaces."""
        return np.count_nonzero(self.is_off) / max(len(self.steel), 1)

    def joined(self, more: "CloudBars") -> "CloudBars":
        """These bars and those of other tubes, the strongest first."""
        bars = Segments.joined([self.bars, more.bars])
        order = np.argsort(-bars.count, kind="stable")
        freedom, width_m = np.append(self.freedom, more.freedom), np.append(self.width_m, more.width_m)
        first = self if len(self.bars) else more
        joined = replace(
            self, bars=bars, freedom=freedom, width_m=width_m, tube_m=first.tube_m, typical_m=first.typical_m,
            narrowest_m=min(self.narrowest_m, more.narrowest_m),
        )  # fmt: skip
        return joined.take(order)

    def of_structures(self) -> "CloudBars":
        """Those bars that belong to a structure."""
        belongs = in_structures(self.steel, ~self.is_off, self.bars, self.tube_m, self.points[self.surface >= 0])
        return replace(self.take(np.flatnonzero(belongs)), apart=int(np.count_nonzero(~belongs)))


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
    are split at bends, refitted to all points, extended to their joints and merged (`fusion.bars`,
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
    ridges = Ridges.of(voxels, ADJACENT * voxel_m)
    free, surfaces = ridges.off_surfaces, ridges.surfaces
    label = surfaces.label_of(points)
    off, bars = points[label < 0], Segments.empty()
    if len(free) >= min_votes and np.linalg.norm(np.ptp(free, axis=0)) > 2 * LENGTH_MIN_M:
        bars = _tied(bars_on_ridges(free, min_votes, GRIDS, REACH_M), off)
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
    return merge_pieces(tied, width_m, REACH_M)


def _held(bars: Segments, surfaces: Surfaces) -> NDArray[np.bool_]:
    """Whether an end of each bar, extended a little, meets another bar, and the other end one or a surface ``(B,)``."""
    beyond = beyond_ends(bars, REACH_M, TUBE_M)
    at_surface = surfaces.label_of(beyond.reshape(-1, 3)).reshape(beyond.shape[:3]).max(axis=1) >= 0
    at_bar = at_bars(bars, TUBE_M)
    return np.asarray((at_bar | at_surface.T).all(axis=1) & at_bar.any(axis=1))
