"""Many experiments: run what a comparison needs once, and put the numbers into tables."""

import copy
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.config import (
    TRAJECTORIES,
    CloudSettings,
    ExperimentSettings,
    MethodName,
    NoiseSettings,
    SensorName,
    TrajectoryName,
)
from steelnb.datatypes import Array, Flight, Trajectory
from steelnb.metrics import Bend, basin_radius_m, largest_slip, position_error_m
from steelnb.noise import drifting, random_walk_rms_m
from steelnb.odometry import CloudOdometry
from steelnb.preprocess import preprocess_scan
from steelnb.simulation import Truth

RATE_HZ = 125.0


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
        within = None if on_progress is None else _share(on_progress, k, len(cases))
        results.append(experiment.estimate(case, experiment.redrift(case, flight, truth), truth, within))
    return results


def over_seeds(
    trajectory: TrajectoryName,
    sensor: SensorName,
    noise: Sequence[str],
    method: Sequence[MethodName],
    seeds: Sequence[int],
    duration_s: float,
    blind_s: Sequence[Sequence[float]] = (),
    overrides: dict[str, Any] | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """`compare` for many seeds: its tables of runs and of times, one seed after the other, and nothing else is kept.

    The column ``case`` is the noise; where ``blind_s`` names intervals (from, to), the last noise is flown once more
    without any return in them, as ``<noise>, blind``.
    """
    gaps = {"tof.blind_s": [list(interval) for interval in blind_s]}
    flights: list[tuple[str, Sequence[str], dict[str, Any]]] = [("", noise, {})]
    if blind_s:
        flights.append((", blind", noise[-1:], gaps))
    tables, times = [], []
    for k, seed in enumerate(seeds):
        for j, (suffix, some, extra) in enumerate(flights):
            within = _share(on_progress, k * len(flights) + j, len(seeds) * len(flights)) if on_progress else None
            runs = compare(trajectory, sensor, some, method, seed, duration_s, {**(overrides or {}), **extra}, within)
            rows = table(runs)
            tables.append(rows.assign(case=rows["noise"] + suffix))
            times.append(timing(runs))
    return pd.concat(tables, ignore_index=True), pd.concat(times, ignore_index=True)


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


def _share(on_progress: Callable[[float], None], k: int, total: int) -> Callable[[float], None]:
    return lambda fraction: on_progress((k + fraction) / total)


def table(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """One row a run: what it was run with, then its numbers."""
    return pd.DataFrame([{**_case(result.settings), **result.metrics} for result in results])


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
            rows.append({**_case(result.settings), "stage": stage, "median_ms": median, "p95_ms": p95})
    return pd.DataFrame(rows)


def provenance(results: Sequence[experiment.Result]) -> dict[str, Any]:
    """The settings of all runs, by ``<noise>.<method>``."""
    return {
        f"{result.settings.noise_name}.{result.settings.odometry.method}": result.settings.model_dump()
        for result in results
    }


def _case(settings: ExperimentSettings) -> dict[str, Any]:
    return {
        "trajectory": settings.flight.trajectory,
        "noise": settings.noise_name,
        "method": settings.odometry.method,
        "sensor": settings.sensor,
        "seed": settings.seed,
    }


def fly_all(
    seed: int,
    duration_s: float,
    overrides: dict[str, Any] | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> dict[str, tuple[Flight, Truth]]:
    """Both of the report's flights with the report's sensor, by name."""
    flights: dict[str, tuple[Flight, Truth]] = {}
    for k, name in enumerate(TRAJECTORIES):
        settings = ExperimentSettings.preset(
            name, sensor="report", seed=seed, duration_s=duration_s, overrides=overrides
        )
        flights[name] = experiment.simulate(settings)
        if on_progress:
            _share(on_progress, k, len(TRAJECTORIES))(1.0)
    return flights


def flight_table(flights: dict[str, tuple[Flight, Truth]]) -> pd.DataFrame:
    """One row a flight: how far, how fast, how tilted, and what its sensor saw."""
    rows = []
    for name, (flight, truth) in flights.items():
        position, rotation = truth.trajectory.position, truth.trajectory.T_world_drone[:, :3, :3]
        tilt = np.arccos(np.clip(rotation[:, 2, 2], -1, 1))
        returns = np.array([np.isfinite(scan.points[..., 0]).sum() for scan in flight.scans])
        travelled = np.linalg.norm(np.diff(position, axis=0), axis=1).sum()
        rows.append(
            {
                "trajectory": name,
                "duration_s": truth.trajectory.stamp_s[-1],
                "length_m": travelled,
                "speed_mean_m_s": travelled / truth.trajectory.stamp_s[-1],
                "height_min_m": position[:, 2].min(),
                "height_max_m": position[:, 2].max(),
                "tilt_rms_deg": np.degrees(np.sqrt((tilt**2).mean())),
                "scans": len(flight.scans),
                "returns_median": float(np.median(returns)),
                "returns_min": int(returns.min()),
                "members_seen": int((truth.member_hits >= 100).sum()),
            }
        )
    return pd.DataFrame(rows)


def drift_curves(noise: str, seeds: Sequence[int], duration_s: float) -> tuple[Array, Array]:
    """Drift of many seeds without flying: stamps ``(N,)`` at 125 Hz and errors ``(S, N)``.

    Drift does not depend on the flight, so a drone that stays where it is will do. Errors are of the position in
    metres or, where the noise has none, of the heading in radians.
    """
    settings = NoiseSettings.parse(noise)
    stamp = np.arange(round(duration_s * RATE_HZ) + 1) / RATE_HZ
    still = Trajectory(stamp, np.tile(np.eye(4), (len(stamp), 1, 1)))
    errors = np.empty((len(seeds), len(stamp)))
    for k, seed in enumerate(seeds):
        T = drifting(still, settings, seed).T_world_drone
        heading = np.unwrap(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
        errors[k] = np.abs(heading) if _turns_only(settings) else np.linalg.norm(T[:, :3, 3], axis=1)
    return stamp, errors


def expected_drift(noise: str, stamp_s: Array) -> Array:
    """Root mean square ``(N,)`` that the model of a noise gives: metres, or radians for a yaw noise."""
    settings = NoiseSettings.parse(noise)
    if _turns_only(settings):
        return np.asarray(settings.yaw_random_walk_rad * np.sqrt(RATE_HZ * stamp_s))
    step = settings.constant_drift_m * (np.sqrt(3) if settings.constant_drift_per_axis else 1)
    return np.hypot(random_walk_rms_m(settings, stamp_s, RATE_HZ), step * RATE_HZ * stamp_s)


def drift_table(curves: dict[str, tuple[Array, Array]], every_s: float = 60.0) -> pd.DataFrame:
    """One row a noise and minute: the measured and the expected root mean square, and the share of seeds above 1."""
    rows = []
    for noise, (stamp, errors) in curves.items():
        expected = expected_drift(noise, stamp)
        for time_s in np.arange(every_s, stamp[-1] + 1e-9, every_s):
            k = int(np.searchsorted(stamp, time_s - 1e-9))
            rows.append(
                {
                    "noise": noise,
                    "time_s": time_s,
                    "unit": "rad" if _turns_only(NoiseSettings.parse(noise)) else "m",
                    "seeds": len(errors),
                    "rms": np.sqrt((errors[:, k] ** 2).mean()),
                    "expected_rms": expected[k],
                    "share_above_1": (errors[:, k] > 1).mean(),
                }
            )
    return pd.DataFrame(rows)


def world_metrics(flown: pd.DataFrame, drift: pd.DataFrame) -> dict[str, float]:
    """The numbers of both tables in one flat map."""
    values = {
        f"{row['trajectory']}.{name}": value for row in flown.to_dict("records") for name, value in row.items()
        if name != "trajectory"
    }  # fmt: skip
    for row in drift.to_dict("records"):
        values[f"{row['noise']}.rms_{row['unit']}_after_{row['time_s']:.0f}_s"] = row["rms"]
    return values


def _turns_only(settings: NoiseSettings) -> bool:
    return settings.yaw_random_walk_rad > 0 and not (settings.random_walk_m or settings.constant_drift_m)


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
            within = None if on_progress is None else _share(on_progress, len(results), len(cases))
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
    case = _case(settings)
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
                    **_case(settings),
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


@dataclass(frozen=True)
class Basin:
    """Where one scan ends that starts beside its true pose.

    ``settings`` of the registration; ``offset_m (N, 3)`` of the starts from the truth; ``error_m (N,)`` of the end;
    ``used (N,)``, whether the odometry took the result or refused it; ``cloud (M, 3)``, the map built at true poses;
    ``scan (P, 3)`` in the drone frame, its true pose and the poses ``(N, 4, 4)`` it ended at.
    """

    settings: ExperimentSettings
    offset_m: Array
    error_m: Array
    used: np.ndarray
    cloud: Array
    scan: Array
    T_world_drone_true: Array
    T_world_drone_end: Array

    @property
    def wrong(self) -> np.ndarray:
        """Starts ``(N,)`` that ended elsewhere without the odometry's noticing: false convergence."""
        return self.used & (self.error_m > RIGHT_M)

    @property
    def stayed(self) -> np.ndarray:
        """Those of the wrong ones ``(N,)`` that hardly left their start, since the registration trusts its prior."""
        end = self.T_world_drone_end[:, :3, 3] - self.T_world_drone_true[:3, 3]
        return self.wrong & (np.linalg.norm(end - self.offset_m, axis=1) <= RIGHT_M)

    @property
    def right(self) -> np.ndarray:
        """Starts ``(N,)`` that came home."""
        return self.used & (self.error_m <= RIGHT_M)


RIGHT_M = 0.1
"""An end within this distance of the truth is right: the edge of the report's voxel."""


def find_basin(
    settings: ExperimentSettings,
    flight: Flight,
    truth: Truth,
    frame: int,
    offset_m: Array,
    every: int = 4,
    on_progress: Callable[[float], None] | None = None,
) -> Basin:
    """Register scan ``frame`` from starts ``offset_m (N, 3)`` beside its true pose to a map of the other scans.

    The map takes every so many scans, placed at their true poses.
    """
    if not isinstance(settings.odometry, CloudSettings):
        raise ValueError(f"method {settings.odometry.method!r}: expected an odometry by clouds")
    odometry = CloudOdometry(settings.odometry, settings.preprocess, flight.T_drone_sensor)
    true = truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    for k in range(0, len(flight.scans), every):
        if k != frame:
            points = preprocess_scan(flight.scans[k], true[k], flight.T_drone_sensor, settings.preprocess)
            odometry.map.update_shapes(odometry.map.insert(points @ true[k][:3, :3].T + true[k][:3, 3]))
    ends, used = [], []
    for k, offset in enumerate(offset_m):
        trial = copy.deepcopy(odometry)
        trial.offset, trial.turn = np.asarray(offset, dtype=np.float64), np.eye(3)
        step = trial.update(flight.scans[frame], true[frame])
        ends.append(step.T_world_drone)
        used.append(step.used)
        if on_progress:
            on_progress((k + 1) / len(offset_m))
    end = np.array(ends)
    return Basin(
        settings=settings,
        offset_m=offset_m,
        error_m=np.linalg.norm(end[:, :3, 3] - true[frame][:3, 3], axis=1),
        used=np.array(used),
        cloud=odometry.map_points(),
        scan=preprocess_scan(flight.scans[frame], true[frame], flight.T_drone_sensor, settings.preprocess),
        T_world_drone_true=true[frame],
        T_world_drone_end=end,
    )


def basin_table(basins: dict[str, Basin]) -> pd.DataFrame:
    """One row a registration: the radius within which all starts come home, and how many came home at all, ended
    wrong (hardly left their start, or locked onto something else), or were refused."""
    rows = {
        label: {
            "radius_m": basin_radius_m(basin.offset_m, basin.right),
            "right_share": basin.right.mean(),
            "wrong_share": basin.wrong.mean(),
            "stayed_share": basin.stayed.mean(),
            "locked_share": (basin.wrong & ~basin.stayed).mean(),
            "refused_share": (~basin.used).mean(),
        }
        for label, basin in basins.items()
    }
    return pd.DataFrame(rows).T


def offset_grid(reach_m: float, step_m: float) -> Array:
    """Offsets ``(N, 3)`` along x and z from −``reach_m`` to ``reach_m``, rows of z, in steps of about ``step_m``."""
    side = np.linspace(-reach_m, reach_m, 2 * round(reach_m / step_m) + 1)
    x, z = np.meshgrid(side, side)
    return np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()])


def find_slips(results: Sequence[experiment.Result], wrong_m: float = 0.25, within_s: float = 1.0) -> pd.DataFrame:
    """Where translation-only ICP, or any method, locks onto a wrong bar: a row a run.

    ``wrong_share`` of the scans that had pairs ended farther than ``wrong_m`` from the truth; ``slip_m`` is the largest
    growth of the error ``within_s`` over such scans, at ``slip_s``.
    """
    rows = []
    for result in results:
        settings = result.settings
        error = position_error_m(result.corrected, result.truth.trajectory)
        paired = result.matches > 0
        scan, slip = largest_slip(error, max(1, round(within_s * settings.tof.rate_hz)))
        rows.append(
            {
                **_case(settings),
                "max_correspondence_m": getattr(settings.odometry, "max_correspondence_m", np.nan),
                "blind_s": sum(last - first for first, last in settings.tof.blind_s),
                "ate_rmse_m": result.metrics["ate_rmse_m"],
                "error_final_m": result.metrics["error_final_m"],
                "wrong_share": float((error[paired] > wrong_m).mean()) if paired.any() else 0.0,
                "slip_m": slip,
                "slip_s": float(result.corrected.stamp_s[scan]),
            }
        )
    return pd.DataFrame(rows)
