"""A recorded flight through an odometry → a folder with corrected poses, bars, structure, a table and two figures."""

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
from steelnb.errors import InputError
from steelnb.files import new_folder
from steelnb.fusion.reconstruct import reconstruct
from steelnb.fusion.structure import Structure
from steelnb.fusion.uncertainty import axis_sigma_m
from steelnb.io import write_segments, write_structure, write_tum
from steelnb.io.clouds import shift_of
from steelnb.io.trajectories import interpolate
from steelnb.metrics import score_trajectory
from steelnb.plots import Figure
from steelnb.report.recording_figures import figure_path
from steelnb.report.three_views import figure_segments, orientation
from steelnb.report.words import counted
from steelnb.settings import ExperimentSettings, OrbSettings, StructureSettings
from steelnb.types import Estimate, Flight, OdometryStep, Scan, Segments, Trajectory

WARM_UP_SCANS = 3
"""The second scan is the first that is registered, the third finds everything loaded."""
TIMES = ("frame_median_ms", "frame_p95_ms", "frame_p99_ms", "frame_max_ms", "on_time_share")
"""Numbers of a run that differ from run to run."""
FILES = ("corrected.tum", "segments.csv", "structure.json", "table.csv", "path.png", "map.png")
APART_M, APART_RAD = 0.5, math.radians(5)
"""Poses and truth that differ by more than this at the first scan are in different frames."""


@dataclass(frozen=True)
class RecordingReport:
    """The results of `run_recording` and the ``folder`` that it wrote.

    ``truth`` are the true poses at the scans that have one; ``segments`` the bars, of the odometry's map or, where that
    is a cloud, of the structure; ``numbers`` the rows of ``table.csv``; ``figures`` by name; ``summary`` lines of text.
    """

    folder: Path
    estimate: Estimate
    truth: Trajectory | None
    structure: Structure
    segments: Segments
    numbers: dict[str, float]
    figures: dict[str, Figure]
    summary: tuple[str, ...]

    @property
    def metrics(self) -> dict[str, float]:
        """The finite numbers that are the same on every run, by names of letters, digits and underscores."""
        same = {name: value for name, value in self.numbers.items() if name not in TIMES and np.isfinite(value)}
        return {re.sub(r"\W+", "_", name): float(value) for name, value in same.items()}

    @property
    def times(self) -> dict[str, float]:
        """Milliseconds an update, and the share of updates on time."""
        return {name: self.numbers[name] for name in TIMES}


def run_recording(
    flight: Flight,
    output: Path | str,
    settings: ExperimentSettings,
    structure: StructureSettings,
    truth: Trajectory | None = None,
    on_progress: Callable[[float], None] = lambda _: None,
    on_stage: Callable[[str], None] = lambda _: None,
) -> RecordingReport:
    """Correct a recorded flight and write `FILES` to a folder; one scan is in memory at a time.

    Parameters
    ----------
    output : the folder; files of an earlier run in it are replaced.
    settings, structure : of odometry and reconstruction (`recording_settings`).
    truth : true poses, for judging alone.
    on_progress : called with the share of the scans done, 0 to 1.
    on_stage : called with the name of each stage as it begins.

    Nothing is written on an error. Raises `InputError`, `OutputError`.
    """
    if isinstance(settings.odometry, OrbSettings) and flight.images is None:
        raise InputError(f"{flight.name}: no images for method {settings.odometry.method!r}: recordings have none here")
    true, notes = truth_at_scans(flight, truth)
    origin = shift_of(flight.prior.position[0])  # map coordinates: maps are numbered, and drawn, near zero
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
        odometry.correct(near.first(WARM_UP_SCANS), settings.odometry)
        on_stage("correcting the poses")
        found = odometry.correct(near, settings.odometry, observe)
        on_stage("reconstructing the bars")
        built = _reconstructed(near, found, structure).moved(origin)
        estimate = replace(
            found, prior=flight.prior, corrected=found.corrected.moved(origin), points=found.points + origin,
            segments=found.segments.moved(origin),
        )  # fmt: skip
        segments = estimate.segments if len(estimate.segments) else built.segments
        numbers = measure_recording(flight, estimate, true, segments, built)
        on_stage("drawing and writing")
        title = f"{flight.name}: {len(estimate.points)} points of the map, {len(segments)} bars"
        figures = {"path": figure_path(estimate.prior, estimate.corrected, true, settings.odometry.method, flight.name)}
        if len(found.points) > 1:
            figures["map"] = figure_segments(found.points, segments.moved(-origin), orientation(segments), title)
        write_tum(folder / "corrected.tum", estimate.corrected)
        write_segments(segments, folder / "segments.csv", _sigma_m(estimate, segments))
        write_structure(built, folder / "structure.json", {"source": flight.name, "odometry": settings.odometry.method})
        table = pd.DataFrame({"quantity": list(numbers), "value": [f"{v:.6g}" for v in numbers.values()]})
        table.to_csv(folder / "table.csv", index=False, lineterminator="\n")
        for name, figure in figures.items():
            figure.savefig(folder / f"{name}.png", dpi=150)
        written = ", ".join(sorted(file.name for file in folder.iterdir()))
    notes += [f"not smoothed: {estimate.unsmoothed}"] if estimate.unsmoothed else []
    notes += [f"no uncertainty: {estimate.unsure}"] if estimate.unsure else []
    summary = (*_summary(numbers, notes, built), f"written   {output}/: {written}")
    return RecordingReport(Path(output), estimate, true, built, segments, numbers, figures, summary)


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


def truth_at_scans(flight: Flight, truth: Trajectory | None) -> tuple[Trajectory | None, list[str]]:
    """True poses at those scans that have one, in the frame of the prior; and remarks for the user.

    None where fewer than two scans have one. A truth in another frame is moved so that the first poses agree.
    """
    if truth is None:
        return None, ["no truth: nothing is said of errors"]
    T_world_drone, known = interpolate(truth, flight.prior.stamp_s)
    notes = []
    if not known.all():
        notes.append(f"the truth covers {np.count_nonzero(known)} of {len(known)} scans; errors are those there")
    if np.count_nonzero(known) < 2:
        return None, notes
    true = Trajectory(flight.prior.stamp_s[known], T_world_drone[known])
    T_prior_truth = flight.prior.T_world_drone[known][0] @ np.linalg.inv(true.T_world_drone[0])
    apart_m = float(np.linalg.norm(flight.prior.position[known][0] - true.position[0]))
    apart_rad = float(Rotation.from_matrix(T_prior_truth[:3, :3]).magnitude())
    if apart_m > APART_M or apart_rad > APART_RAD:
        notes.append(
            f"poses and truth are in different frames, {apart_m:.2f} m and {math.degrees(apart_rad):.1f}° apart at the "
            "first scan: the truth was moved onto the first pose"
        )
        true = Trajectory(true.stamp_s, T_prior_truth @ true.T_world_drone)
    return true, notes


def measure_recording(
    flight: Flight, estimate: Estimate, truth: Trajectory | None, segments: Segments, built: Structure
) -> dict[str, float]:
    """Scans used and not used by reason, milliseconds an update, sizes of the map, and, at the poses of ``truth``,
    errors in metres.

    ``on_time_share``: share of updates done before the next scan; ``prior_followed``: scans that were used, but say
    nothing of one direction or more.
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
        prior, corrected = (score_trajectory(t.at(truth.stamp_s), truth) for t in (estimate.prior, estimate.corrected))
        numbers |= {"frames_with_truth": len(truth)}
        numbers |= {f"prior_{name}": value for name, value in prior.items()}
        numbers |= {f"corrected_{name}": value for name, value in corrected.items()}
        if prior["ate_rmse_m"] > 0:
            numbers["drift_removed_percent"] = 100 * (1 - corrected["ate_rmse_m"] / prior["ate_rmse_m"])
    sizes = {"map_points": len(estimate.points), "segments": len(segments)}
    return numbers | sizes | {"structure_bars": len(built), "structure_joints": len(built.joint)}


def opened_lines(flight: Flight) -> tuple[str, ...]:
    """What was read of a recording, in lines of text: topics, mount, scans, and what was left out."""
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


def _summary(numbers: dict[str, float], notes: list[str], built: Structure) -> list[str]:
    unused = [f"{count} {name.partition(': ')[2]}" for name, count in numbers.items() if name.startswith("not used: ")]
    median, p95, p99, largest, on_time = (float(numbers[name]) for name in TIMES)
    lines = [f"note      {note}" for note in notes]
    lines.append(
        f"used      {counted(numbers['used'], 'scan')}" + (f"; not used: {', '.join(unused)}" if unused else "")
    )
    if numbers["prior_followed"]:
        followed = counted(numbers["prior_followed"], "scan")
        lines.append(f"weak      {followed} of a wall or of flat ground: along it the prior was followed")
    lines.append(
        f"time      {median:.1f} ms a scan (median; 95 %: {p95:.1f}, 99 %: {p99:.1f}, most {largest:.1f}), "
        f"{100 * on_time:.1f} % on time"
    )
    if "prior_ate_rmse_m" in numbers:
        prior_m, corrected_m = numbers["prior_ate_rmse_m"], numbers["corrected_ate_rmse_m"]
        removed = f", {numbers['drift_removed_percent']:.0f} % of the drift removed" if prior_m > 0 else ""
        lines.append(f"error     {prior_m:.3f} m drifting, {corrected_m:.3f} m corrected (root mean square){removed}")
    found = f"{counted(len(built), 'bar')}, {counted(len(built.joint), 'joint')}"
    lines.append(f"map       {counted(numbers['map_points'], 'point')}, {counted(numbers['segments'], 'bar')}")
    return [*lines, f"structure {found if len(built) else f'empty: {built.reason}'}"]
