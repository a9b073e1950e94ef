"""What the report's own figures show, read off its plots, to stand beside ours."""

REPORT_SEGMENT_ODOMETRY: dict[str, dict[str, float]] = {
    "vertical": {"raw_final_m": 4.2, "mean_m": 0.2, "max_m": 0.28, "steps": 1050},
    "orbit": {"raw_final_m": 2.1, "mean_m": 0.3, "max_m": 0.42, "steps": 800},
}
"""Figures 3.2b and 3.3b: the drift at the end, and the corrected error's usual and largest value."""
