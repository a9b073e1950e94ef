"""Several experiments that share flights, the tables of their numbers, and what the report shows of the same."""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment, rng
from steelnb.errors import InputError
from steelnb.metrics import Bend
from steelnb.odometry import shared_segments
from steelnb.results import find_root
from steelnb.settings import (
    REPORT_NOISE,
    ExperimentSettings,
    LoamSettings,
    Noise,
    RegistrationSettings,
    ReportCloudSettings,
    TrajectoryName,
)
from steelnb.settings.report_plots import STEP_S, ReportPlot, read_report_plots
from steelnb.types import Array

Progress = Callable[[float], None]
CLOUD_CASE = ("trajectory", "noise", "method", "map")
"""Columns that name a run of an odometry by clouds."""

REPORT_FLIGHTS = {"vertical": ("vertical", "zigzag"), "orbit": ("orbit", "orbit-3.3", "loops")}
"""The report's two flights, and the presets that are compared with each."""
REPORT_FIGURE = {"vertical": "3_2", "orbit": "3_3", "random-walk": "3_5", "constant-drift": "3_6"}
"""The report's figure of segment odometry on a flight, and of odometry by clouds under a noise, as files are named."""
REPORT_CURVES = Path("notebooks", "report-curves.csv")
"""The curves of the report's plots, read off its PDF, below the root of the project."""


@cache
def _report_curves() -> pd.DataFrame:
    return pd.read_csv(find_root() / REPORT_CURVES, dtype={"figure": str})


def report_curve(plot: ReportPlot, curve: str = "corrected") -> tuple[Array, Array]:
    """Times (s) and errors (m), each ``(N,)``, of the curve ``corrected`` or ``drift`` of one of the report's plots,
    without the samples of an earlier run."""
    rows = _report_curves()
    case = (rows["figure"] == plot.figure) & (rows["trajectory"] == plot.trajectory) & (rows["method"] == plot.method)
    rows = rows[case & (rows["curve"] == curve) & (rows["step"] >= plot.earlier_samples)]
    return plot.step_at(rows["step"].to_numpy()) * STEP_S, rows["error_m"].to_numpy()


def plot_of(settings: ExperimentSettings) -> ReportPlot | None:
    """The report's plot whose flight, noise and rate of samples an experiment has, or None."""
    wanted = (settings.flight.trajectory, settings.noise_name, settings.tof.rate_hz)
    plots = ((plot.flight or plot.trajectory, plot.noise, plot.rate_hz) for plot in read_report_plots())
    return next((plot for plot, own in zip(read_report_plots(), plots, strict=True) if own == wanted), None)


def report_range(noise: str, method: str, trajectory: str) -> tuple[float, float] | None:
    """Smallest and largest corrected error (m) that the report shows of a method under a noise, on the flight of its
    own that is compared with a trajectory; None where it shows none."""
    for plot in read_report_plots():
        if (plot.noise, plot.method) == (noise, method) and trajectory in REPORT_FLIGHTS[plot.trajectory]:
            error = report_curve(plot)[1]
            return float(error.min()), float(error.max())
    return None


def at_level(noise: str, level: float) -> str:
    """A noise whose levels, the report's where it names none, are multiplied by ``level``. Raises `InputError`."""
    Noise.parse(noise)
    if noise == "none" or level == 1:
        return noise
    parts = (part.strip().partition(":") for part in noise.split("+"))
    scaled = "+".join(f"{name}:{level * float(given or REPORT_NOISE[name][1]):g}" for name, _, given in parts)
    Noise.parse(scaled)
    return scaled


def make_cases(
    trajectory: Sequence[TrajectoryName],
    sensor: str,
    noise: Sequence[str],
    method: Iterable[str | tuple[str, dict[str, Any]]],
    seed: rng.Seed,
    duration_s: float | None,
    overrides: dict[str, Any] | None = None,
) -> list[ExperimentSettings]:
    """Settings of every flight × noise × method; a method may come with its overrides. Raises `InputError`."""
    wanted: list[Any] = [(each, {}) if isinstance(each, str) else each for each in method]
    given: dict[str, Any] = {"sensor": sensor, "seed": seed, "duration_s": duration_s}
    return [
        ExperimentSettings.preset(flight, each, overrides={**(overrides or {}), **changes}, method=name, **given)
        for flight, each, (name, changes) in itertools.product(trajectory, noise, wanted)
    ]


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


def run_all(
    cases: Sequence[ExperimentSettings],
    on_progress: Progress | None = None,
    on_run: Callable[[list[experiment.Result]], object] | None = None,
) -> list[experiment.Result]:
    """A result for each case, in their order; cases on one flight share its simulation. Raises `CollisionError`.

    ``on_run`` is called after every run with the results that are there.
    """
    results: dict[int, experiment.Result] = {}
    flights: dict[str, list[int]] = {}
    for k, case in enumerate(cases):
        flights.setdefault(str((case.tower, case.flight, case.tof, case.seed)), []).append(k)
    for members in flights.values():
        flight, truth = experiment.simulate(cases[members[0]])
        with shared_segments():
            for k in members:
                within = share_of(on_progress, len(results), len(cases))
                results[k] = experiment.estimate(cases[k], experiment.redrift(cases[k], flight, truth), truth, within)
                if on_run:
                    on_run([results[done] for done in sorted(results)])
    return [results[k] for k in range(len(cases))]


def share_of(on_progress: Progress | None, k: int, total: int) -> Progress | None:
    """The progress of part ``k`` of ``total`` as a share of the whole."""
    return None if on_progress is None else lambda fraction: on_progress((k + fraction) / total)


def case_of(settings: ExperimentSettings) -> dict[str, Any]:
    """The columns that name a run in tables."""
    return {
        "trajectory": settings.flight.trajectory,
        "noise": settings.noise_name,
        "method": settings.odometry.method,
        "sensor": settings.sensor,
        "seed": settings.seed,
    }


def caption(cases: pd.DataFrame | Sequence[experiment.Result]) -> str:
    """The flights, noises, sensors and towers of some runs, or of rows of a table with these columns, and its seeds:
    ``loops, zigzag flight, random-walk, sensor report-4cm, seed 1``; more seeds than one are counted."""
    rows = cases if isinstance(cases, pd.DataFrame) else pd.DataFrame([case_of(result.settings) for result in cases])
    named = {"trajectory": "{} flight", "noise": "{}", "tower": "tower {}", "sensor": "sensor {}"}
    parts = [text.format(", ".join(rows[name].unique())) for name, text in named.items() if name in rows]
    return ", ".join([*parts, seeds_text(rows["seed"])])


def seeds_text(seeds: Iterable[rng.Seed]) -> str:
    """The only one of some seeds, or their number."""
    different = set(seeds)
    return f"seed {different.pop()}" if len(different) == 1 else f"{len(different)} seeds"


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
    numbers = []
    for result in results:
        plot, error = plot_of(result.settings), np.array([np.nan])
        if plot:
            time_s, error = report_curve(plot)
            error = error[time_s <= result.corrected.stamp_s[-1] + 2 / plot.rate_hz]
        numbers.append((error.mean(), error.max(), error[-1]))
    columns = ["report_mean_m", "report_max_m", "report_final_m"]
    return cloud_table(results).join(pd.DataFrame(numbers, columns=columns))


def metrics(results: Sequence[experiment.Result], by: Sequence[str] = ("noise", "method")) -> dict[str, float]:
    """The finite numbers of all runs in one flat map, ``<values of by>.<metric>``."""
    return {f"{_name(r.settings, by)}.{k}": v for r in results for k, v in r.metrics.items() if np.isfinite(v)}


def provenance(results: Sequence[experiment.Result], by: Sequence[str] = ("noise", "method")) -> dict[str, Any]:
    """The settings of all runs, by ``<values of by>``."""
    return {_name(result.settings, by): result.settings.model_dump() for result in results}


def _name(settings: ExperimentSettings, by: Sequence[str]) -> str:
    case = {**case_of(settings), "map": map_kind(settings)}
    return ".".join(str(case[name]) for name in by)


def timing(results: Sequence[experiment.Result], with_map: bool = False) -> pd.DataFrame:
    """Milliseconds a frame, median and 95th percentile, for each run and stage and for the whole frame."""
    rows = []
    for result in results:
        whole = np.sum(list(result.seconds.values()), axis=0)
        kind = {"map": map_kind(result.settings)} if with_map else {}
        for stage, seconds in {**result.seconds, "frame": whole}.items():
            median, p95 = np.percentile(seconds * 1e3, [50, 95])
            rows.append({**case_of(result.settings), "stage": stage, "median_ms": median, "p95_ms": p95, **kind})
    return pd.DataFrame(rows)


def flat(rows: pd.DataFrame, by: Sequence[str] = (), columns: Sequence[str] | None = None) -> dict[str, float]:
    """The finite numbers of a table in one flat map ``<values of by>.<column>``, named by its index without ``by``."""
    keys = rows[list(by)].astype(str).agg(".".join, axis=1) if by and len(rows) else rows.index.astype(str)
    wanted = [name for name in rows if name not in by] if columns is None else columns
    named = {f"{key}.{name}": rows[name].iloc[k] for k, key in enumerate(keys) for name in wanted}
    return {name: float(value) for name, value in named.items() if np.isfinite(value)}


def ranking(rows: pd.DataFrame, methods: Sequence[str]) -> pd.DataFrame:
    """The order of some methods by their mean error, a row for each flight and noise.

    ``rows`` has a row a run; columns are the error of each method, ``order`` from best to worst, ``as_claimed``,
    whether each of ``methods`` is better than the one before it, and ``pairs_as_claimed`` of all pairs, 0 to 1.
    """
    chosen = rows[rows["method"].isin(methods)].drop_duplicates(["trajectory", "noise", "method"])
    wide = chosen.pivot_table("error_mean_m", ["trajectory", "noise"], "method", sort=False)[list(methods)]
    pairs = list(itertools.combinations(methods, 2))
    agree = np.mean([wide[later] < wide[earlier] for earlier, later in pairs], axis=0)
    order = [" < ".join(wide.columns[np.argsort(values)]) for values in wide.to_numpy()]
    return wide.assign(order=order, as_claimed=agree == 1.0, pairs_as_claimed=agree).reset_index()


def bend_table(results: Mapping[str, experiment.Result], bends: Mapping[str, Bend], axis: Array) -> pd.DataFrame:
    """One row a run and slice of height: tilt, turn, offset on the vertical through ``axis (2,)``, blur and points."""
    slices = [
        pd.DataFrame(
            {
                **case_of(results[name].settings),
                "height_m": fit.height_m,
                "tilt_deg": fit.tilt_deg,
                "yaw_deg": fit.yaw_deg,
                "offset_m": np.linalg.norm(fit.offset_m(axis), axis=1),
                "blur_m": fit.blur_m,
                "points": fit.count,
            }
        )
        for name, fit in bends.items()
    ]
    return pd.concat(slices, ignore_index=True)


def bend_summary(results: Mapping[str, experiment.Result], bends: Mapping[str, Bend], axis: Array) -> pd.DataFrame:
    """One row a method: the numbers of `Bend.metrics`, and the error of the trajectory, ``ate_rmse_m``."""
    numbers = {name: fit.metrics(axis) for name, fit in bends.items()}
    return pd.DataFrame(numbers).T.assign(ate_rmse_m=[results[name].metrics["ate_rmse_m"] for name in bends])
