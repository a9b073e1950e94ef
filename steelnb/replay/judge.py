"""A replayed flight in numbers: what was used, how fast, and, where there is truth, how much drift is left."""

from collections import Counter
from collections.abc import Mapping

import numpy as np

from steelnb.datatypes import Array, Trajectory
from steelnb.metrics import score_trajectory
from steelnb.replay.course import Course
from steelnb.replay.offline import Replayed

Number = float | int | str


def judged(course: Course, replayed: Replayed, skipped: Mapping[str, int]) -> dict[str, Number]:
    """The rows of ``table.csv`` in order; ``skipped`` is what the recording itself left out, by reason.

    Units are in the names, shares are 0–1; ``on_time_share`` is of updates done within the time to the next scan.
    Times differ from run to run, all else is the same on every run.
    """
    total, ms = len(replayed.reason), 1e3 * replayed.seconds
    unused = Counter(reason for reason in replayed.reason if reason)
    rows: dict[str, Number] = {
        "frames": total,
        "used": total - unused.total(),
        **{f"not used: {reason}": count for reason, count in unused.most_common()},
        **{f"skipped: {reason}": count for reason, count in sorted(skipped.items()) if count},
        "duration_s": float(np.ptp(replayed.prior.stamp_s)),
        "frame_median_ms": float(np.median(ms)),
        "frame_p95_ms": float(np.percentile(ms, 95)),
        "frame_max_ms": float(ms.max()),
        "on_time_share": float((replayed.seconds <= replayed.period_s).mean()),
    }
    if course.truth is None:
        return rows
    prior, corrected = (score(trajectory, course.truth) for trajectory in (replayed.prior, replayed.corrected))
    rows |= {"frames_with_truth": len(course.truth)}
    rows |= {f"prior_{name}": value for name, value in prior.items()}
    rows |= {f"corrected_{name}": value for name, value in corrected.items()}
    if prior["ate_rmse_m"] > 0:
        rows["drift_removed_percent"] = 100 * (1 - corrected["ate_rmse_m"] / prior["ate_rmse_m"])
    return rows


def score(estimate: Trajectory, truth: Trajectory) -> dict[str, float]:
    """`score_trajectory` of an estimate at the stamps of the truth."""
    return score_trajectory(estimate.at(truth.stamp_s), truth)


def errors_m(estimate: Trajectory, truth: Trajectory) -> Array:
    """Distance ``(N,)`` to the truth at its stamps."""
    return np.asarray(np.linalg.norm(estimate.at(truth.stamp_s).position - truth.position, axis=1))
