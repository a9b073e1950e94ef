"""Bars against planar and volumetric regions: a line detector finds lines in any cloud."""

import numpy as np
from scipy.spatial import cKDTree

from steelnb import rng
from steelnb.hough.blocks import segment_structure, within
from steelnb.points import voxel_grid
from steelnb.types import Array, Segments

DIMENSION_MAX = 1.6
"""Dimension up to which a line counts as a bar: between 1, that of bars, and 2, that of surfaces. Chosen on simulated
planes, spheres, pipes, boxes and noise, of whose lines at most 2 % lie below it, and on simulated towers."""
EXPLAINED_MIN, SURROGATE_MIN, SURROGATE_MAX = 0.5, 0.3, 0.8
"""Least share of the points of a lattice that its lines explain; bounds of the share of its surrogate's, as a part of
that. Chosen on the same shapes, on simulated lattices with bars 3 to 10 tubes apart, and on ten surveyed towers; the
shares measured are in `is_lattice`."""
NEIGHBOURS, MOVE = 30, 3.0
"""Neighbours of a point that give its tangent plane; largest move of a surrogate's point along it, in tubes."""


def dimensions(points: Array, bars: Segments, radius_m: float) -> Array:
    """Correlation dimension ``(B,)`` of the points ``(N, 3)`` around each of B bars (Grassberger and Procaccia 1983).

    1 along a bar that stands alone, 2 in a planar and 3 in a volumetric region: log2 of the ratio of the points in
    spheres of twice ``radius_m`` to those in spheres of ``radius_m``. The spheres, half a radius apart, are pooled,
    since a single one holds few points in a coarse cloud, and the ratios would scatter by more than one dimension.
    """
    count = np.maximum(2 * bars.length / radius_m, 3).astype(np.int64)
    bar = np.repeat(np.arange(len(bars)), count)
    place = np.arange(len(bar)) - np.repeat(np.cumsum(count) - count, count)
    share = (place / (count[bar] - 1))[:, None]
    at = bars.start[bar] + share * (bars.end[bar] - bars.start[bar])
    tree = cKDTree(points)
    inner, outer = (
        np.bincount(bar, tree.query_ball_point(at, radius, return_length=True), minlength=len(bars))
        for radius in (radius_m, 2 * radius_m)
    )
    return np.asarray(np.log2(np.maximum(outer, 1) / np.maximum(inner, 1)))


def linear_share(points: Array, bars: Segments, radius_m: float) -> float:
    """Share, 0 to 1, of the length of all bars that lies outside planar and volumetric regions; 0 without a bar.

    Of the lines found in planes, spheres, pipes, boxes and noise at most 2 % of the length does, at any density; of a
    tower scanned closely three quarters or more.
    """
    if not len(bars):
        return 0.0
    linear = dimensions(points, bars, radius_m) < DIMENSION_MAX
    return float(bars.length[linear].sum() / bars.length.sum())


def is_lattice(points: Array, lines: Segments, tube_m: float, min_votes: int, length_min: float) -> bool:
    """Whether the ``lines`` in a coarse cloud ``(N, 3)`` are bars of a lattice, with others in the spheres around them.

    Compared with a surrogate of the same surfaces or volume that holds no bars (Theiler et al., "Testing for
    nonlinearity in time series: the method of surrogate data", 1992): each point is moved at random along the plane of
    its neighbours, by up to `MOVE` tubes. Lines explain a surface almost as well after that as before (0.83 to 0.97 of
    the share of its points), but not a lattice (0.5 to 0.76 of simulated ones whose bars are 3 to 10 tubes apart, 0.37
    to 0.57 of surveyed ones), and hardly a third of a volume before. Of some hundred points in a volume, chance and the
    contraction of ridges may draw lines through most; the surrogate then keeps next to none (at most 0.24). The other
    parameters are those of `segment_structure`, as the lines were found with.
    """
    explained = within(points, lines, tube_m).mean()
    if explained < EXPLAINED_MIN or len(points) < NEIGHBOURS:
        return False
    apart = points[cKDTree(points).query(points, NEIGHBOURS)[1]]
    apart -= apart.mean(axis=1, keepdims=True)
    axes = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))[1]
    move = MOVE * tube_m * rng.stream(0, "surrogate").uniform(-1, 1, (len(points), 2))
    moved = points + move[:, :1] * axes[:, :, 2] + move[:, 1:] * axes[:, :, 1]
    moved = voxel_grid(moved, tube_m / np.sqrt(3))
    left = within(moved, segment_structure(moved, tube_m, min_votes, length_min), tube_m).mean()
    return bool(SURROGATE_MIN * explained < left < SURROGATE_MAX * explained)
