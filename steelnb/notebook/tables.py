"""Tables of runs: the columns that name a case, and one row per run."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.settings import ExperimentSettings, LoamSettings, RegistrationSettings, ReportCloudSettings

CASE_COLUMNS = ("trajectory", "noise", "method", "sensor", "seed")
"""The columns of `case_of`."""
CLOUD_CASE = ("trajectory", "noise", "method", "map")
"""Columns that identify a run of a point-cloud odometry."""


def case_of(settings: ExperimentSettings) -> dict[str, Any]:
    """The columns that name a run in tables."""
    return {
        "trajectory": settings.flight.trajectory,
        "noise": settings.noise_name,
        "method": settings.odometry.method,
        "sensor": settings.sensor,
        "seed": settings.seed,
    }


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


def metrics(results: Sequence[experiment.Result], by: Sequence[str] = ("noise", "method")) -> dict[str, float]:
    """The finite metrics of all runs as a flat dictionary with the keys ``<values of by>.<metric>``."""
    return {f"{_name(r.settings, by)}.{k}": v for r in results for k, v in r.metrics.items() if np.isfinite(v)}


def provenance(results: Sequence[experiment.Result], by: Sequence[str] = ("noise", "method")) -> dict[str, Any]:
    """The settings of all runs, with the keys ``<values of by>``."""
    return {_name(result.settings, by): result.settings.model_dump() for result in results}


def _name(settings: ExperimentSettings, by: Sequence[str]) -> str:
    case = {**case_of(settings), "map": map_kind(settings)}
    return ".".join(str(case[name]) for name in by)


def stage_times(result: experiment.Result) -> dict[str, dict[str, float]]:
    """``median_ms`` and ``p95_ms`` (95th percentile) of the time per scan, for each stage and the whole ``frame``."""
    stages = {**result.seconds, "frame": np.sum(list(result.seconds.values()), axis=0)}
    times = {stage: np.percentile(1e3 * seconds, [50, 95]) for stage, seconds in stages.items()}
    return {stage: {"median_ms": float(median), "p95_ms": float(p95)} for stage, (median, p95) in times.items()}


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
