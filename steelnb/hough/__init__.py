"""Points → `Lines` → `Segments`: the iterative 3D Hough transform and the segments along its lines."""

from steelnb.hough.lines import detect_lines
from steelnb.hough.segments import cut_and_sort, detect_segments, detect_segments_with
from steelnb.hough.transform import directions

__all__ = ["cut_and_sort", "detect_lines", "detect_segments", "detect_segments_with", "directions"]
