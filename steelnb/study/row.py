"""One run of a study on a worker: the flight, and the row of numbers and thin curves that is kept of it."""

import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from steelnb import experiment
from steelnb.metrics import bend, largest_slip, position_error_m
from steelnb.points import preprocess_scan
from steelnb.settings import ExperimentSettings
from steelnb.simulation import Truth
from steelnb.types import Array, Flight, RangeScans

CURVE_SAMPLES = 100
WRONG_M = 0.25
"""Error beyond which a scan that had pairs counts as registered to the wrong place."""
OK, FAILED = "ok", "failed"


@dataclass(frozen=True)
class Flown:
    """A flight with its scans and its truth, which all runs on it share, and the seconds that its simulation took."""

    flight: Flight
    truth: Truth
    seconds: float

    def __sizeof__(self) -> int:
        """Bytes, nearly all of them scans, by which Dask weighs moving a flight against waiting."""
        return self.flight.scans.range_m.nbytes if isinstance(self.flight.scans, RangeScans) else 0


def fly(settings: ExperimentSettings) -> Flown | str:
    """The simulated flight of some settings, or the traceback of its failure."""
    begin = time.perf_counter()
    try:
        flight, truth = experiment.simulate(settings)
    except Exception:
        return _traceback()
    return Flown(flight, truth, time.perf_counter() - begin)


def run_on(flown: Flown | str, settings: ExperimentSettings) -> dict[str, Any]:
    """Row of one run on a flight: ``status``, ``error`` (a traceback), numbers, curves and seconds."""
    if isinstance(flown, str):
        return {"status": FAILED, "error": flown}
    begin = time.perf_counter()
    row: dict[str, Any]
    try:
        own = experiment.redrift(settings, flown.flight, flown.truth)
        result = experiment.estimate(settings, own, flown.truth)
        row = {"status": OK, "error": "", **numbers(own, result), **curves(result), **frame_times(result)}
    except Exception:
        row = {"status": FAILED, "error": _traceback()}
    return {**row, "seconds": time.perf_counter() - begin, "flight_seconds": flown.seconds}


def _traceback() -> str:
    """Traceback of the exception being handled, without the folder of this machine that holds the package."""
    return traceback.format_exc().replace(f"{Path(experiment.__file__).parents[1]}/", "").rstrip()


def numbers(flight: Flight, result: experiment.Result) -> dict[str, float]:
    """Finite numbers of a run: its metrics, and numbers that explain them.

    ``lost_share`` is the share of scans after the first without pairs; ``growth_lost_m_s`` and ``growth_paired_m_s``
    the mean growth of the error there and elsewhere, ``raw_growth_lost_m_s`` and ``raw_growth_paired_m_s`` that of the
    error without correction at the same scans; ``wrong_share`` the share of the scans with pairs whose error
    exceeds `WRONG_M`; ``slip_m`` the largest growth of the error within a second; ``bend_deg`` that of the assembled
    cloud; ``turned_mean_deg`` and ``turned_final_deg`` the angle between estimated and true attitude.
    """
    error, paired = position_error_m(result.corrected, result.truth.trajectory), result.matches > 0
    lost, passed_s = ~paired[1:], np.diff(result.corrected.stamp_s)
    growth = np.diff(error) / passed_s
    raw_growth = np.diff(position_error_m(result.prior, result.truth.trajectory)) / passed_s
    true = result.truth.trajectory.at(result.corrected.stamp_s).T_world_drone[:, :3, :3]
    cosine = 0.5 * (np.einsum("nij,nij->n", true, result.corrected.T_world_drone[:, :3, :3]) - 1)
    turned_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    try:
        bend_deg = bend(*paired_clouds(flight, result)).bend_deg
    except ValueError:  # too few points to fit
        bend_deg = np.nan
    found = {
        **result.metrics,
        "lost_share": lost.mean() if len(lost) else 0.0,
        "growth_lost_m_s": growth[lost].mean() if lost.any() else np.nan,
        "growth_paired_m_s": growth[~lost].mean() if (~lost).any() else np.nan,
        "raw_growth_lost_m_s": raw_growth[lost].mean() if lost.any() else np.nan,
        "raw_growth_paired_m_s": raw_growth[~lost].mean() if (~lost).any() else np.nan,
        "wrong_share": (error[paired] > WRONG_M).mean() if paired.any() else 0.0,
        "slip_m": largest_slip(error, max(1, round(result.settings.tof.rate_hz)))[1],
        "bend_deg": bend_deg,
        "turned_mean_deg": turned_deg.mean(),
        "turned_final_deg": turned_deg[-1],
    }
    return {name: float(value) for name, value in found.items() if np.isfinite(value)}


def paired_clouds(flight: Flight, result: experiment.Result, every: int = 4) -> tuple[Array, Array]:
    """Every fourth scan placed at the estimated and at the true poses: two clouds ``(N, 3)`` in the world frame, in
    metres, whose rows k are the same return."""
    true = result.truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    built: list[Array] = []
    real: list[Array] = []
    for k in range(0, len(flight.scans), every):
        points = preprocess_scan(flight.scans[k], true[k], flight.T_drone_sensor, result.settings.odometry.preprocess)
        for T_world_drone, clouds in ((result.corrected.T_world_drone[k], built), (true[k], real)):
            clouds.append(points @ T_world_drone[:3, :3].T + T_world_drone[:3, 3])
    return np.concatenate(built), np.concatenate(real)


def curves(result: experiment.Result) -> dict[str, np.ndarray]:
    """At most `CURVE_SAMPLES` samples: stamps, errors without and with correction, and the pairs of that scan."""
    stamp_s, truth = result.corrected.stamp_s, result.truth.trajectory
    chosen = np.unique(np.linspace(0, len(stamp_s) - 1, min(CURVE_SAMPLES, len(stamp_s))).round().astype(int))
    return {
        "curve_time_s": stamp_s[chosen].astype(np.float32),
        "curve_raw_m": position_error_m(result.prior, truth)[chosen].astype(np.float32),
        "curve_error_m": position_error_m(result.corrected, truth)[chosen].astype(np.float32),
        "curve_matches": result.matches[chosen].astype(np.int32),
    }


def frame_times(result: experiment.Result) -> dict[str, float]:
    """Milliseconds a frame, median and 95th percentile."""
    median, p95 = np.percentile(1e3 * np.sum(list(result.seconds.values()), axis=0), [50, 95])
    return {"frame_median_ms": float(median), "frame_p95_ms": float(p95)}
