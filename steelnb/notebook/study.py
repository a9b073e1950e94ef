"""A study: combinations of settings → a table with one row per run.

``run_study(cases.grid(seeds="1-3", methods=["icp", "best"], ...), jobs=2)`` returns the table;
``steelnb study STUDY.toml -o FOLDER`` writes the table of a study's file.
"""

import traceback
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from steelnb import experiment
from steelnb.core.cache import PACKAGE, cached, digest_rooms
from steelnb.core.determinism import machine
from steelnb.core.errors import InputError, OutputError
from steelnb.core.files import OVERWRITE, check_writable, new_folder, reading
from steelnb.metrics import diagnose, position_error_m
from steelnb.notebook.cases import RUN_COLUMNS, Run, distinct
from steelnb.notebook.results import RUNS
from steelnb.notebook.runs import Flights, run_all
from steelnb.notebook.tables import stage_times, tower_name
from steelnb.settings import ExperimentSettings

CURVES = ["curve_time_s", "curve_raw_m", "curve_error_m", "curve_matches"]
TIMES = ("frame_median_ms", "frame_p95_ms", "machine")
"""Columns that differ from run to run of the same settings; comparisons ignore them."""
CURVE_SAMPLES = 100
KEPT = Path(".cache", "runs")
"""Folder of cached rows, below the current one."""
ROW_SOURCES = digest_rooms("notebook")
"""Rows depend on this room as well as on the rooms that flights and estimates depend on."""
TIMING = "timing.parquet"


def run_study(
    runs: Iterable[Run | ExperimentSettings], jobs: int | None = None, folder: Path | str = KEPT
) -> pd.DataFrame:
    """The table of some runs, sorted by `RUN_COLUMNS`, with the columns `RUN_COLUMNS`, ``tower`` (`tower_name`),
    ``key``, ``status``, ``error`` and those of `make_row`.

    Parameters
    ----------
    runs : from `grid`, or settings; equal ones give one row.
    jobs : number of flights in parallel, each with all its runs; default: that of `joblib.parallel_config`, else one.
    folder : cache of the rows. A killed call resumes from it, and only runs with changed settings or code run again.
        Workers on other machines should share the folder.

    A failed run has the ``status`` "failed" and a traceback as ``error``. It is not cached, so the next call tries
    again. Raises `InputError` as `run_all` does.
    """
    wanted = distinct(each if isinstance(each, Run) else Run(each) for each in runs)
    settings, task = [run.settings for run in wanted], partial(_cached_row, str(Path(folder).absolute()))
    with tqdm(total=100, desc="runs", unit=" %", disable=None) as bar:
        found = run_all(settings, lambda share: bar.update(round(100 * share) - bar.n), task, jobs, timed=True)
    cases = [{**run.case, "tower": tower_name(run.settings), "key": run.key} for run in wanted]
    table = pd.DataFrame([{**case, **row} for case, row in zip(cases, found, strict=True)])
    if table["seed"].dtype == object:  # "report" is among the seeds
        table["seed"] = table["seed"].astype(str)
    first = [*RUN_COLUMNS, "tower", "key", "status", "error"]
    last = [name for name in (*CURVES, *TIMES) if name in table]
    numbers = sorted(set(table) - {*first, *last})
    return table[[*first, *numbers, *last]].sort_values(list(RUN_COLUMNS), ignore_index=True)


def _cached_row(
    folder: str, settings: ExperimentSettings, flights: Flights, on_progress: experiment.OnProgress | None
) -> dict[str, Any]:
    """The task of a study: the row of a run, from the cache in ``folder`` or made anew."""
    key = "row", ROW_SOURCES, settings.model_dump_json(), experiment.world(settings)
    try:
        row = cached(lambda: make_row(settings, flights), *key, folder=folder)
    except Exception:
        # Tables are published, so the traceback must not contain this machine's paths.
        error = traceback.format_exc(limit=-3).replace(f"{PACKAGE.parent}/", "")
        return {"status": "failed", "error": error}
    return {"status": "ok", "error": "", **row}


def make_row(settings: ExperimentSettings, flights: Flights) -> dict[str, Any]:
    """Correct the flight of the settings. Returns metrics, `diagnose`, `thinned_curves` and `TIMES`."""
    flight, truth = flights(settings)
    result = experiment.estimate(settings, flight, truth)
    numbers = {**result.metrics, **diagnose(flight, result, truth, settings.odometry.preprocess)}
    finite = {name: float(value) for name, value in numbers.items() if np.isfinite(value)}
    times = {f"frame_{name}": ms for name, ms in stage_times(result)["frame"].items()}
    return {**finite, **thinned_curves(result), **times, "machine": machine()}


def thinned_curves(result: experiment.Result) -> dict[str, np.ndarray]:
    """At most `CURVE_SAMPLES` samples of stamps, errors without and with correction, and numbers of correspondences."""
    stamp_s, truth = result.corrected.stamp_s, result.truth.trajectory
    chosen = np.unique(np.linspace(0, len(stamp_s) - 1, min(CURVE_SAMPLES, len(stamp_s))).round().astype(int))
    return {
        "curve_time_s": stamp_s[chosen].astype(np.float32),
        "curve_raw_m": position_error_m(result.prior, truth)[chosen].astype(np.float32),
        "curve_error_m": position_error_m(result.corrected, truth)[chosen].astype(np.float32),
        "curve_matches": result.matches[chosen].astype(np.int32),
    }


def study_curves(table: pd.DataFrame) -> pd.DataFrame:
    """The thinned curves of some runs in long form, one row per sample: the columns `RUN_COLUMNS`, ``time_s``, the
    errors without and with correction, ``raw_m`` and ``error_m``, and ``matches``, the number of correspondences."""
    long = table.reindex(columns=[*RUN_COLUMNS, *CURVES]).dropna(subset=CURVES).explode(CURVES, ignore_index=True)
    return long.astype(dict.fromkeys(CURVES, float)).rename(columns=lambda name: name.removeprefix("curve_"))


def check_runs(folder: Path | str, runs: Iterable[Run], overwrite: bool = False) -> None:
    """Raise `OutputError` if a folder cannot be written to or, unless ``overwrite``, if its table has runs of another
    study, which none of the ``runs`` would replace. Runs are told apart by `RUN_COLUMNS`."""
    check_writable(folder)
    if overwrite or not Path(folder, RUNS).exists():
        return
    tables = read_runs(folder), pd.DataFrame([run.case for run in runs])
    old, new = ({*table[[*RUN_COLUMNS]].astype(str).itertuples(index=False, name=None)} for table in tables)
    if lost := old - new:
        words = f"{len(lost)} of its {len(old)} runs are not in this study; expected another folder"
        raise OutputError(f"{folder}: {words}, or {OVERWRITE}")


def write_runs(folder: Path | str, table: pd.DataFrame) -> None:
    """Write a table of `run_study` to `RUNS`, and its measured times to `TIMING`. Raises `OutputError`."""
    times = [name for name in TIMES if name in table]
    with new_folder(folder) as new:
        table.drop(columns=times).to_parquet(new / RUNS, index=False, compression="zstd", compression_level=9)
        timing = table[[*RUN_COLUMNS, "key", *times]]
        timing.to_parquet(new / TIMING, index=False, compression="zstd", compression_level=9)


def read_runs(folder: Path | str) -> pd.DataFrame:
    """Read the table that `write_runs` wrote. Raises `InputError`."""
    table = _read_table(Path(folder, RUNS), "the table of a study")
    timing = _read_table(Path(folder, TIMING), "the times of a study").drop(columns=list(RUN_COLUMNS))
    return table.merge(timing, on="key", how="left")


def _read_table(path: Path, form: str) -> pd.DataFrame:
    """One of the tables of `write_runs`, each run once."""
    with reading(path, form):
        table = pd.read_parquet(path)
    if missing := [name for name in (*RUN_COLUMNS, "key") if name not in table]:
        raise InputError(f"{path}: no column {missing[0]!r}; expected {form}")
    return table.drop_duplicates("key", ignore_index=True)
