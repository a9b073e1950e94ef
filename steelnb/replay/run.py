"""`steelnb run`: a recording through an odometry → a folder with all that comes of it."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from steelnb.config import StructureSettings
from steelnb.datatypes import Array, Trajectory
from steelnb.errors import DegenerateCloudError, EmptyCloudError, OutputError, SettingsError
from steelnb.exports import export_structure, orientation
from steelnb.fusion.reconstruct import reconstruct
from steelnb.fusion.structure import Structure
from steelnb.odometry import Odometry
from steelnb.recordings import new_folder, write_segments
from steelnb.recordings.recording import Picture, Recording
from steelnb.recordings.trajectories import write_tum
from steelnb.replay.course import Course, course_of
from steelnb.replay.judge import Number, judged
from steelnb.replay.offline import Frame, Observer, Replayed, replay, uncounted, warm_up
from steelnb.replay.options import Options
from steelnb.replay.outputs import draw_figures, summarised, true_poses, write_frames, write_map, write_table
from steelnb.replay.spool import Spool
from steelnb.viewer import Log


@dataclass(frozen=True)
class RunReport:
    """What `run_recording` wrote to ``folder``: the numbers of ``table.csv``, and all of it as lines of text."""

    folder: Path
    replayed: Replayed
    course: Course
    structure: Structure | None
    numbers: dict[str, Number]
    summary: tuple[str, ...]


def run_recording(
    recording: Recording,
    output: Path | str | None = None,
    options: Options | None = None,
    *,
    structure: bool = True,
    viewer: bool = True,
    on_frame: Observer | None = None,
) -> RunReport:
    """Correct a recorded flight and write all there is to say of it to a folder, default ``<stem>_run`` here.

    ``corrected.tum`` and ``prior.tum`` at the scans; ``map.ply``; ``segments.csv`` (and .json, .obj, .ply): the bars of
    the odometry's map, or where that is a cloud those of the structure; ``structure.json``, empty with the reason where
    no structure is found; ``table.csv``; ``frames.csv``; figures; and ``recording.rrd`` for `steelnb view`.

    One scan is in memory at a time; for the structure the scans wait on disk, beside the output. Raises `OutputError`,
    `RecordingError`, `SettingsError` and what reading the recording raises; nothing is written then.
    """
    options = options or Options()
    settings, structure_settings = options.settings(), options.structure()
    course = course_of(recording, options.drift, options.seed, options.gap_max_s)
    flight = course.flight
    target = Path(output) if output else Path(f"{recording.path.resolve().stem}_run")
    with new_folder(target) as folder, _called(folder, target), contextlib.ExitStack() as stack:
        with uncounted(recording.skipped):
            warm_up(flight, settings)
        observers: list[Observer] = [on_frame] if on_frame else []
        spool = None
        if structure:
            spool = stack.enter_context(Spool(folder.parent / "scans", len(flight.prior)))
            observers.append(spool.observe)
        log = None
        if viewer:
            log = stack.enter_context(Log(folder / "recording.rrd", recording.path.name, flight.T_drone_sensor))
            observers.append(_watching(log, recording, course))
        replayed = replay(flight, settings, observers)
        built = None
        if spool is not None:
            built = _rebuilt(spool, replayed.corrected, flight.T_drone_sensor, structure_settings)
        bars = replayed.segments
        if not len(bars) and built is not None:
            bars = built.segments
        if log is not None:
            log.map(replayed.prior.stamp_s[-1], replayed.points, bars)
        numbers = judged(course, replayed, recording.skipped)
        numbers |= {"map_points": len(replayed.points), "segments": len(bars)}
        if built is not None:
            numbers |= {"structure_bars": len(built), "structure_joints": len(built.joint)}
        about = {"source": recording.path.name, "odometry": options.method, "noise": options.noise}
        write_tum(folder / "prior.tum", replayed.prior)
        write_tum(folder / "corrected.tum", replayed.corrected)
        write_map(folder / "map.ply", replayed.points)
        write_segments(folder, bars, np.zeros(3), orientation(bars), about)
        if built is not None:
            export_structure(built, folder / "structure.json", about=about)
        write_table(folder / "table.csv", numbers)
        write_frames(folder / "frames.csv", course, replayed)
        draw_figures(folder, recording, course, replayed, bars, options)
        stack.close()  # the viewer's file is whole, and the scans are gone, before the folder is renamed
        files = sorted(file.name for file in folder.iterdir())
    return RunReport(
        target, replayed, course, built, numbers, summarised(recording, course, numbers, built, target, files)
    )


@contextlib.contextmanager
def _called(folder: Path, target: Path) -> Iterator[None]:
    """Where a file cannot be written, the error names it as the user will see it."""
    try:
        yield
    except OutputError as fault:
        raise OutputError(str(fault).replace(str(folder), str(target))) from None


def _watching(log: Log, recording: Recording, course: Course) -> Observer:
    """An observer that writes every frame to a file for the viewer."""
    flight, true = course.flight, true_poses(course)
    pictures = _Latest(recording)

    def observe(frame: Frame, odometry: Odometry) -> None:
        stamp_s, k = frame.scan.stamp_s, frame.index
        whole = log.map_due(stamp_s)
        log.frame(
            stamp_s,
            frame.scan.points,
            frame.step,
            flight.prior.T_world_drone[k],
            T_world_drone_true=true.get(k),
            map_points=odometry.map_points() if whole else None,
            segments=odometry.map_segments() if whole else None,
            picture=pictures.until(stamp_s),
        )

    return observe


class _Latest:
    """The newest picture up to a stamp, each once."""

    def __init__(self, recording: Recording) -> None:
        self._walk = iter(()) if recording.pictures is None else recording.pictures.walk()
        self._next: Picture | None = next(self._walk, None)

    def until(self, stamp_s: float) -> Picture | None:
        found = None
        while self._next is not None and self._next.stamp_s <= stamp_s:
            found, self._next = self._next, next(self._walk, None)
        return found


def _rebuilt(spool: Spool, corrected: Trajectory, T_drone_sensor: Array, settings: StructureSettings) -> Structure:
    try:
        return reconstruct(spool, corrected.T_world_drone[spool.number], T_drone_sensor, settings)
    except (
        EmptyCloudError,
        DegenerateCloudError,
        SettingsError,
    ) as fault:  # no return above the floor; voxels that cannot be numbered
        return Structure.empty(str(fault))
