"""Errors of estimates against the truth."""

from steelnb.metrics.clouds import basin_radius_m, bend, largest_slip
from steelnb.metrics.run import score_estimate
from steelnb.metrics.segments import SeenMembers, SegmentScore, score_segments, seen_members
from steelnb.metrics.trajectory import position_error_m, score_gaps, score_trajectory

__all__ = [
    "SeenMembers", "SegmentScore", "basin_radius_m", "bend", "largest_slip", "position_error_m",
    "score_estimate", "score_gaps", "score_segments", "score_trajectory", "seen_members",
]  # fmt: skip
