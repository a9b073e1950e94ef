"""Several experiments that share flights, and the tables of their numbers."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.metrics import largest_slip, position_error_m
from steelnb.settings import ExperimentSettings, TrajectoryName
from steelnb.study.row import WRONG_M

Progress = Callable[[float], None]
CLOUD_CASE = ("trajectory", "noise", "method", "map")
"""Columns that name a run of an odometry by clouds."""


def make_cases(
    trajectory: Sequence[TrajectoryName],
    sensor: str,
    noise: Sequence[str],
    method: Iterable[str | tuple[str, dict[str, Any]]],
    seed: int,
    duration_s: float,
    overrides: dict[str, Any] | None = None,
) -> list[ExperimentSettings]:
    """Settings of every flight × noise × method; a method may come with its overrides. Raises `SettingsError`."""
    wanted: list[Any] = [(each, {}) if isinstance(each, str) else each for each in method]
    return [
        ExperimentSettings.preset(
            flight,
            each,
            sensor=sensor,
            seed=seed,
            duration_s=duration_s,
            overrides={**(overrides or {}), **changes},
            method=name,
        )
        for flight in trajectory
        for each in noise
        for name, changes in wanted
    ]


def run_all(cases: Sequence[ExperimentSettings], on_progress: Progress | None = None) -> list[experiment.Result]:
    """A result for each case, in their order; cases on one flight share its simulation. Raises `CollisionError`."""
    results: dict[int, experiment.Result] = {}
    flights: dict[str, list[int]] = {}
    for k, case in enumerate(cases):
        flights.setdefault(str((case.tower, case.flight, case.tof, case.seed)), []).append(k)
    for members in flights.values():
        flight, truth = experiment.simulate(cases[members[0]])
        for k in members:
            within = share_of(on_progress, len(results), len(cases))
            results[k] = experiment.estimate(cases[k], experiment.redrift(cases[k], flight, truth), truth, within)
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


def map_kind(settings: ExperimentSettings) -> str:
    """The map of an odometry: ``weighted`` (means of all points), ``re-voxelised`` (the report's, which forgets), or
    ``bars``."""
    if settings.odometry.clouds is None:
        return "bars"
    return "weighted" if settings.odometry.clouds.accumulate else "re-voxelised"


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


def metrics(results: Sequence[experiment.Result], by: Sequence[str] = ("noise", "method")) -> dict[str, float]:
    """The finite numbers of all runs in one flat map, ``<values of by>.<metric>``."""
    return {f"{_name(r.settings, by)}.{k}": v for r in results for k, v in r.metrics.items() if np.isfinite(v)}


def provenance(results: Sequence[experiment.Result], by: Sequence[str] = ("noise", "method")) -> dict[str, Any]:
    """The settings of all runs, by ``<values of by>``."""
    return {_name(result.settings, by): result.settings.model_dump() for result in results}


def _name(settings: ExperimentSettings, by: Sequence[str]) -> str:
    case = {**case_of(settings), "map": map_kind(settings)}
    return ".".join(case[name] for name in by)


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


def find_slips(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """False convergence in flight, a row a run.

    ``wrong_share`` of the scans that had pairs ended farther than `WRONG_M` from the truth; ``slip_m`` is the largest
    growth of the error within a second over such scans, at ``slip_s``.
    """
    rows = []
    for result in results:
        settings = result.settings
        error = position_error_m(result.corrected, result.truth.trajectory)
        paired = result.matches > 0
        scan, slip = largest_slip(error, max(1, round(settings.tof.rate_hz)))
        rows.append(
            {
                **case_of(settings),
                "max_correspondence_m": getattr(settings.odometry.clouds, "max_correspondence_m", np.nan),
                "blind_s": sum(last - first for first, last in settings.tof.blind_s),
                "ate_rmse_m": result.metrics["ate_rmse_m"],
                "error_final_m": result.metrics["error_final_m"],
                "wrong_share": float((error[paired] > WRONG_M).mean()) if paired.any() else 0.0,
                "slip_m": slip,
                "slip_s": float(result.corrected.stamp_s[scan]),
            }
        )
    return pd.DataFrame(rows)
