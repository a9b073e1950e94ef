"""Points → `Segments`, by the methods that the report compares (its section 1.1).

All take ``(points, settings, seed, dx, …)``: ``points (N, 3)`` finite in metres, settings that define a bar, the same
for all, and ``dx`` in metres. All raise as `steelnb.hough.detect_lines` does.
"""

from collections.abc import Callable

from steelnb.hough.peers.groups import segment_by_dbscan, segment_by_gmm, segment_by_ransac_planes
from steelnb.hough.peers.hough import segment_by_hough, segment_by_hough_blocks, segment_by_hough_once
from steelnb.hough.peers.ransac_lines import segment_by_ransac_lines
from steelnb.types import Segments

METHODS: dict[str, Callable[..., Segments]] = {
    "ransac-planes": segment_by_ransac_planes,
    "ransac-lines": segment_by_ransac_lines,
    "dbscan": segment_by_dbscan,
    "gmm": segment_by_gmm,
    "hough": segment_by_hough,
    "hough-once": segment_by_hough_once,
    "hough-blocks": segment_by_hough_blocks,
}
"""The methods by their names in tables and figures."""
