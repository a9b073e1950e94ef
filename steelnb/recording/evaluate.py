"""A corrected recording and the truth → numbers: scans used, milliseconds, errors, sizes."""

import math
import re
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.core.estimates import Estimate, MountEstimate
from steelnb.core.types import Flight, Segments, Trajectory
from steelnb.fusion.structure import Structure
from steelnb.io.recordings import find_truth
from steelnb.io.trajectories import interpolate
from steelnb.metrics import score_trajectory
from steelnb.settings import RecordingOptions

TIMES = ("frame_median_ms", "frame_p95_ms", "frame_p99_ms", "frame_max_ms", "on_time_share")
"""Measured times, which differ between runs on the same recording."""
APART_M, APART_RAD = 0.5, math.radians(5)
"""Two trajectories that differ by more than this at their first common scan are in different frames."""


class References(NamedTuple):
    """What a corrected flight is compared with: ``truth`` and ``other``, the trajectory of another program of this
    ``name``, at the scans that both cover, None if unknown; ``notes`` for the user."""

    truth: Trajectory | None
    other: Trajectory | None
    name: str
    notes: tuple[str, ...]


def truth_of(flight: Flight, recording: Path | str, options: RecordingOptions) -> Trajectory | None:
    """The truth of a recording, as `find_truth` finds it. Raises `InputError` if the file that the user names has fewer
    than two of the scans."""
    truth = find_truth(Path(recording), options)
    if options.truth is not None and truth is not None and at_scans(flight.prior, truth, options.truth)[0] is None:
        spans = [f"{each.stamp_s[0]:.3f} to {each.stamp_s[-1]:.3f} s" for each in (truth, flight.prior)]
        raise InputError(f"{options.truth}: its poses at {spans[0]} match fewer than two scans, at {spans[1]}")
    return truth


def references(flight: Flight, truth: Trajectory | None, other: tuple[str, Trajectory] | None) -> References:
    """The truth and another program's name and trajectory at the scans of a flight. Raises `InputError`."""
    true, notes = None, ["no truth: errors are not evaluated"]
    if truth is not None:
        true, notes = at_scans(flight.prior, truth, "the truth")
    if other is None:
        return References(true, None, "", tuple(notes))
    name, theirs = other
    if true is None:
        raise InputError(f"{name}: {flight.name} has no truth to score it against; expected one (--truth FILE)")
    path, remarks = at_scans(true, theirs, name)
    if path is None:
        seconds = [f"{each.stamp_s[0]:.3f} to {each.stamp_s[-1]:.3f} s" for each in (theirs, true)]
        raise InputError(f"{name}: its poses at {seconds[0]} match fewer than two scans with a truth, {seconds[1]}")
    return References(true.at(path.stamp_s), path, name, (*notes, *remarks))


def at_scans(scans: Trajectory, path: Trajectory, what: str) -> tuple[Trajectory | None, list[str]]:
    """Poses of a ``path`` at the stamps of ``scans`` that it covers, in the frame of ``scans``, and notes for the user.

    The poses are None if it covers fewer than two. A path in another frame is moved so that the first poses agree.
    """
    T_world_drone, known = interpolate(path, scans.stamp_s)
    covered, notes = np.count_nonzero(known), []
    if covered < len(known):
        notes.append(f"{what} covers {covered} of {len(known)} scans; errors are of those only")
    if covered < 2:
        return None, notes
    found = Trajectory(scans.stamp_s[known], T_world_drone[known])
    T_scans_path = scans.T_world_drone[known][0] @ np.linalg.inv(found.T_world_drone[0])
    apart_m = float(np.linalg.norm(scans.position[known][0] - found.position[0]))
    apart_rad = float(Rotation.from_matrix(T_scans_path[:3, :3]).magnitude())
    if apart_m > APART_M or apart_rad > APART_RAD:
        apart = f"{apart_m:.2f} m and {math.degrees(apart_rad):.1f}° apart at the first scan"
        notes.append(f"{what} is in another frame, {apart}: it was moved onto the first pose")
        found = Trajectory(found.stamp_s, T_scans_path @ found.T_world_drone)
    return found, notes


MOUNT_AXES = ("roll", "pitch", "yaw"), ("x", "y", "z")
MOUNT_UNITS = {
    **{f"{axis}_deg": 180 / math.pi for axis in MOUNT_AXES[0]}, **{f"{axis}_m": 1.0 for axis in MOUNT_AXES[1]},
    "late_s": 1.0,
}  # fmt: skip
"""Parts of the step of a `MountEstimate` as numbers, and their units in those of the step."""


def mount_numbers(mount: MountEstimate) -> dict[str, float]:
    """The step from the stated mount to the estimated one, in the frame of the drone, and the delay of the stamps, each
    with its standard deviation, NaN if this is not determined."""
    unit = np.array(list(MOUNT_UNITS.values()))
    sigma = np.full(len(unit), np.nan) if mount.covariance is None else np.sqrt(np.diag(mount.covariance))
    numbers = {f"mount_{name}": value for name, value in zip(MOUNT_UNITS, (unit * mount.step).tolist(), strict=True)}
    return numbers | {
        f"mount_{name}_sigma": value for name, value in zip(MOUNT_UNITS, (unit * sigma).tolist(), strict=True)
    }


def evaluate(
    flight: Flight, estimate: Estimate, segments: Segments, structure: Structure, known: References
) -> dict[str, float]:
    """Numbers of scans used and, by reason, not used; milliseconds per update; sizes of the map; and errors in metres
    at the stamps of the truth, also of another program's trajectory. If the estimate has covariances,
    ``position_sigma_m`` and ``position_sigma_max_m`` are the median and the largest standard deviation of the position,
    in all three axes together, metres.

    ``on_time_share``: share of updates done before the next scan; ``prior_followed``: scans that leave one or more
    directions undetermined, in which the prior was followed.
    """
    ms, unused = 1e3 * estimate.update_s, Counter(re.split(r": | \(", each)[0] for each in estimate.reason if each)
    times = (*np.percentile(ms, [50, 95, 99]).tolist(), float(ms.max()), estimate.on_time_share)
    numbers: dict[str, float] = {
        "frames": len(flight),
        "used": len(flight) - unused.total(),
        **{f"not used: {reason}": count for reason, count in unused.most_common()},
        "prior_followed": int((estimate.unobserved > 0).sum()),
        **{f"skipped: {reason}": count for reason, count in sorted(flight.skipped.items())},
        "duration_s": float(np.ptp(estimate.prior.stamp_s)),
        **dict(zip(TIMES, times, strict=True)),
    }
    if (truth := known.truth) is not None:
        numbers |= {"frames_with_truth": len(truth)}
        judged = {"prior": estimate.prior, "corrected": estimate.corrected, "estimate": known.other}
        for part, path in judged.items():
            scores = score_trajectory(path.at(truth.stamp_s), truth) if path is not None else {}
            numbers |= {f"{part}_{name}": value for name, value in scores.items()}
        if numbers["prior_ate_rmse_m"] > 0:
            numbers["drift_removed_percent"] = 100 * (1 - numbers["corrected_ate_rmse_m"] / numbers["prior_ate_rmse_m"])
    if (covariance := estimate.pose_covariance) is not None:
        sigma_m = np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2))
        numbers |= {"position_sigma_m": float(np.median(sigma_m)), "position_sigma_max_m": float(sigma_m.max())}
    if estimate.mount_cost is not None:
        units = (math.radians(1), "deg"), (0.01, "cm")
        costs = [
            (f"{axis}_{unit}", size) for (size, unit), axes in zip(units, MOUNT_AXES, strict=True) for axis in axes
        ]
        for (name, size), cost in zip(costs, estimate.mount_cost.tolist(), strict=True):
            numbers[f"mount_cost_{name}_m"] = size * cost
    if estimate.mount is not None:
        numbers |= mount_numbers(estimate.mount)
    sizes = {"map_points": len(estimate.points), "segments": len(segments)}
    return numbers | sizes | {"structure_bars": len(structure), "structure_joints": len(structure.joint)}
