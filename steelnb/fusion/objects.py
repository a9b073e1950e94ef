"""Which bars belong to a structure: a tower is its bars, while a tree or a car has some lines as well."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from steelnb.core.types import Array, IntArray, Segments
from steelnb.fusion.candidates import beyond_ends
from steelnb.fusion.joints import REACH_M
from steelnb.fusion.ridges import TUBE_M
from steelnb.hough.whole_structure.search import within

APART, BESIDE = 2.0, 1.8
"""Edge of the cells of an object, in radii of the tube; and the maximum distance of neighbours, in cells."""
AROUND, EXPLAINED_MIN = 10.0, 0.7
"""Distance to a structure of the points around it, in radii of the tube, and the minimum share of them on its bars.
Trees and cars have 0.1 to 0.7, towers 0.9 to 1, and 0.5 to 0.7 with trees that reach into them."""
HELD_MIN = 0.6
"""Minimum share of the bars that end at others, where bars explain less. Lattices have 0.7 to 1, trees up to 0.5."""
STEP_M = 0.3
"""Distance of the points of an axis that tell which object its bar is part of."""


def objects_of(points: Array, cell_m: float) -> IntArray:
    """Number of the object of each point ``(N,)``: what hangs together in cells of this edge."""
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    cells, cell = np.unique(np.floor(points / cell_m), axis=0, return_inverse=True)
    pair = cKDTree(cells).query_pairs(BESIDE, output_type="ndarray")
    size = (len(cells), len(cells))
    _, group = connected_components(coo_array((np.ones(len(pair)), tuple(pair.T)), shape=size), directed=False)
    return np.asarray(group[cell.ravel()], dtype=np.int64)


def at_bars(bars: Segments, tube_m: float) -> NDArray[np.bool_]:
    """Whether each end of each bar, extended a little, meets another bar ``(B, 2)``."""
    number = np.arange(len(bars))
    beyond = beyond_ends(bars, REACH_M / TUBE_M * tube_m, 0.5 * tube_m)
    meets = [
        within(beyond[:, :, k].reshape(-1, 3), bars.take(number != k), 1.5 * tube_m).reshape(2, -1).any(axis=1)
        for k in number
    ]
    return np.array(meets, dtype=bool).reshape(len(bars), 2)


def in_structures(points: Array, on_bar: NDArray[np.bool_], bars: Segments, tube_m: float) -> NDArray[np.bool_]:
    """Whether each bar belongs to a structure ``(B,)``: bars that hang together are one if they explain most points
    around them, or end at each other, as those of a lattice do.

    ``points (N, 3)``: those on no surface; ``on_bar (N,)``: whether a point lies on a bar.
    """
    if not on_bar.any():
        return np.zeros(len(bars), dtype=bool)
    number, steel = objects_of(points[on_bar], APART * tube_m), cKDTree(points[on_bar])
    distance, nearest = steel.query(points, distance_upper_bound=AROUND * tube_m)
    around = np.bincount(number[nearest[np.isfinite(distance)]], minlength=number.max() + 1)
    explained = np.bincount(number) / around
    lengths = zip(bars.start, bars.end, bars.length, strict=True)
    axes = (np.linspace(start, end, 3 + int(length / STEP_M))[1:-1] for start, end, length in lengths)
    own = np.array([np.bincount(number[steel.query(axis)[1]]).argmax() for axis in axes])
    size = len(explained)
    held = np.bincount(own, at_bars(bars, tube_m).all(axis=1), size) / np.maximum(np.bincount(own, minlength=size), 1)
    return np.asarray((explained[own] >= EXPLAINED_MIN) | (held[own] >= HELD_MIN))
