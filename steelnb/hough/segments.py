"""Lines → segments: cut at gaps, merge copies, keep what looks like a bar (the report's "segments sorting")."""

import math

import numpy as np

from steelnb.config import HoughSettings
from steelnb.datatypes import Array, Lines, Segments
from steelnb.errors import SettingsError
from steelnb.hough.lines import detect_lines
from steelnb.hough.pieces import cut, merge, sort
from steelnb.hough.width import suggest_dx

GAP, MERGE = 4.0, 1.5
"""Default gap and merging distance in dx. A line takes the points within dx away, so that the axis of a second copy of
the same bar lies between 1 and about 1.5 dx from the first."""


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
    merge_distance: float | None = 0.0,
) -> Segments:
    """Find line segments: Hough lines (`detect_lines`), cut where their points leave a gap, sorted by their PCA.

    Parameters
    ----------
    points, min_votes, max_lines, granularity, skip_weak: as in `detect_lines`.
    dx: as in `detect_lines`, but by default chosen from the cloud by `suggest_dx`.
    gap_max: a line is cut where two neighbours along it are further apart than this (metres; default 4 dx).
    pca_ratio_min: least share of the variance that lies along the segment, 0–1.
    radius_max: largest root mean square distance of the points to the axis, metres.
    density_min: fewest points for each metre.
    length_min: shortest segment, metres.
    merge_distance: parallel segments whose axes are nearer than this, metres, become one before they are sorted; 0 for
        no merging, None for 1.5 dx.

    Returns `Segments`, whose ends are the extreme points projected on the fitted axis. Raises as `detect_lines`.
    """
    if merge_distance is not None and not merge_distance >= 0:
        raise SettingsError(f"merge_distance = {merge_distance}: expected a length of at least 0 m")
    dx = suggest_dx(points) if dx is None else dx
    lines = detect_lines(points, dx, min_votes, max_lines, granularity, skip_weak)
    return cut_and_sort(
        np.asarray(points, dtype=np.float64), lines, GAP * dx if gap_max is None else gap_max, min_votes, pca_ratio_min,
        radius_max, density_min, length_min, MERGE * dx if merge_distance is None else merge_distance,
    )  # fmt: skip


def detect_segments_with(points: Array, settings: HoughSettings) -> Segments:
    """`detect_segments` with an experiment's settings."""
    return detect_segments(
        points, settings.dx_m, settings.min_votes, settings.max_lines, settings.granularity, settings.gap_max_m,
        settings.pca_ratio_min, settings.radius_max_m, settings.density_min_per_m, settings.length_min_m,
        settings.skip_weak,
    )  # fmt: skip


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
    """Cut the points of each line at gaps, merge copies, and keep what passes; see `detect_segments` for the bounds.

    Pieces of fewer than ``min_points`` points are dropped at once.
    """
    order = np.argsort(lines.label, kind="stable")
    begin = np.searchsorted(lines.label[order], np.arange(len(lines) + 1))
    px, py, pz = np.ascontiguousarray(points.T)
    piece = cut(px, py, pz, order, begin, lines.anchor, lines.direction, gap_max, max(min_points, 2))
    if merge_distance > 0:
        order, piece = merge(px, py, pz, order, piece, merge_distance, gap_max)
    return Segments(*sort(px, py, pz, order, piece, pca_ratio_min, radius_max, density_min, length_min))
