"""Errors of a trajectory without alignment: estimate and truth start at the same pose, so they share a frame."""

from collections.abc import Sequence

import numpy as np

from steelnb.core.checks import SAME_S, checked_array
from steelnb.core.errors import InputError
from steelnb.core.geometry import inverse_poses
from steelnb.core.types import Array, IntArray, Trajectory

GRACE_S = 2.0
"""Time to recover after a gap in the scans."""
RPE_S = 1.0
"""Time over which the relative pose error is measured."""
RPE_MIN, RPE_MAX = 0.5, 1.5
"""Bounds of the time between a pair of poses, as shares of `RPE_S`; the upper one also of the median interval, if that
is longer. Pairs across a gap are left out."""


def position_error_m(estimate: Trajectory, truth: Trajectory) -> Array:
    """Distance ``(N,)`` between estimated and true position at the stamps of the estimate, metres. Raises `InputError`
    if the truth has no pose at one of them."""
    return np.asarray(np.linalg.norm(estimate.position - truth.at(estimate.stamp_s).position, axis=1))


def score_trajectory(estimate: Trajectory, truth: Trajectory) -> dict[str, float]:
    """Absolute trajectory error and relative pose error of an estimate, metres.

    ``ate_rmse_m``, ``error_mean_m``, ``error_max_m``, ``error_final_m`` of the position, and ``rpe_rmse_m`` of the
    translation over `RPE_S`, all pairs (`pairs_in_time`); without a pair, it is left out. Raises `InputError` if the
    truth has no pose at a stamp of the estimate, and for fewer than two poses.

    Source: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012, whose tool
    ``evaluate_rpe.py`` also pairs by time. evo pairs by a number of poses; on regular sampling both are the same.
    """
    error = position_error_m(estimate, truth)
    if len(estimate) < 2:
        raise InputError(f"estimate: {len(estimate)} poses; expected at least two to score")
    ate_m = np.sqrt((error**2).mean())
    result = dict(ate_rmse_m=ate_m, error_mean_m=error.mean(), error_max_m=error.max(), error_final_m=error[-1])
    first, second, scale = pairs_in_time(estimate.stamp_s)
    if len(first):
        P, Q = estimate.T_world_drone, truth.at(estimate.stamp_s).T_world_drone
        estimated_motion, true_motion = (inverse_poses(T[first]) @ T[second] for T in (P, Q))
        rpe_m = scale * np.linalg.norm((inverse_poses(true_motion) @ estimated_motion)[:, :3, 3], axis=1)
        result["rpe_rmse_m"] = np.sqrt((rpe_m**2).mean())
    return {name: float(value) for name, value in result.items()}


def pairs_in_time(stamp_s: Array) -> tuple[IntArray, IntArray, Array]:
    """Pairs of poses at ``stamp_s (N,)`` that are about `RPE_S` apart: first and second pose, and the factor by which
    the error of each pair is extrapolated to `RPE_S`.

    The second pose is the later one nearest to `RPE_S` after the first. The factor is 1 for what the sampling allows,
    half a median interval off, but at most half of `RPE_S`. The bounds of a pair are `RPE_MIN` and `RPE_MAX`.
    """
    interval_s = float(np.median(np.diff(stamp_s)))
    off_s = min(interval_s, RPE_S) / 2 + SAME_S
    first = np.flatnonzero(stamp_s + RPE_S <= stamp_s[-1] + off_s)
    first = first[first < len(stamp_s) - 1]
    due_s = stamp_s[first] + RPE_S
    after = np.clip(np.searchsorted(stamp_s, due_s - SAME_S), first + 1, len(stamp_s) - 1)
    before = np.maximum(after - 1, first + 1)
    second = np.where(due_s - stamp_s[before] <= stamp_s[after] - due_s + SAME_S, before, after)
    apart_s = stamp_s[second] - stamp_s[first]
    kept = (apart_s >= RPE_MIN * RPE_S - SAME_S) & (apart_s <= RPE_MAX * max(RPE_S, interval_s) + SAME_S)
    first, second, apart_s = first[kept], second[kept], apart_s[kept]
    return first, second, np.where(np.abs(apart_s - RPE_S) <= off_s, 1.0, RPE_S / apart_s)


def score_gaps(estimate: Trajectory, truth: Trajectory, blind_s: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Position errors, metres, of a flight without scans in the intervals ``blind_s``.

    ``ate_outside_gaps_rmse_m`` excludes the intervals and `GRACE_S` after each, NaN if nothing is left;
    ``error_after_gaps_max_m``: maximum error in the second after that, NaN without an interval.
    """
    error = position_error_m(estimate, truth)
    stamp = estimate.stamp_s
    inside, after = np.zeros(len(stamp), dtype=bool), np.zeros(len(stamp), dtype=bool)
    for first, last in checked_array(blind_s if np.size(blind_s) else np.zeros((0, 2)), "blind_s", ("N", 2)):
        inside |= (stamp >= first) & (stamp < last + GRACE_S)
        after |= (stamp >= last + GRACE_S) & (stamp < last + GRACE_S + 1.0)
    outside = error[~inside]
    return {
        "ate_outside_gaps_rmse_m": float(np.sqrt((outside**2).mean())) if len(outside) else float("nan"),
        "error_after_gaps_max_m": float(error[after].max()) if after.any() else float("nan"),
    }
