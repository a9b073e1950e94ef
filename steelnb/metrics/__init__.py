"""Errors of estimates against the truth."""

from steelnb.metrics.clouds import basin_radius_m, bend, largest_slip, paired_clouds
from steelnb.metrics.scores import WRONG_M, WRONG_SHARE, diagnose, score_estimate
from steelnb.metrics.segments import SeenMembers, SegmentScore, score_segments, seen_members
from steelnb.metrics.trajectory import position_error_m, score_gaps, score_trajectory

__all__ = [
    "WRONG_M", "WRONG_SHARE", "SeenMembers", "SegmentScore", "basin_radius_m", "bend", "diagnose", "largest_slip",
    "paired_clouds", "position_error_m", "score_estimate", "score_gaps", "score_segments", "score_trajectory",
    "seen_members",
]  # fmt: skip
