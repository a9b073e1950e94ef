"""Lines → segments: cut at gaps, merge collinear pieces, filter by shape (the report's "segments sorting")."""

import math

import numpy as np

from steelnb.core.arguments import checks_arguments
from steelnb.core.checks import check_length, checked_integer, checked_number, checked_points
from steelnb.core.errors import InputError
from steelnb.core.types import Array, Lines, Segments
from steelnb.hough.freedom import freedom_of
from steelnb.hough.lines import default_dx, detect_lines
from steelnb.hough.segments_kernels import cut, filter_pieces, merge
from steelnb.settings import HoughSettings

HALF_WIDTH = 3.0
"""Half the width of a segment in root mean square distances of its points, for its freedom."""
GAP = 4.0
"""Maximum gap of a segment in dx: default of ``gap_max``; compiled into kernels (njit)."""


@checks_arguments
def detect_segments(
    points: Array,
    dx: float | None = None,
    min_votes: int = 2,
    max_lines: int | None = None,
    granularity: int = 4,
    gap_max: float | None = None,
    pca_ratio_min: float = 0.0,
    radius_max: float = math.inf,
    density_min: float = 0.0,
    length_min: float = 0.0,
    skip_weak: bool = True,
    free_min: float = 0.0,
) -> Segments:
    """Find line segments: Hough lines (`detect_lines`), cut at gaps between their points and filtered by shape.

    Parameters
    ----------
    points, dx, min_votes, max_lines, granularity: as in `detect_lines`.
    gap_max: maximum gap between consecutive points of a segment, metres; default 4 dx.
    pca_ratio_min: minimum share of the variance along the segment, 0–1.
    radius_max: maximum root mean square distance of the points to the axis, metres.
    density_min: minimum number of points per metre.
    length_min: minimum length, metres.
    skip_weak: drop lines with fewer than ``min_votes`` points and go on, unlike the published program.
    free_min: minimum freedom of a segment (`freedom_of`), 0–1; `FREE_MIN` leaves out lines on walls and on the ground.

    Returns `Segments` in the frame of the points. Their ends are the extreme points projected onto the fitted axis.
    Raises `InputError` as `detect_lines`.

    >>> import numpy as np
    >>> two = [np.linspace([0, 0, 0], [0, 0, 2], 80), np.linspace([0, 0, 3], [0, 0, 4], 40)]  # in line, 1 m apart
    >>> detect_segments(np.concatenate(two), dx=0.1, min_votes=20).length.round(3).tolist()
    [2.0, 1.0]
    """
    dx = default_dx(points) if dx is None else dx
    checked_number(free_min, "free_min", 0, 1)
    lines = detect_lines(points, dx, min_votes, max_lines, granularity, skip_weak)
    found = cut_and_sort(
        points, lines, GAP * dx if gap_max is None else gap_max, min_votes, pca_ratio_min, radius_max, density_min,
        length_min,
    )  # fmt: skip
    if not free_min:
        return found
    half_m = np.maximum(HALF_WIDTH * found.radius, 0.5 * dx)
    return found.take(np.flatnonzero(freedom_of(checked_points(points), found, half_m, free_min) >= free_min))


@checks_arguments
def detect_segments_with(points: Array, settings: HoughSettings) -> Segments:
    """`detect_segments` with an experiment's settings."""
    return detect_segments(
        points, settings.dx_m, settings.min_votes, settings.max_lines, settings.granularity, settings.gap_max_m,
        settings.pca_ratio_min, settings.dx_m, settings.density_min_per_m, settings.length_min_m,
        settings.skip_weak,
    )  # fmt: skip


@checks_arguments
def cut_and_sort(
    points: Array,
    lines: Lines,
    gap_max: float,
    min_points: int,
    pca_ratio_min: float,
    radius_max: float,
    density_min: float,
    length_min: float,
    merge_distance: float = 0.0,
) -> Segments:
    """Cut the points ``(N, 3)`` of each line at gaps, and keep the pieces within the bounds of `detect_segments`.

    Pieces with fewer than ``min_points`` points are dropped first. Collinear pieces within ``merge_distance``, metres,
    are merged before the bounds are applied; 0 turns merging off. Raises `InputError`.
    """
    points = checked_points(points)
    check_length(lines.label, "lines.label", len(points), "one a point")
    if lines.label.max(initial=-1) >= len(lines):
        raise InputError(f"lines.label: {lines.label.max()}; expected less than the number of lines, {len(lines)}")
    checked_number(gap_max, "gap_max", above=0, infinite=True)
    checked_integer(min_points, "min_points", 0)
    checked_number(pca_ratio_min, "pca_ratio_min", 0, 1)
    checked_number(radius_max, "radius_max", above=0, infinite=True)
    checked_number(density_min, "density_min", 0)
    checked_number(length_min, "length_min", 0)
    checked_number(merge_distance, "merge_distance", 0)
    order = np.argsort(lines.label, kind="stable")
    begin = np.searchsorted(lines.label[order], np.arange(len(lines) + 1))
    px, py, pz = np.ascontiguousarray(points.T)
    piece = cut(px, py, pz, order, begin, lines.anchor, lines.direction, gap_max, max(min_points, 2))
    if merge_distance > 0:
        order, piece = merge(px, py, pz, order, piece, merge_distance, gap_max)
    return Segments(*filter_pieces(px, py, pz, order, piece, pca_ratio_min, radius_max, density_min, length_min))
