"""What a run leaves: its files and its figures, and the lines that say so."""

import csv
from pathlib import Path

import numpy as np

from steelnb.datatypes import Array, Segments
from steelnb.exports import orientation
from steelnb.fusion.structure import Structure
from steelnb.recordings.recording import Recording
from steelnb.replay.course import Course
from steelnb.replay.judge import Number, errors_m
from steelnb.replay.offline import Replayed
from steelnb.replay.options import Options


def true_poses(course: Course) -> dict[int, Array]:
    """True pose of each scan that has one, by the scan's number."""
    if course.truth is None:
        return {}
    index = np.searchsorted(course.flight.prior.stamp_s, course.truth.stamp_s - 1e-6)
    return dict(zip(index.tolist(), course.truth.T_world_drone, strict=True))


def write_map(path: Path, points: Array) -> None:
    """Points ``(N, 3)`` as a binary PLY file in double precision."""
    header = ["ply", "format binary_little_endian 1.0", "comment metres, z up", f"element vertex {len(points)}"]
    header += [*(f"property double {axis}" for axis in "xyz"), "end_header", ""]
    path.write_bytes("\n".join(header).encode() + np.ascontiguousarray(points, dtype="<f8").tobytes())


def write_table(path: Path, numbers: dict[str, Number]) -> None:
    """A row for each number, six digits of it."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("quantity", "value"))
        writer.writerows(
            (name, f"{value:.6g}" if isinstance(value, float) else value) for name, value in numbers.items()
        )


def write_frames(path: Path, course: Course, replayed: Replayed) -> None:
    """A row a scan; errors are empty where there is no truth."""
    prior, corrected = ({} for _ in range(2)) if course.truth is None else _errors(course, replayed)
    rows = zip(replayed.prior.stamp_s.tolist(), replayed.matches.tolist(), replayed.reason,
               (1e3 * replayed.seconds).tolist(), strict=True)  # fmt: skip
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("stamp_s", "matches", "not_used", "ms", "prior_error_m", "corrected_error_m"))
        for k, (stamp, matches, reason, ms) in enumerate(rows):
            errors = (f"{of[k]:.4f}" if k in of else "" for of in (prior, corrected))
            writer.writerow((f"{stamp:.6f}", matches, reason, f"{ms:.2f}", *errors))


def _errors(course: Course, replayed: Replayed) -> tuple[dict[int, float], dict[int, float]]:
    assert course.truth is not None
    index = list(true_poses(course))
    prior, corrected = (errors_m(t, course.truth).tolist() for t in (replayed.prior, replayed.corrected))
    return dict(zip(index, prior, strict=True)), dict(zip(index, corrected, strict=True))


def draw_figures(
    folder: Path, recording: Recording, course: Course, replayed: Replayed, bars: Segments, options: Options
) -> None:
    """Trajectories, the map with its bars, and where there is truth the errors over time, as PNG files."""
    from steelnb.figures.recorded import figure_recorded_errors, figure_recorded_trajectories
    from steelnb.figures.segments import figure_segments

    name, method = recording.path.name, options.settings().odometry.method
    truth = course.truth
    figures = {
        "trajectories.png": figure_recorded_trajectories(replayed.prior, replayed.corrected, truth, method, name)
    }
    if truth is not None:
        prior, corrected = (errors_m(t, truth) for t in (replayed.prior, replayed.corrected))
        figures["errors.png"] = figure_recorded_errors(truth.stamp_s, prior, corrected, method, name)
    if len(replayed.points) > 1:
        title = f"{name}: {len(replayed.points)} points of the map, {len(bars)} bars"
        figures["map.png"] = figure_segments(replayed.points, bars, orientation(bars), title)
    for file, figure in figures.items():
        figure.savefig(folder / file, dpi=150)


def summarised(
    recording: Recording,
    course: Course,
    numbers: dict[str, Number],
    built: Structure | None,
    target: Path,
    files: list[str],
) -> tuple[str, ...]:
    """What a user reads on the terminal."""
    unused = [f"{count} {name.partition(': ')[2]}" for name, count in numbers.items() if name.startswith("not used: ")]
    skipped = [f"{count} {name.partition(': ')[2]}" for name, count in numbers.items() if name.startswith("skipped: ")]
    lines = [
        f"read      {recording.path.name}: {numbers['frames']} scans with a pose over {numbers['duration_s']:.1f} s",
        *([f"skipped   {'; '.join(skipped)}"] if skipped else []),
        *(f"note      {note}" for note in course.notes),
        f"used      {numbers['used']} scans" + (f"; not used: {', '.join(unused)}" if unused else ""),
        f"time      {numbers['frame_median_ms']:.1f} ms a scan (95 %: {numbers['frame_p95_ms']:.1f} ms), "
        f"{100 * float(numbers['on_time_share']):.1f} % on time",
    ]
    if "prior_ate_rmse_m" in numbers:
        removed = numbers.get("drift_removed_percent")
        lines.append(
            f"error     {numbers['prior_ate_rmse_m']:.3f} m drifting, {numbers['corrected_ate_rmse_m']:.3f} m "
            "corrected (ATE, root mean square)"
            + (f": {removed:.0f} % of the drift removed" if removed is not None else "")
        )
    lines.append(f"map       {numbers['map_points']} points, {numbers['segments']} bars in segments.csv")
    if built is not None:
        lines.append(
            f"structure {len(built)} bars, {len(built.joint)} joints"
            if len(built)
            else f"structure empty: {built.reason}"
        )
    return (*lines, f"written   {target}/: {', '.join(files)}")
