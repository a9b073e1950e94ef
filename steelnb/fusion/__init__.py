"""Segments in the world frame → `SegmentMap`, and the points where its segments meet."""

from steelnb.fusion.association import associate
from steelnb.fusion.intersections import Intersections, intersections
from steelnb.fusion.segment_map import SegmentMap

__all__ = ["Intersections", "SegmentMap", "associate", "intersections"]
