"""Segments in the world frame → `SegmentMap`; scans with corrected poses → `Structure`."""

from steelnb.fusion.association import associate
from steelnb.fusion.reconstruct import reconstruct
from steelnb.fusion.segment_map import SegmentMap
from steelnb.fusion.smooth import smooth
from steelnb.fusion.structure import Structure

__all__ = ["SegmentMap", "Structure", "associate", "reconstruct", "smooth"]
