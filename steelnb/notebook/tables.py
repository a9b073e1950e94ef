"""The table row of a run: its case, metrics, thinned curves, and measured times."""

from collections.abc import Callable
from typing import Any

import numpy as np

from steelnb import experiment
from steelnb.core.determinism import machine
from steelnb.core.types import Array, Flight
from steelnb.metrics import bend, largest_slip, position_error_m
from steelnb.points import preprocess_scan
from steelnb.settings import ExperimentSettings
from steelnb.simulation import Truth

CASE = ("sensor", "duration_s", "trajectory", "seed", "noise", "variant", "method")
"""Columns that identify a run; tables are sorted by them."""
CURVES = ("curve_time_s", "curve_raw_m", "curve_error_m", "curve_matches")
TIMES = ("frame_median_ms", "frame_p95_ms", "machine")
"""Columns that differ from run to run of the same settings; comparisons ignore them."""
CURVE_SAMPLES = 100
WRONG_M = 0.25
"""A scan with correspondences and a larger error than this counts as falsely registered."""


def case_of(settings: ExperimentSettings) -> dict[str, Any]:
    """The columns that name a run in tables."""
    return {
        "trajectory": settings.flight.trajectory,
        "noise": settings.noise_name,
        "method": settings.odometry.method,
        "sensor": settings.sensor,
        "seed": settings.seed,
    }


def make_row(settings: ExperimentSettings, flown: Callable[[], tuple[Flight, Truth]]) -> dict[str, Any]:
    """Correct the flight that ``flown`` returns, with the drift and method of the settings. Returns `numbers`, `curves`
    and `TIMES`."""
    flight, truth = flown()
    flight = experiment.redrift(settings, flight, truth)
    result = experiment.estimate(settings, flight, truth)
    times = {f"frame_{name}": ms for name, ms in stage_times(result)["frame"].items()}
    return {**numbers(flight, result), **curves(result), **times, "machine": machine()}


def numbers(flight: Flight, result: experiment.Result) -> dict[str, float]:
    """Finite numbers of a run: its metrics, and diagnostics.

    ``lost_share``: share of the scans after the first that have no correspondences; ``growth_lost_m_s`` and
    ``growth_paired_m_s``: mean growth rate of the error at scans without and with correspondences;
    ``raw_growth_lost_m_s`` and ``raw_growth_paired_m_s``: the same of the uncorrected error; ``wrong_share``: share of
    the scans with correspondences whose error exceeds `WRONG_M`; ``slip_m``: largest growth of the error within a
    second; ``bend_deg``: bend of the assembled cloud; ``turned_mean_deg`` and ``turned_final_deg``: angle between
    estimated and true attitude.
    """
    stamp_s, truth = result.corrected.stamp_s, result.truth.trajectory
    error, paired = position_error_m(result.corrected, truth), result.matches > 0
    lost, scans_per_s = ~paired[1:], max(1, round((len(stamp_s) - 1) / max(stamp_s[-1] - stamp_s[0], 1e-9)))
    growth, raw_growth = (np.diff(each) / np.diff(stamp_s) for each in (error, position_error_m(result.prior, truth)))
    true = truth.at(stamp_s).T_world_drone[:, :3, :3]
    cosine = 0.5 * (np.einsum("nij,nij->n", true, result.corrected.T_world_drone[:, :3, :3]) - 1)
    rotation_error_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    try:
        bend_deg = bend(*paired_clouds(flight, result))["bend_deg"]
    except ValueError:  # too few points to fit
        bend_deg = np.nan

    def mean(values: np.ndarray, where: np.ndarray, of_none: float = np.nan) -> float:
        return float(values[where].mean()) if where.any() else of_none

    values = {
        **result.metrics,
        "lost_share": lost.mean() if len(lost) else 0.0,
        "growth_lost_m_s": mean(growth, lost),
        "growth_paired_m_s": mean(growth, ~lost),
        "raw_growth_lost_m_s": mean(raw_growth, lost),
        "raw_growth_paired_m_s": mean(raw_growth, ~lost),
        "wrong_share": mean(error > WRONG_M, paired, of_none=0.0),
        "slip_m": largest_slip(error, scans_per_s)[1],
        "bend_deg": bend_deg,
        "turned_mean_deg": rotation_error_deg.mean(),
        "turned_final_deg": rotation_error_deg[-1],
    }
    return {name: float(value) for name, value in values.items() if np.isfinite(value)}


def paired_clouds(flight: Flight, result: experiment.Result, every: int = 4) -> tuple[Array, Array]:
    """Points of one scan in ``every``, at the estimated and at the true poses: two clouds ``(N, 3)``, metres, world
    frame. Row k of both is the same return."""
    true = result.truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    estimated, shown = result.corrected.T_world_drone, range(0, len(flight.scans), every)
    preprocess, T_drone_sensor = result.settings.odometry.preprocess, flight.T_drone_sensor
    scans = [preprocess_scan(flight.scans[k], true[k], T_drone_sensor, preprocess) for k in shown]

    def placed(T: Array) -> Array:
        return np.concatenate([points @ T[k, :3, :3].T + T[k, :3, 3] for k, points in zip(shown, scans, strict=True)])

    return placed(estimated), placed(true)


def curves(result: experiment.Result) -> dict[str, np.ndarray]:
    """At most `CURVE_SAMPLES` samples of stamps, errors without and with correction, and numbers of correspondences."""
    stamp_s, truth = result.corrected.stamp_s, result.truth.trajectory
    chosen = np.unique(np.linspace(0, len(stamp_s) - 1, min(CURVE_SAMPLES, len(stamp_s))).round().astype(int))
    return {
        "curve_time_s": stamp_s[chosen].astype(np.float32),
        "curve_raw_m": position_error_m(result.prior, truth)[chosen].astype(np.float32),
        "curve_error_m": position_error_m(result.corrected, truth)[chosen].astype(np.float32),
        "curve_matches": result.matches[chosen].astype(np.int32),
    }


def stage_times(result: experiment.Result) -> dict[str, dict[str, float]]:
    """``median_ms`` and ``p95_ms`` (95th percentile) of the time per scan, for each stage and the whole ``frame``."""
    stages = {**result.seconds, "frame": np.sum(list(result.seconds.values()), axis=0)}
    times = {stage: np.percentile(1e3 * seconds, [50, 95]) for stage, seconds in stages.items()}
    return {stage: {"median_ms": float(median), "p95_ms": float(p95)} for stage, (median, p95) in times.items()}
