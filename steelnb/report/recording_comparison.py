"""A recorded flight through several odometries → a folder with a run of each, and one table and figure of all."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from steelnb.errors import SettingsError
from steelnb.files import new_folder, replace_files
from steelnb.metrics import position_error_m
from steelnb.report.recording import FILES, check_folder, default_folder, run_recording
from steelnb.report.recording_figures import figure_distances
from steelnb.report.recording_files import TIMES
from steelnb.report.style import Figure
from steelnb.settings import ExperimentSettings, StructureSettings
from steelnb.types import Array, Flight, Trajectory

ERRORS = {"ate_rmse_m": "rms_m", "error_max_m": "max_m", "error_final_m": "end_m"}
MOVED = {"ate_rmse_m": "moved_rms_m", "error_max_m": "moved_max_m", "error_final_m": "moved_final_m"}
"""The names of the same where they are distances from the recorded poses."""
HEADINGS = {
    "odometry": "odometry", **ERRORS, **{MOVED[name]: heading for name, heading in ERRORS.items()},
    "used": "scans_used", "frame_median_ms": "median_ms", "frame_p95_ms": "p95_ms",
    "frame_p99_ms": "p99_ms", "on_time_share": "on_time", "segments": "bars",
}  # fmt: skip
"""Columns of the table that are printed, and how."""
MORE = ("frames", "map_points", "structure_bars", "structure_joints")


@dataclass(frozen=True)
class ComparisonReport:
    """The results of `compare_recording` and the ``folder`` that it wrote.

    ``table`` has a row an odometry: metres of error (``ate_rmse_m`` and others) or, without a truth, of distance from
    the recorded poses (``moved_rms_m``); scans, milliseconds a scan, bars. ``summary`` are lines of text.
    """

    folder: Path
    table: pd.DataFrame
    figure: Figure
    summary: tuple[str, ...]


def compare_recording(
    flight: Flight,
    output: Path | str | None,
    settings: Mapping[str, tuple[ExperimentSettings, StructureSettings | None]],
    *,
    overwrite: bool = True,
    on_stage: Callable[[str], None] = lambda _: None,
    **options: Any,
) -> ComparisonReport:
    """Correct a recorded flight by several odometries, one after the other; one scan is in memory at a time.

    ``settings`` by the name of each, as `recording_settings` gives them; ``output``, by default ``NAME_run`` here, and
    ``options`` as for `run_recording`, which writes each run to a folder of that name below the output folder. There,
    ``comparison.csv`` and ``comparison.png`` hold the errors, or the distances from the recorded poses where there is
    no truth, and the times a scan. Nothing is written on an error. Raises what `run_recording` raises, and
    `SettingsError` for one odometry under two names.
    """
    methods = {name: each.odometry.method for name, (each, _) in settings.items()}
    for name, method in methods.items():
        if [*methods.values()].count(method) > 1:
            raise SettingsError(f"odometry = {name!r}: given twice (it is {method!r}); expected each one once")
    target = Path(output) if output else default_folder(flight)
    check_folder(target, overwrite)
    rows: list[dict[str, Any]] = []
    curves: dict[str, tuple[Array, Array]] = {}
    times_ms: dict[str, Array] = {}
    notes: dict[str, None] = {}
    with new_folder(target, FILES, overwrite) as folder:
        for name, (each, structure) in settings.items():
            report = run_recording(
                flight, folder / name, each, structure=structure,
                on_stage=_named(name, on_stage), **options,
            )  # fmt: skip
            estimate, true = report.estimate, report.truth or report.estimate.prior
            if report.truth is not None and not rows:
                rows.append({"odometry": "drifting", **_errors(estimate.prior, true)})
                curves["drifting"] = true.stamp_s, position_error_m(estimate.prior.at(true.stamp_s), true)
            numbers = {key: report.numbers[key] for key in (*HEADINGS, *TIMES, *MORE) if key in report.numbers}
            rows.append({"odometry": name, **_errors(estimate.corrected, true), **numbers})
            curves[methods[name]] = true.stamp_s, position_error_m(estimate.corrected.at(true.stamp_s), true)
            times_ms[methods[name]] = 1e3 * estimate.update_s
            notes |= dict.fromkeys(line for line in report.summary if line.startswith(("read", "skipped", "note")))
            judged = report.truth is not None
        on_stage("drawing the comparison")
        table = pd.DataFrame(rows) if judged else pd.DataFrame(rows).rename(columns=MOVED)
        table.to_csv(folder / "comparison.csv", index=False, float_format="%.6g", lineterminator="\n")
        what = "distance to the truth (m)" if judged else "distance from the recorded poses (m)"
        figure = figure_distances(curves, what, flight.name, times_ms)
        figure.savefig(folder / "comparison.png", dpi=150)
        for name in settings:
            if (target / name).is_dir():  # of an earlier run: folders, unlike files, cannot be renamed over others
                replace_files(folder / name, target / name, FILES)
    meaning = (
        "errors are distances to the truth" if judged else "no truth: metres are distances from the recorded poses"
    )
    written = (
        f"written   {target}/: comparison.csv, comparison.png, and of each run {', '.join(f'{n}/' for n in settings)}"
    )
    summary = (*notes, f"compared  {len(settings)} odometries; {meaning}", *_printed(table), written)
    return ComparisonReport(target, table, figure, summary)


def _named(name: str, on_stage: Callable[[str], None]) -> Callable[[str], None]:
    return lambda stage: on_stage(f"{name}: {stage}")


def _errors(path: Trajectory, true: Trajectory) -> dict[str, float]:
    """The `ERRORS` of a path at the poses of another."""
    distance_m = position_error_m(path.at(true.stamp_s), true)
    return dict(zip(ERRORS, (np.sqrt((distance_m**2).mean()), distance_m.max(), distance_m[-1]), strict=True))


def _printed(table: pd.DataFrame) -> list[str]:
    """The table in lines of text, indented as the summary is."""
    shown = table[[column for column in HEADINGS if column in table]].copy()
    for column in shown.columns[1:]:
        digits = 3 if column.endswith("_m") else 2 if column == "on_time_share" else 1 if column.endswith("_ms") else 0
        shown[column] = [f"{value:.{digits}f}" if np.isfinite(value) else "" for value in shown[column]]
    lines = shown.rename(columns=HEADINGS).to_string(index=False).splitlines()
    return [f"          {line.rstrip()}" for line in lines]
