"""Points → `Segments`, by the methods that the report weighed against each other (its section 1.1).

All take ``(points, settings, seed, dx, …)`` and give `Segments`; ``points (N, 3)`` are finite metres, the settings say
what counts as a bar. All raise what `steelnb.hough.detect_lines` raises.
"""

from collections.abc import Callable

from steelnb.datatypes import Segments
from steelnb.segmentation.dbscan import segment_by_dbscan
from steelnb.segmentation.gmm import segment_by_gmm
from steelnb.segmentation.hough import segment_by_hough, segment_by_hough_blocks, segment_by_hough_once
from steelnb.segmentation.ransac_lines import segment_by_ransac_lines
from steelnb.segmentation.ransac_planes import segment_by_ransac_planes

METHODS: dict[str, Callable[..., Segments]] = {
    "ransac-planes": segment_by_ransac_planes,
    "ransac-lines": segment_by_ransac_lines,
    "dbscan": segment_by_dbscan,
    "gmm": segment_by_gmm,
    "hough": segment_by_hough,
    "hough-once": segment_by_hough_once,
    "hough-blocks": segment_by_hough_blocks,
}
"""The methods by the names that tables and figures use."""

__all__ = [
    "METHODS",
    "segment_by_dbscan",
    "segment_by_gmm",
    "segment_by_hough",
    "segment_by_hough_blocks",
    "segment_by_hough_once",
    "segment_by_ransac_lines",
    "segment_by_ransac_planes",
]
