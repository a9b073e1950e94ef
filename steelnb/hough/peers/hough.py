"""Bars by the iterative 3D Hough transform, the method that the report chose."""

from steelnb.hough.blocks import segment_structure
from steelnb.hough.lines import detect_lines
from steelnb.hough.peers.bars import POINTS_MIN, bars_of_lines, in_passes, prepared, refine
from steelnb.types import Array, Segments


def segment_by_hough(
    points: Array,
    seed: int = 0,
    dx: float | None = None,
    points_min: int = POINTS_MIN,
    granularity: int = 3,
) -> Segments:
    """Hough lines with at least ``points_min`` votes, in two passes, then refined.

    ``dx`` in metres is `default_dx` by default, ``granularity`` is that of `detect_lines`: the 8° between directions of
    the default are enough, since lines are fitted to their points. ``seed`` is not used.
    """
    points, dx = prepared(points, dx, points_min)
    found = in_passes(
        lambda some: segment_by_hough_once(some, seed, dx, points_min, granularity), points, dx, points_min
    )
    return refine(points, found, dx, points_min)


def segment_by_hough_once(
    points: Array,
    seed: int = 0,
    dx: float | None = None,
    points_min: int = POINTS_MIN,
    granularity: int = 3,
) -> Segments:
    """One pass of `segment_by_hough`, not refined: the same as `steelnb.hough.detect_segments`."""
    points, dx = prepared(points, dx, points_min)
    lines = detect_lines(points, dx, points_min, None, granularity, skip_weak=True)
    return bars_of_lines(points, lines, points_min)


def segment_by_hough_blocks(
    points: Array, seed: int = 0, dx: float | None = None, points_min: int = POINTS_MIN
) -> Segments:
    """Hough lines of small blocks and a choice among them (`steelnb.hough.blocks`), refined: for whole structures.

    ``points`` voxel-filtered with a leaf of about dx/√3. The rest as in `segment_by_hough`.
    """
    points, dx = prepared(points, dx, points_min)
    return refine(points, segment_structure(points, dx), dx, points_min)
