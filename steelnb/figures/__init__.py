"""Results → matplotlib figures, one function for each figure of the report. Nothing here computes a result."""

from steelnb.figures.maps import figure_maps
from steelnb.figures.report import REPORT_SEGMENT_ODOMETRY
from steelnb.figures.trajectories import figure_segment_odometry
from steelnb.figures.world import figure_drift, figure_tower

__all__ = ["REPORT_SEGMENT_ODOMETRY", "figure_drift", "figure_maps", "figure_segment_odometry", "figure_tower"]
