"""Several experiments that share flights, tables of their metrics, and the report's curves of the same experiments."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from joblib import Parallel, delayed

from steelnb import experiment
from steelnb.core import rng
from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.metrics import bend, position_error_m
from steelnb.notebook.results import find_root
from steelnb.notebook.tables import case_of, paired_clouds, stage_times
from steelnb.odometry import shared_segments
from steelnb.settings import (
    REPORT_NOISE,
    ExperimentSettings,
    LoamSettings,
    Noise,
    RegistrationSettings,
    ReportCloudSettings,
)
from steelnb.settings.report_plots import ReportPlot, read_report_plots
from steelnb.simulation import Tower, build_tower, fly
from steelnb.simulation.noise import drifting

CASE_COLUMNS = ("trajectory", "noise", "method", "sensor", "seed")
"""The columns of `case_of`."""
CLOUD_CASE = ("trajectory", "noise", "method", "map")
"""Columns that identify a run of a point-cloud odometry."""

REPORT_FIGURE = {"vertical": "3_2", "orbit": "3_3", "random-walk": "3_5", "constant-drift": "3_6"}
"""The report's figure, as in file names: by flight for segment odometry, by noise for point-cloud odometry."""
REPORT_CURVES = Path("notebooks", "report-curves.csv")
"""The curves of the report's plots, read off its PDF. The path is relative to the root of the project."""


@cache
def _report_curves() -> pd.DataFrame:
    return pd.read_csv(find_root() / REPORT_CURVES, dtype={"figure": str})


def report_curve(plot: ReportPlot, curve: str = "corrected", until_s: float = np.inf) -> tuple[Array, Array]:
    """Times (s) and errors (m), each ``(N,)``, of the curve ``corrected`` or ``drift`` in one of the report's plots.
    Samples of another run in the same plot and those after ``until_s`` are left out."""
    named = {"figure": plot.figure, "trajectory": plot.trajectory, "method": plot.method, "curve": curve}
    rows = _report_curves()
    rows = rows[(rows[list(named)] == pd.Series(named)).all(axis=1)]
    time_s, error_m = plot.time_at(rows["step"].to_numpy()), rows["error_m"].to_numpy()
    return time_s[time_s <= until_s], error_m[time_s <= until_s]  # false for NaN


def plot_of(settings: ExperimentSettings) -> ReportPlot | None:
    """The report's plot whose samples an experiment has, if it has its flight and noise as well, or None."""
    name = settings.tof.samples
    plot = ReportPlot.named(name) if isinstance(name, str) else None
    if plot is None or plot.noise != settings.noise_name:
        return None
    return plot if (plot.flight or plot.trajectory) == settings.flight.trajectory else None


def at_level(noise: str, level: float) -> str:
    """A noise with all its levels multiplied by ``level``. Parts without a level have the report's. Raises `InputError`
    for an unknown noise."""
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
    """Settings of the report's own experiments. ``methods`` maps the method of a plot to the methods that are run with
    the sampling of that plot. If no plot of a flight has the ``noise``, the sampling is that of its other plot.

    ``duration_s``: default, the duration of the plot. A plot's earlier run is left out. Raises `InputError`.
    """
    cases = []
    shown_runs = [plot for plot in read_report_plots() if not plot.run]
    for flight, shown in itertools.product(trajectory, methods):
        plots = [plot for plot in shown_runs if (plot.trajectory, plot.method) == (flight, shown)]
        if not plots:
            raise InputError(f"no plot of the report shows {shown!r} on the flight {flight!r}")
        plot = next((plot for plot in plots if plot.noise == noise), plots[0])
        cases += [
            ExperimentSettings.report(
                plot.figure, flight, shown, method, overrides, "", noise, sensor, seed, duration_s
            )
            for method in methods[shown]
        ]  # fmt: skip
    return cases


def with_earlier_runs(cases: Iterable[ExperimentSettings]) -> list[ExperimentSettings]:
    """The cases, each after the earlier run that the report's plot of it shows, if there is one."""
    earlier = {f"{plot.figure} {plot.trajectory} {plot.method}": plot for plot in read_report_plots() if plot.run}
    found = []
    for case in cases:
        plot = plot_of(case)
        if plot and plot.name in earlier:
            own = case.override({"tof.samples": earlier[plot.name].name})
            found.append(
                own.override({"flight.duration_s": min(earlier[plot.name].duration_s, case.flight.duration_s)})
            )
        found.append(case)
    return found


def paths(settings: ExperimentSettings) -> tuple[Tower, dict[str, Array]]:
    """The tower, and the positions ``(N, 3)`` of a flight past it: the true ones (``truth``) and the drifting ones
    (``none``). No scans are simulated. Raises `CollisionError`."""
    tower = build_tower(settings.tower)
    truth, _ = fly(tower, settings.flight, settings.seed)
    return tower, {"truth": truth.position, "none": drifting(truth, settings.noise, settings.seed).position}


def run_all(
    cases: Sequence[ExperimentSettings], on_progress: experiment.Progress | None = None
) -> list[experiment.Result]:
    """Results of the cases, in order. Cases on one flight share its simulation. Raises `CollisionError`."""
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


def draw_programs(
    cases: Sequence[ExperimentSettings], count: int, on_progress: experiment.Progress | None = None, jobs: int = 1
) -> pd.DataFrame:
    """Errors over time of ``count`` draws of the sensor's noise of each case, with the same drift and flight, beside
    the report's curve: long form with the columns of `case_of`, ``plot``, ``curve``, ``draw``, ``sample``, ``time_s``
    and ``error_m``.

    ``curve``: ``draws``; ``draw``, the first one again; ``report``, where the report has a plot of the experiment.
    ``jobs``: number of cases at once. Raises `InputError` for fewer than two draws."""
    if count < 2:
        raise InputError(f"draws = {count}: expected at least two, for a band")
    parts = []
    found = Parallel(n_jobs=jobs, return_as="generator")(delayed(_draws_of)(case, count) for case in cases)
    for done, part in enumerate(found, 1):
        parts.append(part)
        if on_progress:
            on_progress(done / len(cases))
    return pd.concat(parts, ignore_index=True)


def _draws_of(case: ExperimentSettings, count: int) -> pd.DataFrame:
    """The rows of `draw_programs` of one case."""
    rows, plot, stamp_s = [], plot_of(case), np.zeros(0)
    for draw, (settings, flight, truth) in enumerate(experiment.draws(case, count)):
        found = experiment.estimate(settings, flight, truth).corrected
        stamp_s, error_m = found.stamp_s, position_error_m(found, truth.trajectory)
        sample = plot.sample_at(stamp_s) if plot else np.arange(len(stamp_s))
        logged = np.isfinite(sample)
        one = sample[logged], stamp_s[logged], error_m[logged]
        rows += [("draws", draw, *one)] + [("draw", draw, *one)] * (draw == 0)
    if plot:
        time_s, error_m = report_curve(plot, until_s=float(stamp_s[-1]) + 0.5)
        rows.append(("report", 0, plot.sample_at(time_s), time_s, error_m))
    named = {**case_of(case), "plot": plot.name if plot else ""}
    columns = ("curve", "draw", "sample", "time_s", "error_m")
    return pd.concat([pd.DataFrame({**named, **dict(zip(columns, row, strict=True))}) for row in rows])


BAND = (10, 90)
"""Percentiles of a band of draws."""
BAND_COLUMNS = (
    "mean_m", "mean_low_m", "mean_high_m", "max_m", "final_m", "report_mean_m", "report_max_m", "report_final_m",
    "share_below", "correlation",
)  # fmt: skip
"""Numbers of `band_table`."""


def band_table(drawn: pd.DataFrame) -> pd.DataFrame:
    """One row per case of `draw_programs`: the mean, largest and last error of the report's curve (``report_…``), their
    median over the draws, and the `BAND` of the means (``mean_low_m``, ``mean_high_m``).

    ``share_below``: share of the draws with a smaller mean than the report; ``correlation``: between the report's curve
    and the median of the draws at its samples; ``as_in_the_report``: the report's mean lies inside the band or within
    30 % of the median."""
    rows = []
    for case, part in drawn.groupby([*CASE_COLUMNS, "plot"], sort=False):
        curve = part[part["curve"] == "draws"].pivot(index="time_s", columns="draw", values="error_m")
        shown = part[part["curve"] == "report"]
        ours = np.array([np.interp(shown["time_s"], curve.index, curve[draw]) for draw in curve])
        if not len(shown):  # the report has no such plot: our own samples
            ours = curve.to_numpy().T
        means, middle, theirs = ours.mean(axis=1), np.median(ours, axis=0), shown["error_m"].to_numpy()
        low, high = np.percentile(means, BAND)
        row = dict(zip([*CASE_COLUMNS, "plot"], case, strict=True)) | {
            "draws": len(means), "mean_m": np.median(means), "mean_low_m": low, "mean_high_m": high,
            "max_m": np.median(ours.max(axis=1)), "final_m": np.median(ours[:, -1]),
        }  # fmt: skip
        if len(theirs):
            mean = theirs.mean()
            row |= {
                "report_mean_m": mean, "report_max_m": theirs.max(), "report_final_m": theirs[-1],
                "share_below": (means < mean).mean(), "correlation": np.corrcoef(middle, theirs)[0, 1],
                "as_in_the_report": low <= mean <= high or abs(mean / row["mean_m"] - 1) <= 0.3,
            }  # fmt: skip
        rows.append(row)
    return pd.DataFrame(rows).reindex(columns=[*CASE_COLUMNS, "plot", "draws", *BAND_COLUMNS, "as_in_the_report"])


def band_curves(drawn: pd.DataFrame) -> pd.DataFrame:
    """The band of each case of `draw_programs` over time, for plots of your own: ``low_m``, ``median_m`` and ``high_m``
    (`BAND`), and ``draw_m``, the first draw."""
    rows = drawn[drawn["curve"] == "draws"]
    by = [*CASE_COLUMNS, "plot", "sample", "time_s"]
    band = rows.groupby(by, sort=False)["error_m"].quantile([BAND[0] / 100, 0.5, BAND[1] / 100]).unstack()
    band.columns = pd.Index(["low_m", "median_m", "high_m"])
    first = rows[rows["draw"] == rows["draw"].min()].set_index(by)["error_m"].rename("draw_m")
    return band.join(first).reset_index()


def map_kind(settings: ExperimentSettings) -> str:
    """The kind of map of an odometry: ``weighted`` (means of all points), ``re-voxelised`` (the report's, which
    forgets), or ``bars``."""
    chosen = settings.odometry
    if isinstance(chosen, RegistrationSettings | LoamSettings):
        return "re-voxelised" if chosen.registration.map == "re-voxelised" else "weighted"
    return "re-voxelised" if isinstance(chosen, ReportCloudSettings) else "bars"


def table(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """One row per run: its case, then its metrics."""
    return pd.DataFrame([{**case_of(result.settings), **result.metrics} for result in results])


def cloud_table(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """`table` with each run's kind of map, number of scans, and share of later scans without correspondences."""
    rows = table(results)
    rows.insert(list(rows).index("method") + 1, "map", [map_kind(result.settings) for result in results])
    rows["scans"] = [len(result.corrected) for result in results]
    rows["unused_share"] = [float((result.matches[1:] == 0).mean()) for result in results]
    return rows


def report_table(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """`cloud_table` with the mean, maximum and last error (m) of the corrected curve in the report's plot of the same
    experiment, up to the end of the run: ``report_mean_m``, ``report_max_m``, ``report_final_m``. NaN without a plot.
    """
    none = np.array([0.0]), np.array([np.nan])
    errors = [_reported(result).get("report", none)[1] for result in results]
    columns = ["report_mean_m", "report_max_m", "report_final_m"]
    numbers = pd.DataFrame([(error.mean(), error.max(), error[-1]) for error in errors], columns=columns)
    return cloud_table(results).join(numbers)


def _reported(result: experiment.Result) -> dict[str, tuple[Array, Array]]:
    """The curves ``report-drift`` and ``report`` of the report's plot of a run, to half a second after its end."""
    plot, end_s = plot_of(result.settings), float(result.corrected.stamp_s[-1]) + 0.5
    if plot is None:
        return {}
    return {"report-drift": report_curve(plot, "drift", end_s), "report": report_curve(plot, until_s=end_s)}


def curves(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """Errors over time in long form, one row per sample: the columns of `case_of`, ``curve``, ``time_s``, ``error_m``.

    Each run has a ``curve`` with the name of its method, and ``none``, its drift. If the report has a plot of the same
    experiment (`plot_of`), the curves ``report`` and ``report-drift`` of that plot are added.
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
    """The points of each run at its estimated and at the true poses (`paired_clouds`). Flights are simulated again; a
    flight that several runs share, once."""
    settings = {experiment.world(result.settings): result.settings for result in results}
    flights = {world: experiment.simulate(one)[0] for world, one in settings.items()}
    return [paired_clouds(flights[experiment.world(result.settings)], result) for result in results]


def bends(clouds: Iterable[tuple[Array, Array]], tower: Tower) -> pd.DataFrame:
    """Bend of each pair of `clouds`, one row per pair: `metrics.bend` about the vertical axis of a tower."""
    axis = tower.vertices[:, :2].mean(axis=0)
    return pd.DataFrame([bend(*pair, axis) for pair in clouds])


def metrics(results: Sequence[experiment.Result], by: Sequence[str] = ("noise", "method")) -> dict[str, float]:
    """The finite metrics of all runs as a flat dictionary with the keys ``<values of by>.<metric>``."""
    return {f"{_name(r.settings, by)}.{k}": v for r in results for k, v in r.metrics.items() if np.isfinite(v)}


def provenance(results: Sequence[experiment.Result], by: Sequence[str] = ("noise", "method")) -> dict[str, Any]:
    """The settings of all runs, with the keys ``<values of by>``."""
    return {_name(result.settings, by): result.settings.model_dump() for result in results}


def _name(settings: ExperimentSettings, by: Sequence[str]) -> str:
    case = {**case_of(settings), "map": map_kind(settings)}
    return ".".join(str(case[name]) for name in by)


def timing(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """Milliseconds per frame (median and 95th percentile) of each run: of every stage, and of the whole frame."""
    return pd.DataFrame(
        {**case_of(result.settings), "stage": stage, **times}
        for result in results
        for stage, times in stage_times(result).items()
    )


def flat(
    rows: pd.DataFrame, by: Sequence[str] = (), columns: Sequence[str] | None = None, prefix: str = ""
) -> dict[str, float]:
    """The finite numbers of a table as a flat dictionary with the keys ``<prefix><values of by>.<column>``. Without
    ``by``, the index stands in for the values."""
    keys = rows[list(by)].astype(str).agg(".".join, axis=1) if by and len(rows) else rows.index.astype(str)
    wanted = [name for name in rows if name not in by] if columns is None else columns
    named = {f"{prefix}{key}.{name}": rows[name].iloc[k] for k, key in enumerate(keys) for name in wanted}
    return {name: float(value) for name, value in named.items() if np.isfinite(value)}
