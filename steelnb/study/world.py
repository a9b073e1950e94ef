"""What notebook 01 tells of the flights and of the drift."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.config import (
    TRAJECTORIES,
    ExperimentSettings,
    NoiseSettings,
)
from steelnb.datatypes import Array, Flight, Trajectory
from steelnb.noise import drifting, random_walk_rms_m
from steelnb.simulation import Truth
from steelnb.study.runs import share

RATE_HZ = 125.0


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
            share(on_progress, k, len(TRAJECTORIES))(1.0)
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
