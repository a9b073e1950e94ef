"""Whether lines run along bars, in a surface, or through a volume: lines can be laid through any cloud."""

import numpy as np
from scipy.spatial import cKDTree

from steelnb.datatypes import Array, Segments

FREE_MAX = 1.6
"""Dimension up to which a line runs free: between that of bars, 1, and that of surfaces, 2."""


def dimensions(points: Array, bars: Segments, radius_m: float) -> Array:
    """Of how many dimensions the points ``(N, 3)`` around each of B bars are ``(B,)``.

    1 along a bar that runs alone, 2 in a surface, 3 in a volume: by how much more points are in spheres of twice the
    radius (correlation dimension, Grassberger and Procaccia 1983). The spheres, half a radius apart, are pooled, since
    a single one holds few points in a coarse cloud, and their quotients would scatter by more than one dimension.
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


def free_share(points: Array, bars: Segments, radius_m: float) -> float:
    """Share of the length of all bars that runs free of surfaces and volumes, 0 to 1; 0 without a bar.

    Of the lines laid through planes, spheres, pipes, boxes and noise at most 2 % of the length does, at whatever
    density; of a tower scanned closely three quarters or more. On a tower whose points are as far apart as a quarter of
    the space between its bars, most lines have others within the spheres, and 10 to 30 % do.
    """
    if not len(bars):
        return 0.0
    free = dimensions(points, bars, radius_m) < FREE_MAX
    return float(bars.length[free].sum() / bars.length.sum())
