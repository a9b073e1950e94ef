"""Run an odometry on a recorded flight and write a folder: corrected poses, bars, structure, map, table, two
pictures."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
import pandas as pd

from steelnb import odometry
from steelnb.core.errors import InputError
from steelnb.core.estimates import Estimate, OdometryStep
from steelnb.core.files import new_folder
from steelnb.core.types import Array, Flight, IntArray, Scan, Segments, Trajectory
from steelnb.fusion.adjustment.smooth import axis_sigma_m
from steelnb.fusion.mapped_scans import MappedScans
from steelnb.fusion.reconstruct import reconstruct
from steelnb.fusion.structure import Structure
from steelnb.io import write_segments, write_structure, write_tum
from steelnb.io.clouds import write_map
from steelnb.io.recordings import UNREADABLE
from steelnb.odometry.standstill import rest_duration_s
from steelnb.plots.draw import figure_bars, figure_flight
from steelnb.plots.style import COLOURS, LABELS
from steelnb.points.ranges import calibrated
from steelnb.recording.evaluate import TIMES, evaluate, references
from steelnb.recording.summary import WARNINGS, result_lines
from steelnb.settings import ExperimentSettings, OdometrySettings, OrbSettings, StructureSettings

WARM_UP_SCANS = 3
"""The second scan is the first to be registered. By the third, everything is loaded."""
FILES = ("corrected.tum", "segments.csv", "structure.json", "table.csv", "path.png", "map.png", "map.ply")
OwnOdometry = Callable[..., odometry.Odometry]


@dataclass(frozen=True)
class Corrected:
    """``estimate`` of the odometry; ``structure`` rebuilt with its poses; ``segments``: bars of its map or, if that has
    none, of the structure. ``points (N, 3)``: means of the voxels of all scans at the corrected poses, world frame,
    metres; ``bar (N,)``: the number of the segment that each belongs to, −1 for none."""

    estimate: Estimate
    structure: Structure
    segments: Segments
    points: Array
    bar: IntArray

    def moved(self, by: Array, prior: Trajectory) -> "Corrected":
        """All of it translated by ``by (3,)``, metres, where the recorded poses are ``prior``."""
        estimate = self.estimate.moved(by, prior)
        return Corrected(estimate, self.structure.moved(by), self.segments.moved(by), self.points + by, self.bar)


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
    own: OwnOdometry | None = None,
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
    flight = calibrated(flight, settings.tof)
    known = references(flight, truth, other)
    origin = flight.origin  # voxel numbers and pictures need coordinates near zero
    with new_folder(output, FILES) as folder:
        near = correct_recording(flight.moved(-origin), settings.odometry, structure, own, on_progress, on_stage)
        found = near.moved(origin, flight.prior)
        numbers = evaluate(flight, found.estimate, found.segments, found.structure, known)
        on_stage("drawing and writing")
        paths: dict[str, tuple[Trajectory, str]] = {}
        for name, path, look in (
            ("drifting", flight.prior, COLOURS["none"]), (label, found.estimate.corrected, colour),
            (known.name, known.other, COLOURS["incremental"]),
        ):  # fmt: skip
            if path is not None:  # a user's class or file may have the name of another path
                paths[f"{name} ({len(paths) + 1})" if name in paths else name] = path, look
        drawn = {name: (path.moved(-origin), colour) for name, (path, colour) in paths.items()}
        draw(folder, flight.name, near, drawn, known.truth and known.truth.moved(-origin))
        write(folder, found, numbers, {"source": flight.name, "odometry": method})
        written = ", ".join(sorted(file.name for file in folder.iterdir()))
    notes = [*known.notes, *rest_notes(flight, settings.odometry)]
    faults = [reason for reason in found.estimate.reason if reason.startswith(UNREADABLE)]
    notes += [f"the first {faults[0]}"] if faults else []
    notes += [f"not smoothed: {found.estimate.unsmoothed}"] if found.estimate.unsmoothed else []
    notes += [f"no uncertainty: {found.estimate.unsure}"] if found.estimate.unsure else []
    labels = dict(zip(("prior", "corrected", "estimate"), paths, strict=False))
    summary = (
        *(f"note      {note}" for note in notes),
        *result_lines(numbers, labels, found.structure),
        f"written   {output}/: {written}",
    )
    # Method `none` corrects nothing, and a class of the user's need not have a map.
    expected = {"used": method != "none", "map_points": own is None or hasattr(own, "map_points")}
    warnings = tuple(text for name, text in WARNINGS.items() if expected[name] and not numbers[name])
    return RecordingReport(Path(output), found.estimate, known.truth, found.segments, numbers, summary, warnings)


def correct_recording(
    flight: Flight,
    settings: OdometrySettings,
    structure: StructureSettings,
    own: OwnOdometry | None,
    on_progress: Callable[[float], None],
    on_stage: Callable[[str], None],
) -> Corrected:
    """Run the odometry on a flight near the origin, and reconstruct the bars with its poses."""

    passes = 2 if own is None and settings.corrects_twice else 1
    done = count(1)

    def observe(k: int, scan: Scan, step: OdometryStep) -> None:
        share = next(done) / (passes * len(flight))
        on_progress(share)
        if share == 1 and settings.smooth:
            on_stage("adjusting all poses and bars together")

    on_stage("warming up, which compiles what was not compiled yet")
    odometry.correct(flight.first(WARM_UP_SCANS), settings, own=own)
    on_stage("correcting the poses")
    found = odometry.correct(flight, settings, observe, own)
    on_stage("reconstructing the bars")
    structure = structure.replace(thickness=found.thickness or structure.thickness)
    poses = found.sensor_poses(flight.T_drone_sensor)
    points, bar = np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    try:
        built = reconstruct(flight.scans, poses, settings=structure)
        mapped = MappedScans.mapped(flight.scans, poses, structure)
    except InputError as fault:  # no return above the floor; huge extents
        built, mapped = Structure.empty(str(fault)), None
    segments = found.segments if len(found.segments) else built.segments
    if mapped is not None:
        points = mapped.voxels.means()
        bar = mapped.around(segments).bar_of(points)
    return Corrected(found, built, segments, points, bar)


def rest_notes(flight: Flight, settings: OdometrySettings) -> list[str]:
    """What the readings of an IMU say of a rest before the flight; nothing without an IMU."""
    noise = getattr(settings, "inertial", None)
    if noise is None or flight.imu is None:
        return []
    seconds = rest_duration_s(flight.imu, noise, flight.prior)
    if not seconds:
        return ["the IMU does not rest at the beginning: its biases and the vertical are found in flight"]
    return [f"the IMU rests for the first {seconds:.1f} s: its biases and the vertical are estimated there"]


def draw(
    folder: Path, name: str, near: Corrected, paths: Mapping[str, tuple[Trajectory, str]], truth: Trajectory | None
) -> None:
    """Draw the pictures of `FILES`, near the origin. ``paths``: label → trajectory and colour."""
    cloud, bars = near.estimate.points, near.segments
    title = f"{name}: map of {len(cloud)} points and {len(bars)} bars"
    figure_flight(paths, truth, cloud, bars, title).savefig(folder / "path.png", dpi=150)
    if len(cloud) > 1:
        figure_bars(cloud, bars, title).savefig(folder / "map.png", dpi=150)


def write(folder: Path, found: Corrected, numbers: Mapping[str, float], origin: dict[str, str]) -> None:
    """Write the poses, tables and map of `FILES`. ``origin``: names of the recording and of the method."""
    write_tum(folder / "corrected.tum", found.estimate.corrected)
    covariance, half_m, sigma_m = found.estimate.axis_covariance, 0.5 * found.segments.length, None
    if covariance is not None:  # of a smoothed flight's bars, across their axes at both ends
        sigma_m = np.column_stack([axis_sigma_m(covariance, along_m) for along_m in (-half_m, half_m)])
    write_segments(found.segments, folder / "segments.csv", sigma_m)
    write_structure(found.structure, folder / "structure.json", origin)
    if len(found.points):
        write_map(folder / "map.ply", found.points, found.bar)
    table = pd.DataFrame({"quantity": list(numbers), "value": [f"{v:.6g}" for v in numbers.values()]})
    table.to_csv(folder / "table.csv", index=False, lineterminator="\n")
