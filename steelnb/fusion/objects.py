"""Bars of a structure, told from lines in trees and vehicles, by what lies around them and where they end."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steelnb.core.geometry import connected
from steelnb.core.types import Array, IntArray, Segments
from steelnb.fusion.candidates import beyond_ends
from steelnb.fusion.joints import REACH_M
from steelnb.fusion.ridges import TUBE_M
from steelnb.hough.whole_structure.search import within
from steelnb.points.voxel_kernels import pack

APART, BESIDE = 2.0, 1.8
"""Edge of the cells of an object, in radii of the tube; and the maximum distance of neighbours, in cells."""
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
STEP_M = 0.3
"""Distance of the points of an axis that tell which object its bar is part of."""


def objects_of(points: Array, cell_m: float) -> IntArray:
    """Number of the object of each point ``(N,)``: what hangs together in cells of this edge."""
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    cells = np.floor(points / cell_m)
    _, one, cell = np.unique(pack(*cells.astype(np.int64).T), return_index=True, return_inverse=True)
    pair = cKDTree(cells[one]).query_pairs(BESIDE, output_type="ndarray")
    return connected(pair, len(one))[cell]


def at_bars(bars: Segments, tube_m: float, these: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
    """Whether each end of each bar, extended a little, meets another bar, or another of ``these (B,)``: ``(B, 2)``."""
    these = np.ones(len(bars), dtype=bool) if these is None else these
    beyond = beyond_ends(bars, REACH_M / TUBE_M * tube_m, 0.5 * tube_m)
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
        np.linspace(start, end, 3 + int(length / STEP_M))[1:-1]
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
