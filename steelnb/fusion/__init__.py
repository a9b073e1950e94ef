"""Segments in the world frame → `SegmentMap`; scans with corrected poses → `Structure`.

Unless said otherwise, constants were chosen on flights of the development seeds 11 and 12.
"""

from steelnb.fusion.adjustment.smooth import smooth
from steelnb.fusion.reconstruct import reconstruct
from steelnb.fusion.segment_map import SegmentMap, associate
from steelnb.fusion.structure import Structure

__all__ = ["SegmentMap", "Structure", "associate", "reconstruct", "smooth"]
