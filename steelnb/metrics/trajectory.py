"""Errors of a trajectory without alignment: estimate and truth start at the same pose, so they share a frame."""

from collections.abc import Sequence

import numpy as np

from steelnb.core.arguments import checks_arguments
from steelnb.core.checks import checked_array
from steelnb.core.errors import InputError
from steelnb.core.geometry import inverse_poses
from steelnb.core.types import Array, Trajectory

GRACE_S = 2.0
"""Time to recover after a gap in the scans."""
RPE_S = 1.0
"""Time over which the relative pose error is measured."""


@checks_arguments
def position_error_m(estimate: Trajectory, truth: Trajectory) -> Array:
    """Distance ``(N,)`` between estimated and true position at the stamps of the estimate."""
    return np.asarray(np.linalg.norm(estimate.position - truth.at(estimate.stamp_s).position, axis=1))


@checks_arguments
def score_trajectory(estimate: Trajectory, truth: Trajectory) -> dict[str, float]:
    """Absolute trajectory error and relative pose error of an estimate, metres, as evo computes them.

    ``ate_rmse_m``, ``error_mean_m``, ``error_max_m``, ``error_final_m`` of the position, and ``rpe_rmse_m`` of the
    translation over `RPE_S`, all pairs; without a pair, it is left out. Raises ValueError if the truth has no pose at a
    stamp of the estimate, and `InputError` for fewer than two poses.

    Source: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012. As in evo, a pair is a
    fixed number of poses apart.
    """
    error = position_error_m(estimate, truth)
    if len(estimate) < 2:
        raise InputError(f"estimate: {len(estimate)} poses; expected at least two to score")
    ate_m = np.sqrt((error**2).mean())
    result = dict(ate_rmse_m=ate_m, error_mean_m=error.mean(), error_max_m=error.max(), error_final_m=error[-1])
    frames = max(1, round(RPE_S / float(np.median(np.diff(estimate.stamp_s)))))
    if len(estimate) > frames:
        P, Q = estimate.T_world_drone, truth.at(estimate.stamp_s).T_world_drone
        estimated_motion, true_motion = (inverse_poses(T[:-frames]) @ T[frames:] for T in (P, Q))
        rpe_m = np.linalg.norm((inverse_poses(true_motion) @ estimated_motion)[:, :3, 3], axis=1)
        result["rpe_rmse_m"] = np.sqrt((rpe_m**2).mean())
    return {name: float(value) for name, value in result.items()}


@checks_arguments
def score_gaps(estimate: Trajectory, truth: Trajectory, blind_s: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Position errors, metres, of a flight without scans in the intervals ``blind_s``.

    ``ate_outside_gaps_rmse_m`` excludes the intervals and `GRACE_S` after each; ``error_after_gaps_max_m``: maximum
    error in the second after that, NaN without an interval.
    """
    error = position_error_m(estimate, truth)
    stamp = estimate.stamp_s
    inside, after = np.zeros(len(stamp), dtype=bool), np.zeros(len(stamp), dtype=bool)
    for first, last in checked_array(blind_s if np.size(blind_s) else np.zeros((0, 2)), "blind_s", ("N", 2)):
        inside |= (stamp >= first) & (stamp < last + GRACE_S)
        after |= (stamp >= last + GRACE_S) & (stamp < last + GRACE_S + 1.0)
    return {
        "ate_outside_gaps_rmse_m": float(np.sqrt((error[~inside] ** 2).mean())),
        "error_after_gaps_max_m": float(error[after].max()) if after.any() else float("nan"),
    }
