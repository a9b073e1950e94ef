"""Runs that share a flight or repeat it over seeds, and the tables of their numbers."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.config import (
    ExperimentSettings,
    MethodName,
    SensorName,
    TrajectoryName,
)


def compare(
    trajectory: TrajectoryName,
    sensor: SensorName,
    noise: Sequence[str],
    method: Sequence[MethodName],
    seed: int,
    duration_s: float,
    overrides: dict[str, Any] | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> list[experiment.Result]:
    """Every noise × every method on one flight, which is simulated once. Raises `SettingsError`."""
    cases = [
        ExperimentSettings.preset(
            trajectory, each, sensor=sensor, seed=seed, duration_s=duration_s, overrides=overrides, method=name
        )
        for each in noise
        for name in method
    ]
    flight, truth = experiment.simulate(cases[0])
    results = []
    for k, case in enumerate(cases):
        within = None if on_progress is None else share(on_progress, k, len(cases))
        results.append(experiment.estimate(case, experiment.redrift(case, flight, truth), truth, within))
    return results


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Mean, worst and number of seeds of ``ate_rmse_m`` for each case and method, and of what lies outside gaps."""
    named = {"seeds": ("seed", "count"), "ate_mean_m": ("ate_rmse_m", "mean"), "ate_worst_m": ("ate_rmse_m", "max")}
    if "ate_outside_gaps_rmse_m" in runs:
        named["outside_gaps_mean_m"] = ("ate_outside_gaps_rmse_m", "mean")
        named["outside_gaps_worst_m"] = ("ate_outside_gaps_rmse_m", "max")
        named["after_gaps_worst_m"] = ("error_after_gaps_max_m", "max")
    return runs.groupby(["case", "method"], sort=False).agg(**named).reset_index()


def summary_metrics(summary: pd.DataFrame) -> dict[str, float]:
    """The finite numbers of `summarise` in one flat map, ``<case>.<method>.<metric>``."""
    return {
        f"{row['case']}.{row['method']}.{name}": float(value)
        for row in summary.to_dict("records")
        for name, value in row.items()
        if name not in ("case", "method") and np.isfinite(value)
    }


def share(on_progress: Callable[[float], None], k: int, total: int) -> Callable[[float], None]:
    return lambda fraction: on_progress((k + fraction) / total)


def table(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """One row a run: what it was run with, then its numbers."""
    return pd.DataFrame([{**case_of(result.settings), **result.metrics} for result in results])


def metrics(results: Sequence[experiment.Result]) -> dict[str, float]:
    """The finite numbers of all runs in one flat map, ``<noise>.<method>.<metric>``."""
    return {
        f"{result.settings.noise_name}.{result.settings.odometry.method}.{name}": value
        for result in results
        for name, value in result.metrics.items()
        if np.isfinite(value)
    }


def timing(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """Milliseconds a frame, median and 95th percentile, for each run and stage and for the whole frame."""
    rows = []
    for result in results:
        whole = np.sum(list(result.seconds.values()), axis=0)
        for stage, seconds in {**result.seconds, "frame": whole}.items():
            median, p95 = np.percentile(seconds * 1e3, [50, 95])
            rows.append({**case_of(result.settings), "stage": stage, "median_ms": median, "p95_ms": p95})
    return pd.DataFrame(rows)


def provenance(results: Sequence[experiment.Result]) -> dict[str, Any]:
    """The settings of all runs, by ``<noise>.<method>``."""
    return {
        f"{result.settings.noise_name}.{result.settings.odometry.method}": result.settings.model_dump()
        for result in results
    }


def case_of(settings: ExperimentSettings) -> dict[str, Any]:
    return {
        "trajectory": settings.flight.trajectory,
        "noise": settings.noise_name,
        "method": settings.odometry.method,
        "sensor": settings.sensor,
        "seed": settings.seed,
    }
