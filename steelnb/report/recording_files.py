"""Numbers of a corrected recording, the files that hold them, and its results in lines of text."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from steelnb.fusion.structure import Structure
from steelnb.fusion.uncertainty import axis_sigma_m, joint_covariances
from steelnb.io.clouds import write_ply
from steelnb.io.segments import orientation, write_segments
from steelnb.io.structures import write_structure
from steelnb.io.trajectories import write_sigma, write_tum
from steelnb.metrics import position_error_m, score_trajectory
from steelnb.metrics.matching import match_members
from steelnb.report.words import counted
from steelnb.types import Array, Estimate, Flight, Segments, Trajectory

TIMES = ("frame_median_ms", "frame_p95_ms", "frame_p99_ms", "frame_max_ms", "on_time_share")
"""Numbers of a run that differ from run to run."""


def write_recording(
    folder: Path, flight: Flight, estimate: Estimate, truth: Trajectory | None, segments: Segments,
    built: Structure | None, about: dict[str, str | None], origin: Array,
) -> None:  # fmt: skip
    """Write poses, map, bars, structure and the table of the frames of a run to an existing folder."""
    write_tum(folder / "prior.tum", estimate.prior)
    write_tum(folder / "corrected.tum", estimate.corrected)
    write_ply(folder / "map.ply", estimate.points, "<f8")  # world coordinates may be those of a country
    sigma_m = None
    if estimate.pose_covariance is not None:
        write_sigma(folder / "corrected_sigma.csv", estimate.corrected.stamp_s, estimate.pose_covariance)
    if estimate.axis_covariance is not None:
        half_m = 0.5 * segments.length
        sigma_m = np.column_stack([axis_sigma_m(estimate.axis_covariance, along_m) for along_m in (-half_m, half_m)])
    write_segments(folder, segments.moved(-origin), origin, orientation(segments), about, sigma_m)
    if built is not None:
        write_structure(built, folder / "structure.json", about=about)
    frames = pd.DataFrame({"stamp_s": estimate.prior.stamp_s, "matches": estimate.matches, "not_used": estimate.reason})
    if len(estimate.unobserved):
        frames["unobserved"] = estimate.unobserved
    frames["ms"] = 1e3 * estimate.update_s
    for name, path in (("prior", estimate.prior), ("corrected", estimate.corrected)):
        error_m = np.full(len(frames), np.nan)
        if truth is not None:
            judged = np.searchsorted(flight.prior.stamp_s, truth.stamp_s - 1e-6)  # the scans that the truth covers
            error_m[judged] = position_error_m(path.at(truth.stamp_s), truth)
        frames[f"{name}_error_m"] = error_m
    digits = {"stamp_s": 6, "ms": 2, "prior_error_m": 4, "corrected_error_m": 4}
    frames.round(digits).to_csv(folder / "frames.csv", index=False, lineterminator="\n", errors="backslashreplace")


def with_sigma(structure: Structure, estimate: Estimate) -> Structure:
    """The structure with the standard deviations of the smoothed axes that its bars lie on, in the bars' middles, and
    of the joints of these bars.

    A bar on none keeps that of its own fit, to which the median of the poses' is added.
    """
    axes, covariance, own = estimate.segments, estimate.axis_covariance, structure.segments
    if covariance is None or estimate.pose_covariance is None or not len(structure):
        return structure
    on = match_members(own, np.stack([axes.start, axes.end], axis=1)).member
    pose_m2 = np.median(np.trace(estimate.pose_covariance[:, :3, :3], axis1=1, axis2=2)) / 3.0
    fitted_m2 = structure.sigma_m**2 + pose_m2
    tilt = np.column_stack([np.ones((len(own), 2)), np.tile(2.0 / own.length[:, None] ** 2, 2)])
    each = np.where((on >= 0)[:, None, None], covariance[on], fitted_m2[:, None, None] * tilt[:, None] * np.eye(4))
    start, end = (np.where((on >= 0)[:, None], a[on], b) for a, b in ((axes.start, own.start), (axes.end, own.end)))
    lines = Segments(start, end, own.count, own.radius)
    sigma_m = axis_sigma_m(each, ((own.middle - lines.middle) * lines.direction).sum(axis=1))
    joint = joint_covariances(lines, each, structure.joint, structure.tie)
    held = np.isfinite(joint).all(axis=(1, 2))
    joint_sigma_m = np.full(len(joint), np.nan)
    joint_sigma_m[held] = np.sqrt(np.linalg.eigvalsh(joint[held])[:, -1])
    return replace(structure, sigma_m=sigma_m, joint_sigma_m=joint_sigma_m)


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
