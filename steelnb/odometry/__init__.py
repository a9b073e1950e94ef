"""Scans and a drifting trajectory → the corrected trajectory."""

from steelnb.odometry.segments import SegmentOdometry

__all__ = ["SegmentOdometry"]
