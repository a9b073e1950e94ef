"""Run an odometry on a recorded flight and write a folder: corrected poses, bars, structure, table, two pictures."""

import math
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from steelnb import odometry
from steelnb.core.errors import InputError
from steelnb.core.estimates import Estimate, OdometryStep
from steelnb.core.files import new_folder
from steelnb.core.types import Flight, Scan, Segments, Trajectory
from steelnb.fusion.adjustment.uncertainty import axis_sigma_m
from steelnb.fusion.reconstruct import reconstruct
from steelnb.fusion.structure import Structure
from steelnb.io import write_segments, write_structure, write_tum
from steelnb.io.clouds import shift_of
from steelnb.io.trajectories import interpolate
from steelnb.metrics import score_trajectory
from steelnb.plots.flight import figure_bars, figure_flight
from steelnb.plots.style import COLOURS, LABELS
from steelnb.settings import ExperimentSettings, OrbSettings, StructureSettings

WARM_UP_SCANS = 3
"""The second scan is the first to be registered. By the third, everything is loaded."""
TIMES = ("frame_median_ms", "frame_p95_ms", "frame_p99_ms", "frame_max_ms", "on_time_share")
"""Measured times, which differ between runs on the same recording."""
FILES = ("corrected.tum", "segments.csv", "structure.json", "table.csv", "path.png", "map.png")
ERRORS = {"ate_rmse_m": "rms", "error_mean_m": "mean", "error_max_m": "largest", "error_final_m": "last"}
WARNINGS = {
    "used": "no scan corrected a pose: the corrected poses are the recorded ones",
    "map_points": "the map has no points: compare range, floor, voxels and mount above with those of your sensor",
}
"""Warnings about a run that ended without an error but is useless. The key is the number that is zero then."""
APART_M, APART_RAD = 0.5, math.radians(5)
"""Two trajectories that differ by more than this at their first common scan are in different frames."""


@dataclass(frozen=True)
class RecordingReport:
    """The results of `run_recording` and the ``folder`` that it wrote.

    ``truth``: true poses at the scans that have one; ``segments``: bars of the odometry's map or, if that has none, of
    the structure; ``numbers``: the rows of ``table.csv``; ``summary`` and ``warnings``: lines of text.
    """

    folder: Path
    estimate: Estimate
    truth: Trajectory | None
    segments: Segments
    numbers: dict[str, float]
    summary: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def metrics(self) -> dict[str, float]:
        """The finite numbers that are the same in every run. Names have only letters, digits and underscores."""
        same = {name: value for name, value in self.numbers.items() if name not in TIMES and np.isfinite(value)}
        return {re.sub(r"\W+", "_", name): float(value) for name, value in same.items()}

    @property
    def times(self) -> dict[str, float]:
        """Milliseconds per update, and the share of updates on time."""
        return {name: self.numbers[name] for name in TIMES}


def run_recording(
    flight: Flight,
    output: Path | str,
    settings: ExperimentSettings,
    structure: StructureSettings,
    truth: Trajectory | None = None,
    on_progress: Callable[[float], None] = lambda _: None,
    on_stage: Callable[[str], None] = lambda _: None,
    *,
    own: Callable[..., odometry.Odometry] | None = None,
    other: tuple[str, Trajectory] | None = None,
) -> RecordingReport:
    """Correct a recorded flight and write `FILES` to a folder; one scan is in memory at a time.

    Parameters
    ----------
    output : the folder; files of an earlier run in it are replaced.
    settings, structure : of odometry and reconstruction (`recording_settings`).
    truth : true poses, for evaluation only.
    on_progress : called with the share of the scans done, 0 to 1.
    on_stage : called with the name of each stage as it begins.
    own : a user's class that replaces the odometry of the settings (`steelnb.odometry.load_odometry`).
    other : name and trajectory of another program, evaluated at the same scans as ours.

    Nothing is written on an error. Raises `InputError`, `OutputError`.
    """
    if isinstance(settings.odometry, OrbSettings) and flight.images is None:
        raise InputError(f"{flight.name}: no images for method {settings.odometry.method!r}: recordings have none here")
    method = settings.odometry.method if own is None else own.__name__
    label, colour = (LABELS[method], COLOURS[method]) if own is None else (method, COLOURS["final"])
    judged, notes = _judged(flight, truth, other)
    true, theirs = judged.pop("truth", None), judged
    origin = shift_of(flight.prior.position[0])  # voxel numbers and pictures need coordinates near zero
    near = replace(flight, prior=flight.prior.moved(-origin))
    if origin[2]:
        floor_m = settings.odometry.preprocess.floor_m - float(origin[2])
        settings = settings.override({"preprocess.floor_m": floor_m})
        structure = structure.replace(floor_m=structure.floor_m - float(origin[2]))

    def observe(k: int, scan: Scan, step: OdometryStep) -> None:
        on_progress((k + 1) / len(flight))
        if k + 1 == len(flight) and settings.odometry.smooth:
            on_stage("adjusting all poses and bars together")

    with new_folder(output, FILES) as folder:
        on_stage("warming up, which compiles what was not compiled yet")
        odometry.correct(near.first(WARM_UP_SCANS), settings.odometry, own=own)
        on_stage("correcting the poses")
        found = odometry.correct(near, settings.odometry, observe, own)
        on_stage("reconstructing the bars")
        built = _reconstructed(near, found, structure.replace(thickness=found.thickness or structure.thickness))
        bars = found.segments if len(found.segments) else built.segments
        built, segments = built.moved(origin), bars.moved(origin)
        estimate = replace(
            found, prior=flight.prior, corrected=found.corrected.moved(origin), points=found.points + origin,
            segments=found.segments.moved(origin),
        )  # fmt: skip
        numbers = measure_recording(flight, estimate, true, segments, built, *theirs.values())
        on_stage("drawing and writing")
        paths = {"drifting": (estimate.prior, COLOURS["none"]), label: (estimate.corrected, colour)}
        paths |= {name: (path, COLOURS["incremental"]) for name, path in theirs.items()}
        drawn = {name: (path.moved(-origin), colour) for name, (path, colour) in paths.items()}
        title = f"{flight.name}: map of {len(found.points)} points and {len(bars)} bars"
        figures = {"path": figure_flight(drawn, true and true.moved(-origin), found.points, bars, title)}
        if len(found.points) > 1:
            figures["map"] = figure_bars(found.points, bars, title)
        for name, figure in figures.items():
            figure.savefig(folder / f"{name}.png", dpi=150)
        write_tum(folder / "corrected.tum", estimate.corrected)
        write_segments(segments, folder / "segments.csv", _sigma_m(estimate, segments))
        write_structure(built, folder / "structure.json", {"source": flight.name, "odometry": method})
        table = pd.DataFrame({"quantity": list(numbers), "value": [f"{v:.6g}" for v in numbers.values()]})
        table.to_csv(folder / "table.csv", index=False, lineterminator="\n")
        written = ", ".join(sorted(file.name for file in folder.iterdir()))
    notes += [f"not smoothed: {estimate.unsmoothed}"] if estimate.unsmoothed else []
    notes += [f"no uncertainty: {estimate.unsure}"] if estimate.unsure else []
    labels = dict(zip(("prior", "corrected", "estimate"), paths, strict=False))
    lines = [*(f"note      {note}" for note in notes), *_summary(numbers, labels, built)]
    # Method `none` corrects nothing, and a class of the user's need not have a map.
    expected = {"used": method != "none", "map_points": own is None or hasattr(own, "map_points")}
    warnings = tuple(text for name, text in WARNINGS.items() if expected[name] and not numbers[name])
    summary = (*lines, f"written   {output}/: {written}")
    return RecordingReport(Path(output), estimate, true, segments, numbers, summary, warnings)


def _reconstructed(flight: Flight, estimate: Estimate, settings: StructureSettings) -> Structure:
    try:
        return reconstruct(flight.scans, estimate.corrected.T_world_drone, flight.T_drone_sensor, settings)
    except InputError as fault:  # no return above the floor; huge extents
        return Structure.empty(str(fault))


def _sigma_m(estimate: Estimate, segments: Segments) -> np.ndarray | None:
    """Standard deviations ``(M, 2)`` of a smoothed flight's bars, across their axes at both ends."""
    if estimate.axis_covariance is None:
        return None
    half_m = 0.5 * segments.length
    return np.column_stack([axis_sigma_m(estimate.axis_covariance, along_m) for along_m in (-half_m, half_m)])


def _judged(
    flight: Flight, truth: Trajectory | None, other: tuple[str, Trajectory] | None
) -> tuple[dict[str, Trajectory], list[str]]:
    """The truth and another program's trajectory, by name, at the scans that both cover, and notes for the user."""
    true, notes = None, ["no truth: errors are not evaluated"]
    if truth is not None:
        true, notes = at_scans(flight.prior, truth, "the truth")
    if other is None:
        return ({} if true is None else {"truth": true}), notes
    if true is None:
        raise InputError(f"{other[0]}: {flight.name} has no truth to score it against; expected one (--truth FILE)")
    path, remarks = at_scans(true, other[1], other[0])
    if path is None:
        seconds = [f"{each.stamp_s[0]:.3f} to {each.stamp_s[-1]:.3f} s" for each in (other[1], true)]
        raise InputError(f"{other[0]}: its poses at {seconds[0]} match fewer than two scans with a truth, {seconds[1]}")
    return {"truth": true.at(path.stamp_s), other[0]: path}, notes + remarks


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


def measure_recording(
    flight: Flight,
    estimate: Estimate,
    truth: Trajectory | None,
    segments: Segments,
    built: Structure,
    theirs: Trajectory | None = None,
) -> dict[str, float]:
    """Numbers of scans used and, by reason, not used; milliseconds per update; sizes of the map; and errors in metres
    at the stamps of ``truth``, also of ``theirs``.

    ``on_time_share``: share of updates done before the next scan; ``prior_followed``: scans that leave one or more
    directions undetermined, in which the prior was followed.
    """
    ms, unused = 1e3 * estimate.update_s, Counter(each.partition(":")[0] for each in estimate.reason if each)
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
    if truth is not None:
        numbers |= {"frames_with_truth": len(truth)}
        judged = {"prior": estimate.prior, "corrected": estimate.corrected, "estimate": theirs}
        for part, path in judged.items():
            scores = score_trajectory(path.at(truth.stamp_s), truth) if path is not None else {}
            numbers |= {f"{part}_{name}": value for name, value in scores.items()}
        if numbers["prior_ate_rmse_m"] > 0:
            numbers["drift_removed_percent"] = 100 * (1 - numbers["corrected_ate_rmse_m"] / numbers["prior_ate_rmse_m"])
    sizes = {"map_points": len(estimate.points), "segments": len(segments)}
    return numbers | sizes | {"structure_bars": len(built), "structure_joints": len(built.joint)}


def opened_lines(flight: Flight) -> tuple[str, ...]:
    """Lines of text on what was read from a recording: topics, mount, scans, and what was skipped."""
    x, y, z = flight.T_drone_sensor[:3, 3]
    yaw, pitch, roll = Rotation.from_matrix(flight.T_drone_sensor[:3, :3]).as_euler("ZYX", degrees=True)
    topics = ", ".join(f"{part} {flight.facts[part]}" for part in ("scans", "poses", "imu") if part in flight.facts)
    skipped = "; ".join(f"{number} {reason}" for reason, number in sorted(flight.skipped.items()))
    stamp_s = flight.prior.stamp_s
    return (
        f"read      {flight.name}: {topics}",
        f"mount     at x {x:.3f}, y {y:.3f}, z {z:.3f} m, roll {roll:.1f}, pitch {pitch:.1f}, yaw {yaw:.1f}° "
        f"({flight.facts['mount']})",
        f"scans     {len(stamp_s)} with a pose over {np.ptp(stamp_s):.1f} s"
        + (f", {1 / np.median(np.diff(stamp_s)):.4g} a second" if len(stamp_s) > 1 else ""),
        *([f"skipped   {skipped}"] if skipped else []),
    )


def _summary(numbers: dict[str, float], labels: dict[str, str], built: Structure) -> list[str]:
    """Lines of text. ``labels``: prefix of the names of numbers → label of the path."""
    unused = [f"{count} {name.partition(': ')[2]}" for name, count in numbers.items() if name.startswith("not used: ")]
    lines = [f"used      {numbers['used']} scans" + (f"; not used: {', '.join(unused)}" if unused else "")]
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
    lines.append(f"map       {numbers['map_points']} points, {numbers['segments']} bars")
    found = f"{len(built)} bars, {len(built.joint)} joints"
    return [*lines, f"structure {found if len(built) else f'empty: {built.reason}'}"]
