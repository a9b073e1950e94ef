"""All metrics of an estimate: of its trajectory, and of the segments of its map if it has any; and diagnostics."""

import math
from collections.abc import Sequence

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.estimates import Estimate
from steelnb.core.types import Array, Flight
from steelnb.metrics.clouds import bend, largest_slip, paired_clouds
from steelnb.metrics.segments import score_segments
from steelnb.metrics.trajectory import position_error_m, score_gaps, score_trajectory
from steelnb.settings import PreprocessSettings
from steelnb.simulation import Truth

WRONG_M = 0.25
"""A scan with correspondences and a larger error than this counts as falsely registered."""
WRONG_SHARE = 0.05
"""A run with a larger share of falsely registered scans than this has converged wrongly."""


def score_estimate(estimate: Estimate, truth: Truth, blind_s: Sequence[tuple[float, float]] = ()) -> dict[str, float]:
    """The metrics of a run, with units in their names. ``blind_s``: begin and end of each gap without scans."""
    corrected, segments = estimate.corrected, estimate.segments
    raw = score_trajectory(estimate.prior, truth.trajectory)
    numbers = {
        "raw_ate_rmse_m": raw["ate_rmse_m"],
        "raw_error_final_m": raw["error_final_m"],
        **score_trajectory(corrected, truth.trajectory),
    }
    if np.size(blind_s):
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


def diagnose(flight: Flight, estimate: Estimate, truth: Truth, preprocess: PreprocessSettings) -> dict[str, float]:
    """Diagnostics of a run beside its metrics, NaN where they are not defined.

    ``lost_share``: share of the scans after the first that have no correspondences; ``growth_lost_m_s`` and
    ``growth_paired_m_s``: mean growth rate of the error at scans without and with correspondences;
    ``raw_growth_lost_m_s`` and ``raw_growth_paired_m_s``: the same of the uncorrected error; ``wrong_share``: share of
    the scans with correspondences whose error exceeds `WRONG_M`; ``slip_m``: largest growth of the error within a
    second; ``bend_deg``: bend of the assembled cloud; ``turned_mean_deg`` and ``turned_final_deg``: angle between
    estimated and true attitude. Raises `InputError` for fewer than two scans.
    """
    stamp_s, path = estimate.corrected.stamp_s, truth.trajectory
    if len(stamp_s) < 2:
        raise InputError(f"estimate: {len(stamp_s)} poses; expected at least two to diagnose")
    error, paired = position_error_m(estimate.corrected, path), estimate.matches > 0
    lost = ~paired[1:]
    growth, raw_growth = (np.diff(each) / np.diff(stamp_s) for each in (error, position_error_m(estimate.prior, path)))
    true = path.at(stamp_s).T_world_drone[:, :3, :3]
    cosine = 0.5 * (np.einsum("nij,nij->n", true, estimate.corrected.T_world_drone[:, :3, :3]) - 1)
    rotation_error_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    clouds = paired_clouds(flight, estimate, truth, preprocess)
    try:
        bend_deg = bend(*clouds)["bend_deg"]
    except InputError:  # too few points to fit
        bend_deg = math.nan

    def mean(values: np.ndarray, where: np.ndarray, of_none: float = math.nan) -> float:
        return float(values[where].mean()) if where.any() else of_none

    return {
        "lost_share": lost.mean(),
        "growth_lost_m_s": mean(growth, lost),
        "growth_paired_m_s": mean(growth, ~lost),
        "raw_growth_lost_m_s": mean(raw_growth, lost),
        "raw_growth_paired_m_s": mean(raw_growth, ~lost),
        "wrong_share": mean(error > WRONG_M, paired, of_none=0.0),
        "slip_m": largest_slip(error, stamp_s)[1],
        "bend_deg": bend_deg,
        "turned_mean_deg": rotation_error_deg.mean(),
        "turned_final_deg": rotation_error_deg[-1],
    }


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else math.nan
