"""Segments of small blocks of a whole structure, by the iterative Hough transform."""

import numpy as np

from steelnb.core.checks import checked_number, checked_points
from steelnb.core.kernels import njit
from steelnb.core.types import Array, Segments
from steelnb.hough.directions import directions
from steelnb.hough.segments import GAP
from steelnb.hough.segments_kernels import cut, filter_pieces
from steelnb.hough.transform import iterate

BLOCK = 12.0
"""Edge of a block in dx. Directions 8° apart (granularity 3) then miss the ends of a line by up to dx/2."""
GRANULARITY = 3
LENGTH, PCA_RATIO = 5.0, 0.9
"""Bounds of a segment: minimum length in dx, minimum share of the variance along it."""
SHIFTS = ((0, 0, 0), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1), (0, 0, 1), (0, 1, 0), (1, 0, 0))
"""Shifts of the grids of blocks, in half blocks."""


def propose(points: Array, dx: float, min_votes: int, length_min: float, grids: int) -> Segments:
    """Segments of every block, for `segment_structure`. The bounds are looser: a block may hold only part of a bar.

    They are those of `detect_segments`, whose checks take as long as the transform of a block. Raises `InputError`.
    """
    dx, votes, shortest_m = checked_number(dx, "dx", above=0), max(2, int(0.75 * min_votes)), (length_min - 1) * dx
    edge, sphere = BLOCK * dx, directions(GRANULARITY)
    points, parts = checked_points(points), [tuple(vars(Segments.empty()).values())]
    lowest = points.min(axis=0)
    for shift in SHIFTS[:grids]:
        cell = np.floor((points - lowest) / edge + 0.5 * np.array(shift)).astype(np.int64)
        order = np.lexsort(cell.T[::-1])
        grouped = points[order]
        x, y, z = (np.diff(column[order]) != 0 for column in cell.T)
        first = np.append(0, np.flatnonzero(x | y | z) + 1)
        lows, highs = (extreme.reduceat(grouped, first) for extreme in (np.minimum, np.maximum))
        centres, last = (lows + highs) / 2.0, np.append(first[1:], len(points))
        boxes, halves = highs - centres, np.maximum(_norms(highs - centres), _norms(lows - centres))
        is_full = (last - first >= 0.75 * min_votes) & (_norms(highs - lows) > shortest_m)
        for k in np.flatnonzero(is_full).tolist():
            block = grouped[first[k] : last[k]]
            parts.append(_detect(block, centres[k], sphere, boxes[k], halves[k], dx, votes, shortest_m))
    return Segments(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _norms(vectors: Array) -> Array:
    """Lengths ``(N,)`` of vectors ``(N, 3)``, rounded as `numpy.linalg.norm` rounds that of one."""
    x, y, z = vectors.T
    return np.asarray(np.sqrt(x * x + y * y + z * z))


@njit(cache=True, nogil=True)
def _detect(points, centre, sphere, box, half, dx, min_votes, length_min):
    """The fields of the `Segments` of a block's ``points (N, 3)``, which lie within ``box (3,)`` of its ``centre``."""
    px, py, pz = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    x, y, z, columns = px - centre[0], py - centre[1], pz - centre[2], int(2 * half / dx + 0.5)
    anchor, direction, _, label = iterate(x, y, z, sphere, box, half, dx, columns, min_votes, len(points), True)
    order = np.argsort(label, kind="mergesort")
    begin = np.searchsorted(label[order], np.arange(len(anchor) + 1))
    piece = cut(px, py, pz, order, begin, anchor + centre, direction, GAP * dx, min_votes)
    return filter_pieces(px, py, pz, order, piece, PCA_RATIO - 0.1, np.inf, 0.7 / dx, length_min)
