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
BINS, SIDE_BINS, STRONGEST = 36, 4, 4
"""Number of bins of 180°; of those to each side of the direction of rows, which curve; and of the strongest directions
of a lattice, each of three bins: chords, struts and two diagonals."""


def line_directions(points: Array, normal: Array, radius_m: float) -> Array:
    """Numbers of lines in a plane by their direction ``(BINS,)``, over 180°; all 0 if there are fewer than `LINES_MIN`.

    ``points (N, 3)``, metres, in the plane with the unit ``normal (3,)``. A line is counted at a point if those within
    ``radius_m`` of it lie along one.
    """
    if len(points) < LINES_MIN:
        return np.zeros(BINS)
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
        return np.zeros(BINS)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)[is_line] % math.pi
    return np.bincount((angle / math.pi * BINS).astype(np.int64) % BINS, minlength=BINS).astype(float)


def share_of_rows(lines: Array) -> float:
    """Share of the lines ``(BINS,)`` within `SIDE_BINS` of the strongest direction; 0 without lines."""
    around = sum(np.roll(lines, shift) for shift in range(-SIDE_BINS, SIDE_BINS + 1))
    return float(np.max(around) / max(lines.sum(), 1.0))


def share_of_lattice(lines: Array) -> float:
    """Share of the lines ``(BINS,)`` in the `STRONGEST` directions; 1 without lines."""
    left, total = lines.copy(), lines.sum()
    for _ in range(STRONGEST):
        best = int((left + np.roll(left, 1) + np.roll(left, -1)).argmax())
        left[[best - 1, best, (best + 1) % BINS]] = 0.0
    return float(1.0 - left.sum() / total) if total else 1.0
