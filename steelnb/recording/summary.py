"""What `steelnb run` tells the user: lines on what was read, on what came out, and warnings."""

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from steelnb.core.types import Flight
from steelnb.fusion.structure import Structure
from steelnb.recording.evaluate import MOUNT_AXES
from steelnb.recording.settings import Scene

ERRORS = {"ate_rmse_m": "rms", "error_mean_m": "mean", "error_max_m": "largest", "error_final_m": "last"}
WEAK_MM = 10.0
"""A part of the mount that moves poses by more than this is said to be open."""
WARNINGS = {
    "used": "no scan corrected a pose: the corrected poses are the recorded ones",
    "map_points": "the map has no points: compare range, floor, voxels and mount above with those of your sensor",
}
"""Warnings about a run that ended without an error but is useless. The key is the number that is zero then."""


def opened_lines(flight: Flight, scene: Scene) -> tuple[str, ...]:
    """A line each on scans, poses, frames, clock, mount and cloud: what was taken, from where, and numbers from which a
    person sees that it is wrong; and one on what was skipped."""
    x, y, z = flight.T_drone_sensor[:3, 3]
    yaw, pitch, roll = Rotation.from_matrix(flight.T_drone_sensor[:3, :3]).as_euler("ZYX", degrees=True)
    place = f"x {x:.3f}, y {y:.3f}, z {z:.3f} m, roll {roll:.1f}, pitch {pitch:.1f}, yaw {yaw:.1f}°"
    stamp_s = flight.prior.stamp_s
    rate = f", {1 / np.median(np.diff(stamp_s)):.4g} a second" if len(stamp_s) > 1 else ""
    skipped = "; ".join(f"{number} {reason}" for reason, number in sorted(flight.skipped.items()))
    said = {
        **{name: flight.facts[name] for name in ("scans", "poses", "frames", "clock") if name in flight.facts},
        "mount": f"{place} ({flight.facts.get('mount', 'identity')})",
        **({"imu": flight.facts["imu"]} if "imu" in flight.facts else {}),
        "cloud": f"ranges of the first scans: {scene.median_m:.3g} m in the median, 99 % below {scene.range_m:.3g} m; "
        f"{len(scene.points)} points in the first",
        "used": f"{len(stamp_s)} scans with a pose over {np.ptp(stamp_s):.1f} s{rate}",
        **({"skipped": skipped} if skipped else {}),
    }
    return (f"read      {flight.name}", *(f"{name:9} {text}" for name, text in said.items()))


def result_lines(numbers: dict[str, float], labels: dict[str, str], structure: Structure) -> list[str]:
    """Lines of text. ``labels``: prefix of the names of numbers → label of the path."""
    unused = [f"{count} {name.partition(': ')[2]}" for name, count in numbers.items() if name.startswith("not used: ")]
    lines = [f"corrected {numbers['used']} scans" + (f"; not used: {', '.join(unused)}" if unused else "")]
    if numbers["prior_followed"]:
        where = "of a wall or of flat ground: along it the prior was followed"
        lines.append(f"weak      {numbers['prior_followed']} scans {where}")
    lines.append(
        "time      {frame_median_ms:.1f} ms a scan (median; 95 %: {frame_p95_ms:.1f}, 99 %: {frame_p99_ms:.1f}, "
        "most {frame_max_ms:.1f}), ".format_map(numbers)
        + f"{100 * numbers['on_time_share']:.1f} % on time"
    )
    if "prior_ate_rmse_m" in numbers:
        errors = {label: [numbers[f"{part}_{name}"] for name in ERRORS] for part, label in labels.items()}
        table = pd.DataFrame(errors, index=list(ERRORS.values())).T.to_string(float_format="{:.3f}".format)
        lines += [f"{'error (m)' if k == 0 else '':9} {line}" for k, line in enumerate(table.splitlines())]
    if "position_sigma_m" in numbers:
        sigma = "sigma     of positions {position_sigma_m:.3f} m (median), {position_sigma_max_m:.3f} m at most"
        lines.append(sigma.format_map(numbers) + ", by the estimate's own covariances")
    lines += mount_lines(numbers)
    lines.append(f"map       {numbers['map_points']} points, {numbers['segments']} bars")
    found = f"{len(structure)} bars, {len(structure.joint)} joints"
    return [*lines, f"structure {found if len(structure) else f'empty: {structure.reason}'}"]


def mount_lines(numbers: dict[str, float]) -> list[str]:
    """What a mount that is off costs a smoothed flight; if it was estimated, also what it is and what is open."""
    if "mount_cost_yaw_deg_m" not in numbers:
        return []
    degrees, centimetres = (
        ", ".join(f"{1e3 * numbers[f'mount_cost_{axis}_{unit}_m']:.0f}" for axis in axes)
        for axes, unit in zip(MOUNT_AXES, ("deg", "cm"), strict=True)
    )
    turns, shifts = map(", ".join, MOUNT_AXES)
    cost = f"1° of {turns} moves poses by {degrees} mm, 1 cm of {shifts} by {centimetres} mm"
    if "mount_yaw_deg" not in numbers:
        return [f"mount     {cost} (--mount-sigma estimates it)"]
    open_mm = {
        axis: scale * numbers[f"mount_{axis}_{unit}_sigma"] * numbers[f"mount_cost_{axis}_{per}_m"]
        for axes, unit, per, scale in zip(MOUNT_AXES, ("deg", "m"), ("deg", "cm"), (1e3, 1e5), strict=True)
        for axis in axes
    }
    worst = [axis for axis, mm in open_mm.items() if mm > WEAK_MM]
    lines = [_mount_line(numbers), f"          {cost}"]
    if worst:
        said = ", ".join(f"{axis}, {open_mm[axis]:.0f} mm" for axis in worst)
        lines.append(f"          left open: {said}: measure it, or fly around the structure, at many headings")
    return lines


def _mount_line(numbers: dict[str, float]) -> str:
    """The estimated mount and delay of the stamps, with their standard deviations."""
    parts = (
        ("turned by", ("roll_deg", "pitch_deg", "yaw_deg"), 1.0, 2, "°"),
        ("moved by", ("x_m", "y_m", "z_m"), 1e3, 0, " mm"),
    )
    said = []
    for what, names, unit, digits, suffix in parts:
        value, sigma = (
            ", ".join(f"{unit * numbers[f'mount_{name}{end}']:.{digits}f}" for name in names) for end in ("", "_sigma")
        )
        said.append(f"{what} ({value}){suffix} ± ({sigma}){suffix}")
    late = "stamps {mount_late_s:.4f} ± {mount_late_s_sigma:.4f} s late".format_map(numbers)
    return f"mount     {', '.join(said)}, {late}"
