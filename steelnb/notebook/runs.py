"""Many runs: combinations of settings → a table with one row per run, on the cores of this machine or a Dask cluster.

``run_all(grid(seeds="1-3", methods=["icp", "best"], ...), jobs=2)`` returns the table;
``python -m steelnb.notebook.runs STUDY.toml -o FOLDER`` writes the table of a study's file.
"""

import argparse
import hashlib
import itertools
import re
import sys
import traceback
from collections.abc import Iterable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import pandas as pd
from joblib import Parallel, delayed
from pydantic import Field, field_validator
from tqdm import tqdm

from steelnb import experiment
from steelnb.core.cache import PACKAGE, SOURCES, cached
from steelnb.core.errors import InputError, SteelnbError
from steelnb.core.files import new_folder, reading
from steelnb.notebook.tables import CASE, CURVES, TIMES, case_of, make_row
from steelnb.settings import ExperimentSettings, Settings, TrajectoryName, read_tables
from steelnb.settings.base import Duration, SeedOrReport
from steelnb.settings.presets import members_file

KEPT = Path(".cache", "runs")
"""Folder of cached rows, below the current one."""
RUNS, TIMING = "runs.parquet", "timing.parquet"


class Run(NamedTuple):
    """The settings of one run, and the name of its variant."""

    settings: ExperimentSettings
    variant: str = ""

    @property
    def case(self) -> dict[str, Any]:
        """Values of the columns `CASE`."""
        values = {**case_of(self.settings), "duration_s": self.settings.flight.duration_s, "variant": self.variant}
        return {name: values[name] for name in CASE}

    @property
    def key(self) -> str:
        """Identifies the run: a hash of its variant and its settings."""
        return hashlib.sha256(f"{self.variant} {self.settings.model_dump_json()}".encode()).hexdigest()[:32]


class Grid(Settings):
    """Values to combine; one table of a study's file.

    ``seeds``: a list, or a range such as ``"101-130"``, which includes both ends; a list may hold ranges. ``variants``:
    name of the variant in tables → changed settings.
    """

    seeds: Annotated[list[SeedOrReport], Field(min_length=1)]
    trajectories: Annotated[list[TrajectoryName], Field(min_length=1)]
    noises: Annotated[list[str], Field(min_length=1)]
    sensors: Annotated[list[str], Field(min_length=1)]
    methods: Annotated[list[str], Field(min_length=1)]
    duration_s: Duration = 200.0
    variants: Annotated[dict[str, dict[str, Any]], Field(min_length=1)] = {"": {}}  # noqa: RUF012

    @field_validator("seeds", mode="before")
    @classmethod
    def _ranges(cls, value: Any) -> Any:
        return [seed for each in (value if isinstance(value, list) else [value]) for seed in _seeds(each)]

    def runs(self) -> list[Run]:
        """One run per combination. Raises `InputError`."""
        axes = self.sensors, self.trajectories, self.seeds, self.noises, self.variants.items(), self.methods
        return [
            Run(ExperimentSettings.preset(trajectory, noise, method, sensor, seed, self.duration_s, changes), variant)
            for sensor, trajectory, seed, noise, (variant, changes), method in itertools.product(*axes)
        ]


def _seeds(value: Any) -> list[Any]:
    """The seeds of a range such as ``"101-130"``, or the value itself as the only one."""
    if not isinstance(value, str) or value == "report":
        return [value]
    found = re.fullmatch(r"(\d+)-(\d+)", value.replace(" ", ""))
    if not found or not 0 <= int(found[2]) - int(found[1]) < 100_000:
        raise ValueError("expected a list, or a range such as '101-130' of at most 100,000 seeds")
    return list(range(int(found[1]), int(found[2]) + 1))


def grid(**axes: Any) -> list[Run]:
    """One run per combination of the values of a `Grid`. Raises `InputError`."""
    return Grid(**axes).runs()


def read_grids(path: Path) -> list[Run]:
    """The runs of a study's TOML file, whose tables are `Grid`s, without duplicates. Raises `InputError`."""
    grids = read_tables(path, Grid, "the settings of a study")
    if not grids:
        raise InputError(f"{path}: no table; expected at least one, such as [report]")
    runs: list[Run] = []
    for name, each in grids.items():
        try:
            runs += each.runs()
        except InputError as fault:
            raise InputError(f"{path}: [{name}]: {fault}") from None
    return list({run.key: run for run in runs}.values())


def run_all(
    runs: Iterable[Run | ExperimentSettings], jobs: int | None = None, folder: Path | str = KEPT
) -> pd.DataFrame:
    """The table of some runs, sorted by `CASE`, with the columns `CASE`, ``tower`` (`tower_name`), ``key``, ``status``,
    ``error`` and those of `row.make_row`.

    Parameters
    ----------
    runs : from `grid`, or settings.
    jobs : number of flights in parallel, each with all its runs; default: that of `joblib.parallel_config`, else one.
    folder : cache of the rows. A killed call resumes from it, and only runs with changed settings or code run again.
        Workers on other machines should share the folder.

    A failed run has the ``status`` "failed" and a traceback as ``error``. It is not cached, so the next call tries
    again. Raises `InputError` if a worker has other code or libraries than this process.
    """
    flights: dict[object, list[Run]] = {}
    for each in runs:
        run = each if isinstance(each, Run) else Run(each)
        flights.setdefault(experiment.world(run.settings), []).append(run)
    if not flights or jobs == 0:
        raise InputError(
            f"{len(flights)} flights, jobs = {jobs}: expected at least one of each; jobs = -1: one per core"
        )
    path = str(Path(folder).absolute())
    # Flights are dispatched when a worker is free, so the progress bar counts the flights begun.
    rows = Parallel(n_jobs=jobs, batch_size=1, pre_dispatch="n_jobs")(
        delayed(_rows_of_flight)(some, path, SOURCES) for some in tqdm(flights.values(), "flights begun", disable=None)
    )
    table = pd.DataFrame([row for some in rows for row in some])
    if table["seed"].dtype == object:  # "report" is among the seeds
        table["seed"] = table["seed"].astype(str)
    first = [*CASE, "tower", "key", "status", "error"]
    last = [name for name in (*CURVES, *TIMES) if name in table]
    numbers = sorted(set(table) - {*first, *last})
    return table[[*first, *numbers, *last]].sort_values(list(CASE), ignore_index=True)


def _rows_of_flight(runs: Sequence[Run], folder: str, sources: str) -> list[dict[str, Any]]:
    """Rows of runs on one flight, which is simulated if a row is not cached."""
    if sources != SOURCES:
        raise InputError("a worker has another version of steelnb or of a library than the process that started it")
    flown, rows = cache(partial(experiment.simulate, runs[0].settings)), []
    for run in runs:
        settings, text = run.settings, run.settings.model_dump_json()
        named = {**run.case, "tower": tower_name(settings), "key": run.key, "status": "ok", "error": ""}
        try:
            row = cached(partial(make_row, settings, flown), "row", text, experiment.world(settings), folder=folder)
        except Exception:
            # Tables are published, so the traceback must not contain this machine's paths.
            error = traceback.format_exc(limit=-3).replace(f"{PACKAGE.parent}/", "")
            row = {"status": "failed", "error": error}
        rows.append({**named, **row})
    return rows


def tower_name(settings: ExperimentSettings) -> str:
    """The list of members with the start of its SHA-256, such as ``report-tower 1a2b3c4d``, so that runs on an older
    list
    are told apart. Empty for a tower that is built from its dimensions."""
    members = settings.tower.members
    return (
        f"{Path(members).stem} {hashlib.sha256(members_file(members).read_bytes()).hexdigest()[:8]}" if members else ""
    )


def curves(table: pd.DataFrame) -> pd.DataFrame:
    """The thinned curves of some runs in long form, one row per sample: the columns `CASE`, ``time_s``, the errors
    without and with correction, ``raw_m`` and ``error_m``, and ``matches``, the number of correspondences."""
    long = table[[*CASE, *CURVES]].dropna(subset=list(CURVES)).explode(list(CURVES), ignore_index=True)
    named = {name: name.removeprefix("curve_") for name in CURVES}
    return long.astype(dict.fromkeys(CURVES, float)).rename(columns=named)


def write_runs(folder: Path, table: pd.DataFrame) -> None:
    """Write a table of `run_all` to `RUNS`, and its measured times to `TIMING`. Raises `OutputError`."""
    times = [name for name in TIMES if name in table]
    with new_folder(folder) as new:
        table.drop(columns=times).to_parquet(new / RUNS, index=False, compression="zstd", compression_level=9)
        table[[*CASE, "key", *times]].to_parquet(new / TIMING, index=False, compression="zstd", compression_level=9)


def read_runs(folder: Path) -> pd.DataFrame:
    """Read the table that `write_runs` wrote. Raises `InputError`."""
    with reading(folder / RUNS, "the table of a study"):
        table = pd.read_parquet(folder / RUNS)
    with reading(folder / TIMING, "the times of a study"):
        return table.merge(pd.read_parquet(folder / TIMING).drop(columns=list(CASE)), on="key", how="left")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command of `make study`. Exit code 1: some runs failed; 2: bad input, reported in one line."""
    parser = argparse.ArgumentParser(
        prog="python -m steelnb.notebook.runs", description="Run a study and write its table."
    )
    parser.add_argument("study", type=Path, metavar="STUDY.toml")
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", required=True)
    parser.add_argument("-j", "--jobs", type=int, default=-1, help="flights at once; default: one per core")
    options = parser.parse_args(arguments)
    try:
        table = run_all(read_grids(options.study), options.jobs)
        write_runs(options.output, table)
    except (SteelnbError, OSError) as fault:
        print("error:", " ".join(str(fault).split()), file=sys.stderr)
        return 2
    failed = table[table["status"] == "failed"]
    for run in failed.itertuples():
        print(f"{run.method}, {run.trajectory}, seed {run.seed}: {run.error.splitlines()[-1]}", file=sys.stderr)
    print(f"{options.output / RUNS} written: {len(table)} runs, {len(failed)} of them failed")
    return int(len(failed) > 0)


if __name__ == "__main__":
    from steelnb.notebook import runs  # workers load the module by this name

    sys.exit(runs.main())
