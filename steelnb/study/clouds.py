"""Tables of the odometry by clouds: methods, the report's ranking, the bend of the clouds built."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.config import (
    CloudSettings,
    ExperimentSettings,
)
from steelnb.datatypes import Array, Flight
from steelnb.metrics import Bend
from steelnb.preprocess import preprocess_scan
from steelnb.simulation import Truth
from steelnb.study.runs import case_of, share, table, timing


def run_all(
    cases: Sequence[ExperimentSettings], on_progress: Callable[[float], None] | None = None
) -> list[experiment.Result]:
    """A result for each case, in their order; cases on one flight share its simulation. Raises `CollisionError`."""
    results: dict[int, experiment.Result] = {}
    worlds: dict[str, list[int]] = {}
    for k, case in enumerate(cases):
        worlds.setdefault(str((case.tower, case.flight, case.tof, case.seed)), []).append(k)
    for members in worlds.values():
        flight, truth = experiment.simulate(cases[members[0]])
        for k in members:
            within = None if on_progress is None else share(on_progress, len(results), len(cases))
            results[k] = experiment.estimate(cases[k], experiment.redrift(cases[k], flight, truth), truth, within)
    return [results[k] for k in range(len(cases))]


def map_kind(settings: ExperimentSettings) -> str:
    """How the map of an odometry averages: ``weighted`` (all points alike), ``re-voxelised`` (the report's, which
    forgets), or ``bars``."""
    if not isinstance(settings.odometry, CloudSettings):
        return "bars"
    return "weighted" if settings.odometry.remember else "re-voxelised"


def cloud_table(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """`table` with the kind of map of each run, its scans, and the share of those that corrected nothing."""
    rows = table(results)
    rows.insert(list(rows.columns).index("method") + 1, "map", [map_kind(result.settings) for result in results])
    rows["scans"] = [len(result.corrected) for result in results]
    rows["unused_share"] = [float((result.matches[1:] == 0).mean()) for result in results]
    return rows


def cloud_timing(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """`timing` with the kind of map of each run."""
    return timing(results).assign(map=[map_kind(r.settings) for r in results for _ in (*r.seconds, "frame")])


def cloud_metrics(results: Sequence[experiment.Result]) -> dict[str, float]:
    """The finite numbers of all runs in one flat map, ``<trajectory>.<noise>.<method>.<map>.<metric>``."""
    return {f"{_full_name(r.settings)}.{k}": v for r in results for k, v in r.metrics.items() if np.isfinite(v)}


def cloud_provenance(results: Sequence[experiment.Result]) -> dict[str, Any]:
    """The settings of all runs, by ``<trajectory>.<noise>.<method>.<map>``."""
    return {_full_name(result.settings): result.settings.model_dump() for result in results}


def _full_name(settings: ExperimentSettings) -> str:
    case = case_of(settings)
    return ".".join([case["trajectory"], case["noise"], case["method"], map_kind(settings)])


def ranking(rows: pd.DataFrame, methods: Sequence[str], by: str = "error_mean_m") -> pd.DataFrame:
    """The order of some methods, a row for each flight and noise.

    ``rows`` has a row a run; columns are the value of each method, ``order`` from best to worst, ``as_claimed``,
    whether each of ``methods`` is better than the one before it, and ``pairs_as_claimed`` of all pairs, 0 to 1.
    """
    chosen = rows[rows["method"].isin(methods)].drop_duplicates(["trajectory", "noise", "method"])
    wide = chosen.pivot_table(index=["trajectory", "noise"], columns="method", values=by, sort=False)[list(methods)]
    pairs = list(itertools.combinations(methods, 2))
    agree = np.mean([wide[later] < wide[earlier] for earlier, later in pairs], axis=0)
    order = [" < ".join(wide.columns[np.argsort(values)]) for values in wide.to_numpy()]
    return wide.assign(order=order, as_claimed=agree == 1.0, pairs_as_claimed=agree).reset_index()


def beside_report(rows: pd.DataFrame, seen: dict[str, dict[str, tuple[float, float]]]) -> pd.DataFrame:
    """The corrected error of each run next to the range (low, high) that a figure of the report shows.

    ``seen`` maps method → flight → range; runs that it does not name are left out, as are repeated ones.
    """
    chosen = rows.drop_duplicates(["trajectory", "noise", "method"])
    result = chosen[["trajectory", "noise", "method", "error_mean_m", "error_max_m", "error_final_m"]].copy()
    for column, k in (("report_low_m", 0), ("report_high_m", 1)):
        result[column] = [
            seen.get(method, {}).get(flight, (np.nan, np.nan))[k]
            for method, flight in zip(result["method"], result["trajectory"], strict=True)
        ]
    result["within_report"] = result["error_max_m"] <= result["report_high_m"]
    return result.dropna().reset_index(drop=True)


def time_ratio(times: pd.DataFrame, method: str, to: str) -> pd.DataFrame:
    """Median milliseconds of a frame of two methods and their ratio, a row for each flight and noise."""
    frames = times[times["stage"] == "frame"].drop_duplicates(["trajectory", "noise", "method"])
    wide = frames.pivot_table(index=["trajectory", "noise"], columns="method", values="median_ms", sort=False)
    return wide[[to, method]].assign(ratio=wide[method] / wide[to]).reset_index()


def paired_clouds(flight: Flight, result: experiment.Result, every: int = 4) -> tuple[Array, Array]:
    """Every so many scans of a flight placed at the poses of a run and at the true ones: two clouds ``(N, 3)``, in
    which row k is the same return."""
    true = result.truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    built: list[Array] = []
    real: list[Array] = []
    for k in range(0, len(flight.scans), every):
        points = preprocess_scan(flight.scans[k], true[k], flight.T_drone_sensor, result.settings.preprocess)
        for T, cloud in ((result.corrected.T_world_drone[k], built), (true[k], real)):
            cloud.append(points @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(built), np.concatenate(real)


def bend_table(bends: dict[str, tuple[ExperimentSettings, Bend]], axis: Array) -> pd.DataFrame:
    """One row a run and slice of height: tilt, turn, offset on the vertical through ``axis``, blur and points."""
    rows = []
    for settings, fit in bends.values():
        offset = np.linalg.norm(fit.offset_m(axis), axis=1)
        for k, height in enumerate(fit.height_m):
            rows.append(
                {
                    **case_of(settings),
                    "height_m": height,
                    "tilt_deg": fit.tilt_deg[k],
                    "yaw_deg": fit.yaw_deg[k],
                    "offset_m": offset[k],
                    "blur_m": fit.blur_m[k],
                    "points": int(fit.count[k]),
                }
            )
    return pd.DataFrame(rows)


def bend_summary(bends: dict[str, Bend], results: dict[str, experiment.Result], axis: Array) -> pd.DataFrame:
    """One row a method: the numbers of `Bend.metrics` and the errors of the trajectory."""
    return pd.DataFrame(
        {name: {**fit.metrics(axis), "ate_rmse_m": results[name].metrics["ate_rmse_m"]} for name, fit in bends.items()}
    ).T


def flat(rows: pd.DataFrame) -> dict[str, float]:
    """A table of numbers as one flat map ``<index>.<column>``, the finite ones only."""
    named = {f"{index}.{column}": rows[column][index] for index in rows.index for column in rows.columns}
    return {name: float(value) for name, value in named.items() if np.isfinite(value)}


def fly_again(result: experiment.Result) -> tuple[Flight, Truth]:
    """The flight and truth that a result came from, simulated once more."""
    flight, truth = experiment.simulate(result.settings)
    return flight, truth
