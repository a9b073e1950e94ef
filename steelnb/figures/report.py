"""What the report's own figures show, read off its plots, to stand beside ours."""

REPORT_SEGMENT_ODOMETRY: dict[str, dict[str, float]] = {
    "vertical": {"raw_final_m": 4.2, "mean_m": 0.2, "max_m": 0.28, "steps": 1050},
    "orbit": {"raw_final_m": 2.1, "mean_m": 0.3, "max_m": 0.42, "steps": 800},
}
"""Figures 3.2b and 3.3b: the drift at the end, and the corrected error's usual and largest value."""

REPORT_CLOUD_ODOMETRY: dict[str, dict[str, dict[str, tuple[float, float]]]] = {
    "random-walk": {
        "none": {"orbit": (0.7, 0.8), "vertical": (0.7, 0.8)},
        "icp": {"orbit": (0.1, 0.3), "vertical": (0.0, 1.0)},
        "icp-3dof": {"orbit": (0.0, 0.85), "vertical": (0.02, 0.35)},
        "gicp": {"orbit": (0.25, 0.54), "vertical": (0.10, 0.25)},
    },
    "constant-drift": {
        "none": {"orbit": (2.5, 4.6), "vertical": (2.5, 4.6)},
        "icp": {"orbit": (0.1, 0.85), "vertical": (0.0, 1.5)},
        "icp-3dof": {"orbit": (0.3, 0.4), "vertical": (0.1, 0.5)},
        "gicp": {"orbit": (0.25, 0.4), "vertical": (0.0, 0.1)},
    },
}
"""Figures 3.5 and 3.6: noise → method → flight → range (m) of the corrected error; for ``none``, the drift's end."""
REPORT_TIME_RATIO = 3.0
"""Section 3.3.3: GICP is "nearly three times more time-consuming"."""
