"""Estimates and truth → numbers. Nothing here plots."""

from steelnb.metrics.clouds import Bend, basin_radius_m, bend, largest_slip
from steelnb.metrics.members import SeenMembers, SegmentScore, score_segments, seen_members
from steelnb.metrics.trajectory import position_error_m, score_gaps, score_trajectory
from steelnb.metrics.uncertainty import axis_errors, coverage, nees, pose_errors

__all__ = [
    "Bend", "SeenMembers", "SegmentScore", "axis_errors", "basin_radius_m", "bend", "coverage", "largest_slip", "nees",
    "pose_errors", "position_error_m", "score_gaps", "score_segments", "score_trajectory", "seen_members",
]  # fmt: skip
