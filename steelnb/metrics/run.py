"""All metrics of an estimate: of its trajectory, and of the segments of its map if it has any."""

import math
from collections.abc import Sequence

import numpy as np

from steelnb.core.estimates import Estimate
from steelnb.core.types import Array
from steelnb.metrics.segments import score_segments
from steelnb.metrics.trajectory import score_gaps, score_trajectory
from steelnb.simulation import Truth


def score_estimate(estimate: Estimate, truth: Truth, blind_s: Sequence[tuple[float, float]] = ()) -> dict[str, float]:
    """The metrics of a run, with units in their names. ``blind_s``: begin and end of each gap without scans."""
    corrected, segments = estimate.corrected, estimate.segments
    raw = score_trajectory(estimate.prior, truth.trajectory)
    numbers = {
        "raw_ate_rmse_m": raw["ate_rmse_m"],
        "raw_error_final_m": raw["error_final_m"],
        **score_trajectory(corrected, truth.trajectory),
    }
    if blind_s:
        numbers |= score_gaps(corrected, truth.trajectory, blind_s)
    if len(segments):
        score = score_segments(segments, truth.tower.axes, observed=truth.visibility.observed())
        numbers |= {
            "segments": float(len(segments)),
            "segment_recall": score.recall,
            "segment_precision": score.precision,
            "segment_angle_median_deg": float(np.degrees(_median(score.angle_rad))),
            "segment_offset_median_m": _median(score.offset_m),
        }
    return numbers


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else math.nan
