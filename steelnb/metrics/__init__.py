"""Estimates and truth → numbers. Nothing here plots."""

from steelnb.metrics.segments import SegmentScore, score_segments
from steelnb.metrics.trajectory import position_error_m, score_trajectory

__all__ = ["SegmentScore", "position_error_m", "score_segments", "score_trajectory"]
