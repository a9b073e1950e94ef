"""Several experiments that share flights, the tables of their numbers, and what the report shows of the same."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment, rng
from steelnb.errors import InputError
from steelnb.metrics import bend, position_error_m
from steelnb.noise import drifting
from steelnb.odometry import shared_segments
from steelnb.results import find_root
from steelnb.row import case_of, paired_clouds, stage_times
from steelnb.settings import (
    REPORT_NOISE,
    ExperimentSettings,
    LoamSettings,
    Noise,
    RegistrationSettings,
    ReportCloudSettings,
)
from steelnb.settings.report_plots import STEP_S, ReportPlot, read_report_plots
from steelnb.simulation import Tower, build_tower, fly
from steelnb.types import Array

CLOUD_CASE = ("trajectory", "noise", "method", "map")
"""Columns that name a run of an odometry by clouds."""

REPORT_FIGURE = {"vertical": "3_2", "orbit": "3_3", "random-walk": "3_5", "constant-drift": "3_6"}
"""The report's figure of segment odometry on a flight, and of odometry by clouds under a noise, as files are named."""
REPORT_CURVES = Path("notebooks", "report-curves.csv")
"""The curves of the report's plots, read off its PDF, below the root of the project."""


@cache
def _report_curves() -> pd.DataFrame:
    return pd.read_csv(find_root() / REPORT_CURVES, dtype={"figure": str})


def report_curve(plot: ReportPlot, curve: str = "corrected", until_s: float = np.inf) -> tuple[Array, Array]:
    """Times (s) and errors (m), each ``(N,)``, of the curve ``corrected`` or ``drift`` of one of the report's plots,
    without the samples of an earlier run and those later than ``until_s``."""
    named = {"figure": plot.figure, "trajectory": plot.trajectory, "method": plot.method, "curve": curve}
    rows = _report_curves()
    rows = rows[(rows[list(named)] == pd.Series(named)).all(axis=1) & (rows["step"] >= plot.earlier_samples)]
    time_s, error_m = plot.step_at(rows["step"].to_numpy()) * STEP_S, rows["error_m"].to_numpy()
    return time_s[time_s <= until_s], error_m[time_s <= until_s]


def plot_of(settings: ExperimentSettings) -> ReportPlot | None:
    """The report's plot whose flight, noise and rate of samples an experiment has, or None."""
    wanted = (settings.flight.trajectory, settings.noise_name, settings.tof.rate_hz)
    plots = {(plot.flight or plot.trajectory, plot.noise, plot.rate_hz): plot for plot in reversed(read_report_plots())}
    return plots.get(wanted)


def at_level(noise: str, level: float) -> str:
    """A noise whose levels, the report's where it names none, are multiplied by ``level``. Raises `InputError` for an
    unknown noise."""
    Noise.parse(noise)
    if noise == "none" or level == 1:
        return noise
    parts = (part.strip().partition(":") for part in noise.split("+"))
    return "+".join(f"{name}:{level * float(given or REPORT_NOISE[name][1]):g}" for name, _, given in parts)


def report_cases(
    trajectory: Iterable[str],
    noise: str,
    methods: Mapping[str, Iterable[str]],
    sensor: str = "report",
    seed: rng.Seed = "report",
    duration_s: float | None = None,
    overrides: dict[str, Any] | None = None,
) -> list[ExperimentSettings]:
    """Settings of the report's own experiments: for each flight, and each method of its plots, the methods that fly on
    the samples of that plot, which are those of the other noise where the plot's noise is not ``noise``.

    ``duration_s``: default as long as the plot. Raises `InputError`.
    """
    cases = []
    for flight, shown in itertools.product(trajectory, methods):
        plots = [plot for plot in read_report_plots() if (plot.trajectory, plot.method) == (flight, shown)]
        if not plots:
            raise InputError(f"no plot of the report shows {shown!r} on the flight {flight!r}")
        plot = next((plot for plot in plots if plot.noise == noise), plots[0])
        samples = {"tof.rate_hz": plot.rate_hz, "tof.start_s": plot.start_s}
        cases += [
            ExperimentSettings.preset(
                plot.flight or plot.trajectory, noise, method, sensor, seed, duration_s or plot.duration_s,
                {**samples, **(overrides or {})},
            )
            for method in methods[shown]
        ]  # fmt: skip
    return cases


def paths(settings: ExperimentSettings) -> tuple[Tower, dict[str, Array]]:
    """The tower, and the positions ``(N, 3)`` of the flight past it: the true ones, ``truth``, and the drifting ones,
    ``none``. Nothing is scanned. Raises `CollisionError`."""
    tower = build_tower(settings.tower)
    truth, _ = fly(tower, settings.flight, settings.seed)
    return tower, {"truth": truth.position, "none": drifting(truth, settings.noise, settings.seed).position}


def run_all(
    cases: Sequence[ExperimentSettings], on_progress: experiment.Progress | None = None
) -> list[experiment.Result]:
    """A result for each case, in their order; cases on one flight share its simulation. Raises `CollisionError`."""
    results: dict[int, experiment.Result] = {}
    flights: dict[object, list[int]] = {}
    for k, case in enumerate(cases):
        flights.setdefault(experiment.world(case), []).append(k)

    def on_share(share: float) -> None:
        if on_progress:
            on_progress((len(results) + share) / len(cases))

    for members in flights.values():
        flight, truth = experiment.simulate(cases[members[0]])
        with shared_segments():
            for k in members:
                results[k] = experiment.estimate(cases[k], experiment.redrift(cases[k], flight, truth), truth, on_share)
    return [results[k] for k in range(len(cases))]


def map_kind(settings: ExperimentSettings) -> str:
    """The map of an odometry: ``weighted`` (means of all points), ``re-voxelised`` (the report's, which forgets), or
    ``bars``."""
    chosen = settings.odometry
    if isinstance(chosen, RegistrationSettings | LoamSettings):
        return "re-voxelised" if chosen.map == "re-voxelised" else "weighted"
    return "re-voxelised" if isinstance(chosen, ReportCloudSettings) else "bars"


def table(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """One row a run: its case, then its numbers."""
    return pd.DataFrame([{**case_of(result.settings), **result.metrics} for result in results])


def cloud_table(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """`table` with the kind of map of each run, its scans, and the share of those that corrected nothing."""
    rows = table(results)
    rows.insert(list(rows).index("method") + 1, "map", [map_kind(result.settings) for result in results])
    rows["scans"] = [len(result.corrected) for result in results]
    rows["unused_share"] = [float((result.matches[1:] == 0).mean()) for result in results]
    return rows


def report_table(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """`cloud_table` with mean, maximum and end (m) of the corrected curve in the report's plot of the same experiment,
    up to the end of the run: ``report_mean_m``, ``report_max_m``, ``report_final_m``; NaN where there is none."""
    none = np.array([0.0]), np.array([np.nan])
    errors = [_reported(result).get("report", none)[1] for result in results]
    columns = ["report_mean_m", "report_max_m", "report_final_m"]
    numbers = pd.DataFrame([(error.mean(), error.max(), error[-1]) for error in errors], columns=columns)
    return cloud_table(results).join(numbers)


def _reported(result: experiment.Result) -> dict[str, tuple[Array, Array]]:
    """The curves ``report-drift`` and ``report`` of the report's plot of a run, to two samples after the run's end."""
    plot, end_s = plot_of(result.settings), float(result.corrected.stamp_s[-1]) + 2 / result.settings.tof.rate_hz
    if plot is None:
        return {}
    return {"report-drift": report_curve(plot, "drift", end_s), "report": report_curve(plot, until_s=end_s)}


def curves(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """Errors over time in long form, a row a sample: the columns of `case_of`, ``curve``, ``time_s`` and ``error_m``.

    Each run has a ``curve`` named by its method and ``none``, its drift; and where the report has a plot of the same
    experiment (`plot_of`), ``report`` and ``report-drift``, as read off that plot.
    """
    parts = []
    for result in results:
        lines = _reported(result)  # first, and so behind the others
        for name, path in {"none": result.prior, result.settings.odometry.method: result.corrected}.items():
            lines[name] = path.stamp_s, position_error_m(path, result.truth.trajectory)
        for name, (time_s, error_m) in lines.items():
            samples = {"curve": name, "time_s": time_s, "error_m": error_m}
            parts.append(pd.DataFrame({**case_of(result.settings), **samples}))
    return pd.concat(parts, ignore_index=True)


def clouds(results: Sequence[experiment.Result]) -> list[tuple[Array, Array]]:
    """The points of each run at its estimated and at the true poses (`paired_clouds`). Flights are simulated again,
    those that runs share once."""
    settings = {experiment.world(result.settings): result.settings for result in results}
    flights = {world: experiment.simulate(one)[0] for world, one in settings.items()}
    return [paired_clouds(flights[experiment.world(result.settings)], result) for result in results]


def bends(clouds: Iterable[tuple[Array, Array]], tower: Tower) -> pd.DataFrame:
    """How each pair of `clouds` is bent: a row a pair, the numbers of `metrics.bend` about the middle of a tower."""
    axis = tower.vertices[:, :2].mean(axis=0)
    return pd.DataFrame([bend(*pair, axis) for pair in clouds])


def metrics(results: Sequence[experiment.Result], by: Sequence[str] = ("noise", "method")) -> dict[str, float]:
    """The finite numbers of all runs in one flat map, ``<values of by>.<metric>``."""
    return {f"{_name(r.settings, by)}.{k}": v for r in results for k, v in r.metrics.items() if np.isfinite(v)}


def provenance(results: Sequence[experiment.Result], by: Sequence[str] = ("noise", "method")) -> dict[str, Any]:
    """The settings of all runs, by ``<values of by>``."""
    return {_name(result.settings, by): result.settings.model_dump() for result in results}


def _name(settings: ExperimentSettings, by: Sequence[str]) -> str:
    case = {**case_of(settings), "map": map_kind(settings)}
    return ".".join(str(case[name]) for name in by)


def timing(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """Milliseconds a frame, median and 95th percentile, for each run and stage and for the whole frame."""
    return pd.DataFrame(
        {**case_of(result.settings), "stage": stage, **times}
        for result in results
        for stage, times in stage_times(result).items()
    )


def flat(
    rows: pd.DataFrame, by: Sequence[str] = (), columns: Sequence[str] | None = None, prefix: str = ""
) -> dict[str, float]:
    """The finite numbers of a table in one flat map ``<prefix><values of by>.<column>``, named by its index without
    ``by``."""
    keys = rows[list(by)].astype(str).agg(".".join, axis=1) if by and len(rows) else rows.index.astype(str)
    wanted = [name for name in rows if name not in by] if columns is None else columns
    named = {f"{prefix}{key}.{name}": rows[name].iloc[k] for k, key in enumerate(keys) for name in wanted}
    return {name: float(value) for name, value in named.items() if np.isfinite(value)}
