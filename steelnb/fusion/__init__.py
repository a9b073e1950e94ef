"""Segments in the world frame → `SegmentMap`, and the points where its segments meet."""

from steelnb.fusion.association import associate
from steelnb.fusion.intersections import Intersections, intersections
from steelnb.fusion.segment_map import SegmentMap
from steelnb.fusion.structure import Structure

__all__ = ["Intersections", "SegmentMap", "Structure", "associate", "intersections"]
