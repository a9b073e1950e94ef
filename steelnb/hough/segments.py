"""Lines → segments: cut at gaps, then keep what looks like a bar (the report's "segments sorting")."""

import math

import numpy as np
from numba import njit

from steelnb.config import HoughSettings
from steelnb.datatypes import Array, Lines, Segments
from steelnb.hough.kernels import fit_line
from steelnb.hough.lines import detect_lines


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
) -> Segments:
    """Find line segments: Hough lines (`detect_lines`), cut where their points leave a gap, sorted by their PCA.

    Parameters
    ----------
    points, dx, min_votes, max_lines, granularity, skip_weak: as in `detect_lines`.
    gap_max: a line is cut where two neighbours along it are further apart than this (metres; default 4 dx).
    pca_ratio_min: least share of the variance that lies along the segment, 0–1.
    radius_max: largest root mean square distance of the points to the axis, metres.
    density_min: fewest points for each metre.
    length_min: shortest segment, metres.

    Returns `Segments`, whose ends are the extreme points projected on the fitted axis. Raises as `detect_lines`.
    """
    lines = detect_lines(points, dx, min_votes, max_lines, granularity, skip_weak)
    if dx is None:
        dx = float(np.linalg.norm(np.ptp(points, axis=0))) / 64
    return cut_and_sort(
        np.asarray(points, dtype=np.float64), lines, 4 * dx if gap_max is None else gap_max, min_votes, pca_ratio_min,
        radius_max, density_min, length_min,
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
) -> Segments:
    """Cut the points of each line at gaps and keep the pieces that pass; see `detect_segments` for the bounds."""
    order = np.argsort(lines.label, kind="stable")
    begin = np.searchsorted(lines.label[order], np.arange(len(lines) + 1))
    most = len(points) // max(min_points, 1)
    start, end = np.zeros((most, 3)), np.zeros((most, 3))
    count, radius = np.zeros(most, np.int64), np.zeros(most)
    px, py, pz = np.ascontiguousarray(points.T)
    kept = _cut(
        px, py, pz, order, begin, lines.anchor, lines.direction, gap_max, min_points, pca_ratio_min, radius_max,
        density_min, length_min, start, end, count, radius,
    )  # fmt: skip
    return Segments(start[:kept], end[:kept], count[:kept], radius[:kept])


@njit(cache=True)
def _cut(
    px, py, pz, order, begin, anchor, direction, gap_max, min_points, pca_ratio_min, radius_max, density_min,
    length_min, start, end, count, radius,
):  # fmt: skip
    kept = 0
    for line in range(len(anchor)):
        members = order[begin[line] : begin[line + 1]]
        along_line = np.empty(len(members))
        for k in range(len(members)):
            i = members[k]
            along_line[k] = (
                (px[i] - anchor[line, 0]) * direction[line, 0]
                + (py[i] - anchor[line, 1]) * direction[line, 1]
                + (pz[i] - anchor[line, 2]) * direction[line, 2]
            )
        sorting = np.argsort(along_line, kind="mergesort")
        first = 0
        for k in range(1, len(members) + 1):
            if k < len(members) and along_line[sorting[k]] - along_line[sorting[k - 1]] <= gap_max:
                continue
            n = k - first
            if n >= max(min_points, 2):
                piece = members[sorting[first:k]]
                along, across, mx, my, mz, ux, uy, uz = fit_line(px, py, pz, piece, n)
                low, high = np.inf, -np.inf
                for i in piece:
                    t = (px[i] - mx) * ux + (py[i] - my) * uy + (pz[i] - mz) * uz
                    low, high = min(low, t), max(high, t)
                length = high - low
                spread = math.sqrt(across / n)
                if (
                    along >= pca_ratio_min * (along + across)
                    and spread <= radius_max
                    and n >= density_min * length
                    and length > 0.0
                    and length >= length_min
                ):
                    start[kept, 0], start[kept, 1], start[kept, 2] = mx + low * ux, my + low * uy, mz + low * uz
                    end[kept, 0], end[kept, 1], end[kept, 2] = mx + high * ux, my + high * uy, mz + high * uz
                    count[kept] = n
                    radius[kept] = spread
                    kept += 1
            first = k
    return kept
