"""Directions of the lines in which a scanner samples a surface: a spinning one leaves rings on the ground, and rows on
walls. Between them there may be metres."""

import math

import numpy as np
from scipy.spatial import cKDTree

from steelnb.core.types import Array

POINTS_MAX, AROUND_MAX, LINES_MIN = 2000, 12, 20
"""Maximum number of points at which the direction is measured, and of points around each; and minimum number of those
that lie along a line."""
FLAT_MAX = 0.1
"""Maximum ratio of the variances across and along a line."""
BINS, STRONGEST = 36, 4
"""Number of bins of 180°, and of the strongest directions, each of three bins. A lattice has no more: chords, struts
and two diagonals."""


def direction_shares(points: Array, normal: Array, radius_m: float) -> Array:
    """Shares of the lines in a plane that run in the strongest direction, in the strongest of the others, and so on
    ``(STRONGEST,)``; NaN with too few lines.

    ``points (N, 3)``, metres, in the plane with the unit ``normal (3,)``. Lines are what the points within ``radius_m``
    of some of them lie along.
    """
    shares = np.full(STRONGEST, math.nan)
    if len(points) < LINES_MIN:
        return shares
    u, v = np.linalg.svd(normal[None, :])[2][1:]
    flat = points @ np.column_stack([u, v])
    some = flat[:: -(-len(flat) // POINTS_MAX)]
    distance, near = cKDTree(flat).query(some, min(AROUND_MAX, len(flat)), distance_upper_bound=radius_m)
    inside = np.isfinite(distance)
    offset = np.where(inside[..., None], flat[np.where(inside, near, 0)] - some[:, None], 0.0)
    count = inside.sum(axis=1)
    x, y = np.moveaxis((offset - (offset.sum(axis=1) / count[:, None])[:, None]) * inside[..., None], -1, 0)
    xx, xy, yy = (x * x).sum(axis=1), (x * y).sum(axis=1), (y * y).sum(axis=1)
    root = np.hypot(0.5 * (xx - yy), xy)
    is_line = (count > 3) & (0.5 * (xx + yy) - root < FLAT_MAX * (0.5 * (xx + yy) + root))
    if np.count_nonzero(is_line) < LINES_MIN:
        return shares
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)[is_line] % math.pi
    lines = np.bincount((angle / math.pi * BINS).astype(np.int64) % BINS, minlength=BINS).astype(float)
    total = lines.sum()
    for k in range(STRONGEST):
        three = lines + np.roll(lines, 1) + np.roll(lines, -1)
        best = int(three.argmax())
        shares[k] = three[best] / total
        lines[[best - 1, best, (best + 1) % BINS]] = 0.0
    return shares
