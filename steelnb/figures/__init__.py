"""Results → matplotlib figures, one function for each figure of the report. Nothing here computes a result."""

from steelnb.figures.accuracy import figure_accuracy
from steelnb.figures.claims import figure_claims, figure_error_bands
from steelnb.figures.clouds import (
    figure_basins,
    figure_bend,
    figure_cloud_comparison,
    figure_cloud_errors,
    figure_cloud_methods,
    figure_error_curves,
    figure_false_convergence,
)
from steelnb.figures.maps import figure_maps
from steelnb.figures.recorded import figure_recorded_errors, figure_recorded_trajectories
from steelnb.figures.report import REPORT_CLOUD_ODOMETRY, REPORT_SEGMENT_ODOMETRY, REPORT_TIME_RATIO
from steelnb.figures.scan import figure_scan
from steelnb.figures.scene import HEIGHT_PX, figure_flight, figure_recorded_scene, figure_scene, plotly_bundle
from steelnb.figures.segmentation import (
    USUAL,
    figure_conditions,
    figure_found,
    figure_over_seeds,
    figure_sequence,
    figure_tuning,
)
from steelnb.figures.segments import figure_segments
from steelnb.figures.structure import (
    figure_near_side,
    figure_recall,
    figure_structure_errors,
    figure_structure_goals,
    figure_structures,
)
from steelnb.figures.style import LABELS
from steelnb.figures.trajectories import figure_segment_odometry
from steelnb.figures.world import figure_drift, figure_tower

__all__ = [
    "HEIGHT_PX", "LABELS", "REPORT_CLOUD_ODOMETRY", "REPORT_SEGMENT_ODOMETRY", "REPORT_TIME_RATIO", "USUAL",
    "figure_accuracy", "figure_basins", "figure_bend", "figure_claims", "figure_cloud_comparison",
    "figure_cloud_errors", "figure_cloud_methods", "figure_conditions", "figure_drift", "figure_error_bands",
    "figure_error_curves", "figure_false_convergence", "figure_flight", "figure_found", "figure_maps",
    "figure_near_side", "figure_over_seeds", "figure_recall", "figure_recorded_errors", "figure_recorded_scene",
    "figure_recorded_trajectories", "figure_scan", "figure_scene", "figure_segment_odometry", "figure_segments",
    "figure_sequence", "figure_structure_errors", "figure_structure_goals", "figure_structures", "figure_tower",
    "figure_tuning", "plotly_bundle",
]  # fmt: skip
