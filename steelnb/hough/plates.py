"""Lines on small plates, such as gussets at joints: too small for a surface, and long enough for a bar."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.spatial import cKDTree

from steelnb.core.types import Array, Segments

COVERED_MIN = 0.4
"""Minimum covered share of the disc beside a line on a plate: along the edge of a square plate it is half, and beside
bars at most 0.3, where many members meet (merged clouds of five towers, seeds 11 and 12)."""
LENGTH_MAX, RADIUS_MIN = 25.0, 3.0
"""Maximum length of a line on a plate, in cells, as larger plates are surfaces; and minimum radius of the disc, in
half-widths."""
TURNS_RAD = np.linspace(0.0, np.pi, 12, endpoint=False)
"""Angles about a line at which planes are tried."""


def on_plates(points: Array, segments: Segments, half_m: Array, cell_m: float) -> NDArray[np.bool_]:
    """Whether each segment lies on a plate ``(S,)``, which is about as wide as the segment is long.

    A segment lies on a plate if the ``points (N, 3)`` cover `COVERED_MIN` of the disc beside it, in some plane through
    it. The segment is a diameter of this disc, whose radius is at least `RADIUS_MIN` half-widths ``half_m (S,)``. Its
    ends do not count, where it meets other bars. ``cell_m``: edge of the cells that points cover. All in metres.
    """
    is_on, length = np.zeros(len(segments), dtype=bool), segments.length
    short = np.flatnonzero(length <= LENGTH_MAX * cell_m)
    if not len(points) or not len(short):
        return is_on
    middle, radius_m = segments.middle, np.maximum(0.5 * length, RADIUS_MIN * half_m)
    around = cKDTree(points).query_ball_point(middle[short], radius_m[short])
    for k, near in zip(short.tolist(), around, strict=True):
        axis = segments.direction[k]
        offset = points[near] - middle[k]
        along, across = offset @ axis, offset @ null_space(axis[None])
        beside = np.linalg.norm(across, axis=1) > half_m[k]
        share = _covered(along[beside], across[beside], 0.5 * length[k], half_m[k], radius_m[k], cell_m)
        is_on[k] = share >= COVERED_MIN
    return is_on


def _covered(along: Array, across: Array, end_m: float, half_m: float, radius_m: float, cell_m: float) -> float:
    """The largest share of the cells beside a segment, in a disc around its middle, that points cover, over the planes
    through it. ``along (N,)``, ``across (N, 2)``: coordinates of the points; ``end_m``: that of the segment's end."""
    size = math.ceil(2 * radius_m / cell_m)
    edge_m = 2 * radius_m / size
    centre = (np.arange(size) + 0.5) * edge_m - radius_m
    x, y = np.abs(centre)[:, None], np.abs(centre)
    is_beside = (np.hypot(x, y) <= radius_m) & (x <= end_m - half_m) & (y > half_m)
    aside, off = (across @ [np.cos(turn), np.sin(turn)] for turn in (TURNS_RAD, TURNS_RAD + 0.5 * np.pi))
    point, plane = np.nonzero(np.abs(off) <= cell_m)
    cell = [((each + radius_m) / edge_m).astype(np.int64) for each in (along[point], aside[point, plane])]
    is_covered = np.zeros((len(TURNS_RAD), size, size), dtype=bool)
    is_covered[(plane, *np.minimum(cell, size - 1))] = True
    return float((is_covered & is_beside).sum(axis=(1, 2)).max() / max(np.count_nonzero(is_beside), 1))
