"""Errors of a trajectory, unaligned: the drift is zero at t = 0, so estimate and truth share a frame."""

from collections.abc import Sequence

import numpy as np

from steelnb.errors import needs
from steelnb.types import Array, Trajectory


def position_error_m(estimate: Trajectory, truth: Trajectory) -> Array:
    """Distance ``(N,)`` between estimated and true position at the stamps of the estimate."""
    return np.asarray(np.linalg.norm(estimate.position - truth.at(estimate.stamp_s).position, axis=1))


def score_trajectory(estimate: Trajectory, truth: Trajectory, rpe_delta_s: float = 1.0) -> dict[str, float]:
    """``ate_rmse_m``, ``error_mean_m``, ``error_max_m``, ``error_final_m``, ``rpe_rmse_m`` of an estimate, metres.

    Absolute trajectory error and relative pose error (translation, over ``rpe_delta_s``) are evo's, after Sturm et al.,
    "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012. Truth is taken at the stamps of the estimate;
    raises ValueError if it has none there.
    """
    with needs("sim"):
        from evo.core import metrics
        from evo.core.trajectory import PoseTrajectory3D
        from evo.core.units import Unit

    at = truth.at(estimate.stamp_s)
    reference, ours = (PoseTrajectory3D(poses_se3=list(t.T_world_drone), timestamps=t.stamp_s) for t in (at, estimate))
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, ours))
    frames = max(1, round(rpe_delta_s / float(np.median(np.diff(estimate.stamp_s)))))
    result = {
        "ate_rmse_m": ape.get_statistic(metrics.StatisticsType.rmse),
        "error_mean_m": ape.get_statistic(metrics.StatisticsType.mean),
        "error_max_m": ape.get_statistic(metrics.StatisticsType.max),
        "error_final_m": ape.error[-1],
    }
    if len(estimate) > frames:
        rpe = metrics.RPE(metrics.PoseRelation.translation_part, frames, Unit.frames, all_pairs=True)
        rpe.process_data((reference, ours))
        result["rpe_rmse_m"] = rpe.get_statistic(metrics.StatisticsType.rmse)
    return {name: float(value) for name, value in result.items()}


def score_gaps(
    estimate: Trajectory, truth: Trajectory, blind_s: Sequence[tuple[float, float]], grace_s: float = 2.0
) -> dict[str, float]:
    """``ate_outside_gaps_rmse_m``, without the blind intervals and the ``grace_s`` after each, and
    ``error_after_gaps_max_m``, the largest error within a second after that."""
    error = position_error_m(estimate, truth)
    stamp = estimate.stamp_s
    inside, after = np.zeros(len(stamp), dtype=bool), np.zeros(len(stamp), dtype=bool)
    for first, last in blind_s:
        inside |= (stamp >= first) & (stamp < last + grace_s)
        after |= (stamp >= last + grace_s) & (stamp < last + grace_s + 1.0)
    return {
        "ate_outside_gaps_rmse_m": float(np.sqrt((error[~inside] ** 2).mean())),
        "error_after_gaps_max_m": float(error[after].max()) if after.any() else float("nan"),
    }
