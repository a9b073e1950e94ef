"""Numbers of a corrected recording, and its results in lines of text."""

from collections import Counter

import numpy as np

from steelnb.fusion.structure import Structure
from steelnb.metrics import score_trajectory
from steelnb.report.words import counted
from steelnb.types import Estimate, Flight, Trajectory

TIMES = ("frame_median_ms", "frame_p95_ms", "frame_p99_ms", "frame_max_ms", "on_time_share")
"""Numbers of a run that differ from run to run."""


def measure_recording(flight: Flight, estimate: Estimate, truth: Trajectory | None) -> dict[str, float]:
    """Scans used and not used by reason, milliseconds an update, and, at the poses of ``truth``, errors in metres.

    ``on_time_share``: share of updates done before the next scan; ``prior_followed``: scans that were used, but say
    nothing of one direction or more.
    """
    total, ms = len(estimate.reason), 1e3 * estimate.update_s
    unused = Counter(reason.partition(":")[0] for reason in estimate.reason if reason)
    p50, p95, p99 = (float(np.percentile(ms, q)) for q in (50, 95, 99))
    numbers: dict[str, float] = {
        "frames": total,
        "used": total - unused.total(),
        **{f"not used: {reason}": count for reason, count in unused.most_common()},
        "prior_followed": int((estimate.unobserved > 0).sum()),
        **{f"skipped: {reason}": count for reason, count in sorted(flight.skipped.items())},
        "duration_s": float(np.ptp(estimate.prior.stamp_s)),
        **dict(zip(TIMES, (p50, p95, p99, float(ms.max()), estimate.on_time_share), strict=True)),
    }
    if truth is None:
        return numbers
    prior, corrected = (score_trajectory(t.at(truth.stamp_s), truth) for t in (estimate.prior, estimate.corrected))
    numbers |= {"frames_with_truth": len(truth)}
    numbers |= {f"prior_{name}": value for name, value in prior.items()}
    numbers |= {f"corrected_{name}": value for name, value in corrected.items()}
    if prior["ate_rmse_m"] > 0:
        numbers["drift_removed_percent"] = 100 * (1 - corrected["ate_rmse_m"] / prior["ate_rmse_m"])
    return numbers


def summary_lines(
    flight: Flight, numbers: dict[str, float], notes: tuple[str, ...], built: Structure | None
) -> tuple[str, ...]:
    """The results of a run in lines of text; ``notes`` are told after what was read."""
    unused = [f"{count} {name.partition(': ')[2]}" for name, count in numbers.items() if name.startswith("not used: ")]
    skipped = [f"{count} {reason}" for reason, count in sorted(flight.skipped.items())]
    followed = counted(numbers["prior_followed"], "scan") if numbers["prior_followed"] else ""
    median, p95, p99, largest, on_time = (float(numbers[name]) for name in TIMES)
    lines = [
        f"read      {flight.name}: {counted(numbers['frames'], 'scan')} with a pose over {numbers['duration_s']:.1f} s",
        *([f"skipped   {'; '.join(skipped)}"] if skipped else []),
        *(f"note      {note}" for note in notes),
        f"used      {counted(numbers['used'], 'scan')}" + (f"; not used: {', '.join(unused)}" if unused else ""),
        *([f"weak      {followed} of a wall or of flat ground: along it the prior was followed"] if followed else []),
        f"time      {median:.1f} ms a scan (median; 95 %: {p95:.1f}, 99 %: {p99:.1f}, most {largest:.1f}), "
        f"{100 * on_time:.1f} % on time",
    ]
    if "prior_ate_rmse_m" in numbers:
        prior_m, corrected_m = numbers["prior_ate_rmse_m"], numbers["corrected_ate_rmse_m"]
        removed = f", {numbers['drift_removed_percent']:.0f} % of the drift removed" if prior_m > 0 else ""
        lines.append(f"error     {prior_m:.3f} m drifting, {corrected_m:.3f} m corrected (root mean square){removed}")
    points, bars = counted(numbers["map_points"], "point"), counted(numbers["segments"], "bar")
    lines.append(f"map       {points}, {bars} in segments.csv")
    if built is not None:
        found = f"{counted(len(built), 'bar')}, {counted(len(built.joint), 'joint')}"
        lines.append(f"structure {found if len(built) else f'empty: {built.reason}'}")
    return tuple(lines)
