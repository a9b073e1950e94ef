"""A recorded flight through an odometry → a folder with trajectories, map, bars, structure, figures and tables."""

import contextlib
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from steelnb import odometry
from steelnb.errors import DegenerateCloudError, EmptyCloudError, OutputError, RecordingError, SettingsError
from steelnb.files import PREFIX, new_folder
from steelnb.fusion.reconstruct import reconstruct
from steelnb.fusion.structure import Structure
from steelnb.io import read_flight, read_truth
from steelnb.io.clouds import shift_of
from steelnb.io.rrd import Log
from steelnb.io.segments import orientation
from steelnb.metrics import position_error_m
from steelnb.odometry import Odometry
from steelnb.report.recording_figures import figure_distances, figure_recorded_trajectories
from steelnb.report.recording_files import TIMES, measure_recording, summary_lines, with_sigma, write_recording
from steelnb.report.recording_settings import Scene, recording_settings, settings_line
from steelnb.report.recording_truth import part_of, truth_at_scans, with_drift
from steelnb.report.style import Figure
from steelnb.report.three_views import figure_segments
from steelnb.settings import ExperimentSettings, NoiseSettings, StructureSettings
from steelnb.types import Array, Estimate, Flight, OdometryStep, Scan, Segments, Trajectory

WARM_UP_SCANS = 3
"""The second scan is the first that is registered, the third finds everything loaded."""
FILES = (
    "corrected.tum", "corrected_sigma.csv", "errors.png", "frames.csv", "map.ply",
    "map.png", "prior.tum", "recording.rrd", "segments.csv", "segments.json", "segments.obj", "segments.ply",
    "structure.json", "table.csv", "trajectories.png", "comparison.csv", "comparison.png",
)  # fmt: skip
"""All that a run may write, of one odometry or of several: those of an earlier one do not stay beside new ones."""


@dataclass(frozen=True)
class RecordingReport:
    """The results of `run_recording` and the ``folder`` that it wrote.

    ``truth`` are the true poses at the scans that have one; ``segments`` the bars, of the odometry's map or, where that
    is a cloud, of the structure; ``numbers`` the rows of ``table.csv``;
    ``figures`` by name; ``summary`` lines of text.
    """

    folder: Path
    flight: Flight
    estimate: Estimate
    truth: Trajectory | None
    structure: Structure | None
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


def default_folder(flight: Flight) -> Path:
    """The folder of a run for which none is named: ``NAME_run`` here."""
    return Path(f"{Path(flight.name).stem}_run")


def check_folder(target: Path, overwrite: bool) -> None:
    """Raise `OutputError` for a folder that holds a file, unless it may be overwritten."""
    if not overwrite and target.is_dir() and any(not file.name.startswith(PREFIX) for file in target.iterdir()):
        raise OutputError(f"{target}: exists already and is not empty; expected a new folder, or --force to overwrite")


def run_recording(
    recording: Flight | Path | str,
    output: Path | str | None = None,
    settings: ExperimentSettings | None = None,
    *,
    truth: Trajectory | None = None,
    added_noise: str | None = None,
    structure: StructureSettings | None = None,
    rrd: bool = True,
    gap_max_s: float | None = None,
    part_s: tuple[float, float] | None = None,
    overwrite: bool = True,
    on_progress: Callable[[float], None] | None = None,
    on_stage: Callable[[str], None] = lambda _: None,
) -> RecordingReport:
    """Correct a recorded flight and write the results to a folder; one scan is in memory at a time.

    Parameters
    ----------
    recording : a flight, or a path that `read_flight` and `read_truth` open.
    output : the folder, by default ``NAME_run`` here.
    settings : of odometry and seed; by default `recording_settings` of this flight.
    truth : true poses, for judging alone.
    added_noise : drift to add to the truth, or without one to the poses, taken as true, such as "random-walk:0.002".
    structure : settings of the final reconstruction; None leaves it out.
    rrd : write ``recording.rrd`` for rerun.
    gap_max_s : true poses further apart are not interpolated between; None as in `read_flight`.
    part_s : the part to run, (from, to) in seconds since the first scan; see `part_of`.
    overwrite : replace the files of an earlier run in the folder; without it, a folder that holds any file is refused.
    on_progress : called with the share of the scans done, 0 to 1.
    on_stage : called with the name of each stage as it begins.

    Files: ``corrected.tum`` and ``prior.tum`` at the scans, ``corrected_sigma.csv`` of a smoothed flight,
    ``map.ply``, ``segments.csv`` (.json, .obj, .ply), ``structure.json`` (empty with the reason where none is found),
    ``table.csv``, ``frames.csv``, figures, and ``recording.rrd``. Nothing is
    written on an error. Raises `OutputError`, `RecordingError`, `SettingsError`, and what
    reading raises.
    """
    if not isinstance(recording, Flight):
        truth = truth or read_truth(recording)
        recording = read_flight(recording, gap_max_s=gap_max_s)
    target = Path(output) if output else default_folder(recording)
    check_folder(target, overwrite)
    flight, notes = recording, tuple[str, ...]()
    if part_s is not None:
        flight, truth, notes = part_of(flight, truth, part_s, gap_max_s)
    settings = settings or recording_settings(scene=Scene.of(flight))[0]
    if added_noise is not None:
        if truth is None:
            notes = (*notes, "the recorded poses are taken as true: errors are those of the drift added to them")
        flight, truth = with_drift(flight, truth, NoiseSettings.parse(added_noise), settings.seed, gap_max_s)
    elif flight.facts.get("poses", "").startswith("true poses"):
        notes = (*notes, "the recorded poses are true ones: nothing drifts; --noise random-walk:0.002 adds drift")
    true, remarks = truth_at_scans(flight, truth, gap_max_s)
    origin = shift_of(flight.prior.position[0])  # map coordinates: maps are numbered, and drawn, near zero
    flight = replace(flight, prior=flight.prior.moved(-origin))
    true = true.moved(-origin) if true is not None else None
    floor_m = settings.odometry.preprocess.floor_m - float(origin[2])
    near = settings.override({"preprocess.floor_m": floor_m}) if origin[2] else settings
    if structure is not None and origin[2]:
        structure = structure.replace(floor_m=structure.floor_m - float(origin[2]))
    with new_folder(target, FILES, overwrite) as folder, contextlib.ExitStack() as stack:
        on_stage("warming up, which compiles what was not compiled yet")
        odometry.run(flight.first(WARM_UP_SCANS), _estimator(flight, near))
        estimator = _estimator(flight, near)
        log = stack.enter_context(Log(folder / "recording.rrd", flight)) if rrd else None

        def observe(k: int, scan: Scan, step: OdometryStep) -> None:
            if log is not None:
                log.step(scan, step)
                if log.map_due(scan.stamp_s):
                    log.map(scan.stamp_s, estimator.map_points(), estimator.map_segments())
            if on_progress is not None:
                on_progress((k + 1) / len(flight))
            if k + 1 == len(flight) and near.odometry.smooth:
                on_stage("adjusting all poses and bars together")

        on_stage("correcting the poses")
        estimate = odometry.run(flight, estimator, observe)
        on_stage("reconstructing the bars")
        built = _reconstructed(flight, estimate, structure) if structure else None
        built = with_sigma(built, estimate) if built is not None else None
        segments = built.segments if built is not None and not len(estimate.segments) else estimate.segments
        if log is not None:
            log.map(float(flight.prior.stamp_s[-1]), estimate.points, segments)
            log.finish(estimate, true)
        flight, estimate, true = _placed(flight, estimate, true, origin)
        segments = segments.moved(origin)
        built = built.moved(origin) if built is not None else None
        numbers = measure_recording(flight, estimate, true)
        numbers |= {"map_points": len(estimate.points), "segments": len(segments)}
        if built is not None:
            numbers |= {"structure_bars": len(built), "structure_joints": len(built.joint)}
        on_stage("drawing and writing")
        method = settings.odometry.method
        figures = _figures(flight, estimate, true, segments, method)
        about = {"source": flight.name, "odometry": method, "noise": added_noise}
        write_recording(folder, flight, estimate, true, segments, built, about, origin)
        table = pd.DataFrame({"quantity": list(numbers), "value": [f"{v:.6g}" for v in numbers.values()]})
        table.to_csv(folder / "table.csv", index=False, lineterminator="\n")
        for name, figure in figures.items():
            figure.savefig(folder / f"{name}.png", dpi=150)
        stack.close()  # the .rrd file is whole before the folder is renamed
        files = sorted(file.name for file in folder.iterdir())
    if estimate.unsure:
        notes = (*notes, f"no uncertainty: {estimate.unsure}")
    if estimate.unsmoothed:
        notes = (*notes, f"not smoothed: {estimate.unsmoothed}")
    summary = summary_lines(flight, numbers, (*notes, *remarks), built)
    summary = (summary[0], settings_line(settings), *summary[1:], f"written   {target}/: {', '.join(files)}")
    return RecordingReport(target, flight, estimate, true, built, segments, numbers, figures, summary)


def _placed(
    flight: Flight, estimate: Estimate, truth: Trajectory | None, origin: Array
) -> tuple[Flight, Estimate, Trajectory | None]:
    """The same in the world of the recording; exactly the same where it was not shifted."""
    if not origin.any():
        return flight, estimate, truth
    prior = estimate.prior.moved(origin)
    placed = replace(
        estimate, prior=prior, corrected=estimate.corrected.moved(origin), points=estimate.points + origin,
        segments=estimate.segments.moved(origin),
    )  # fmt: skip
    return replace(flight, prior=prior), placed, truth.moved(origin) if truth is not None else None


def _figures(
    flight: Flight, estimate: Estimate, truth: Trajectory | None, segments: Segments, method: str
) -> dict[str, Figure]:
    """The path, the map with its bars, and where there is truth the errors over time."""
    prior, corrected, name = estimate.prior, estimate.corrected, flight.name
    figures = {"trajectories": figure_recorded_trajectories(prior, corrected, truth, method, name)}
    if truth is not None:
        paths = {"drifting": prior, method: corrected}
        curves = {key: (truth.stamp_s, position_error_m(t.at(truth.stamp_s), truth)) for key, t in paths.items()}
        figures["errors"] = figure_distances(curves, "distance to the truth (m)", name)
    if len(estimate.points) > 1:
        title = f"{name}: {len(estimate.points)} points of the map, {len(segments)} bars"
        figures["map"] = figure_segments(estimate.points, segments, orientation(segments), title)
    return figures


def _estimator(flight: Flight, settings: ExperimentSettings) -> Odometry:
    if settings.odometry.orb and flight.images is None:
        told, method = flight.facts.get("images", "none"), settings.odometry.method
        raise RecordingError(f"{flight.name}: no images for method {method!r}: {told}")
    return odometry.make_odometry(settings.odometry, flight.T_drone_sensor, flight.imu, flight.images)


def _reconstructed(flight: Flight, estimate: Estimate, settings: StructureSettings) -> Structure:
    try:
        return reconstruct(flight.scans, estimate.corrected.T_world_drone, flight.T_drone_sensor, settings)
    except (EmptyCloudError, DegenerateCloudError, SettingsError) as fault:  # no return above the floor; huge extents
        return Structure.empty(str(fault))
