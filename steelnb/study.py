"""Many experiments: run what a comparison needs once, and put the numbers into tables."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.config import (
    TRAJECTORIES,
    CorrectionName,
    ExperimentSettings,
    NoiseSettings,
    SensorName,
    TrajectoryName,
)
from steelnb.datatypes import Array, Flight, Trajectory
from steelnb.noise import drifting, random_walk_rms_m
from steelnb.simulation import Truth

RATE_HZ = 125.0


def compare(
    trajectory: TrajectoryName,
    sensor: SensorName,
    noise: Sequence[str],
    correction: Sequence[CorrectionName],
    seed: int,
    duration_s: float,
    overrides: dict[str, Any] | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> list[experiment.Result]:
    """Every noise × every correction on one flight, which is simulated once. Raises `SettingsError`."""
    cases = [
        ExperimentSettings.preset(trajectory, each_noise, each_correction, sensor, seed, duration_s, overrides)
        for each_noise in noise
        for each_correction in correction
    ]
    flight, truth = experiment.simulate(cases[0])
    results = []
    for k, case in enumerate(cases):
        within = None if on_progress is None else _share(on_progress, k, len(cases))
        results.append(experiment.estimate(case, experiment.redrift(case, flight, truth), truth, within))
    return results


def _share(on_progress: Callable[[float], None], k: int, total: int) -> Callable[[float], None]:
    return lambda fraction: on_progress((k + fraction) / total)


def table(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """One row a run: what it was run with, then its numbers."""
    return pd.DataFrame([{**_case(result.settings), **result.metrics} for result in results])


def metrics(results: Sequence[experiment.Result]) -> dict[str, float]:
    """The finite numbers of all runs in one flat map, ``<noise>.<method>.<metric>``."""
    return {
        f"{result.settings.noise_name}.{result.settings.odometry.correction}.{name}": value
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
        f"{result.settings.noise_name}.{result.settings.odometry.correction}": result.settings.model_dump()
        for result in results
    }


def _case(settings: ExperimentSettings) -> dict[str, Any]:
    return {
        "trajectory": settings.flight.trajectory,
        "noise": settings.noise_name,
        "method": settings.odometry.correction,
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
