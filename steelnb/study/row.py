"""What a study keeps of one run: its numbers and thin curves, as one flat row."""

import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import steelnb
from steelnb import experiment
from steelnb.config import ExperimentSettings
from steelnb.datatypes import Array, Flight, RangeScans
from steelnb.metrics import bend, position_error_m
from steelnb.simulation import Truth
from steelnb.study.basins import find_slips
from steelnb.study.clouds import paired_clouds

CURVE_SAMPLES = 100
OK, FAILED = "ok", "failed"


@dataclass(frozen=True)
class Flown:
    """A flight with its scans and truth, which all runs on it share, and the seconds that it took."""

    flight: Flight
    truth: Truth
    seconds: float

    def __sizeof__(self) -> int:
        """Bytes, nearly all of them scans: what Dask goes by when it weighs moving a flight against waiting."""
        scans = self.flight.scans
        ranges = scans.range_m.nbytes if isinstance(scans, RangeScans) else 0
        return ranges + self.truth.trajectory.T_world_drone.nbytes + self.truth.tower.vertices.nbytes


@dataclass(frozen=True)
class Fault:
    """Why a flight or a run is not there, with its traceback."""

    text: str


def fly(settings: ExperimentSettings) -> Flown | Fault:
    """The flight and the scans of some settings; a flight that raises is told, not raised."""
    begin = time.perf_counter()
    try:
        flight, truth = experiment.simulate(settings)
    except Exception as fault:
        return Fault(told(fault))
    return Flown(flight, truth, time.perf_counter() - begin)


def run_on(flown: Flown | Fault, settings: ExperimentSettings) -> dict[str, Any]:
    """The row of one run on a flight: ``status``, ``error``, numbers and curves, and the seconds that it took."""
    if isinstance(flown, Fault):
        return failed(flown.text)
    begin = time.perf_counter()
    try:
        own = experiment.redrift(settings, flown.flight, flown.truth)
        result = experiment.estimate(settings, own, flown.truth)
        row = {"status": OK, "error": "", **numbers(own, result), **curves(result), **frame_times(result)}
    except Exception as fault:
        row = failed(told(fault))
    return {**row, "seconds": time.perf_counter() - begin, "flight_seconds": flown.seconds}


def failed(text: str) -> dict[str, Any]:
    """The row of a run that gave nothing."""
    return {"status": FAILED, "error": text}


def told(fault: BaseException) -> str:
    """A traceback as text that is the same on every machine: files of the package by their place in it, others by name
    alone."""
    package = Path(steelnb.__file__).parent.parent
    trace = traceback.TracebackException.from_exception(fault)
    for frame in trace.stack:
        path = Path(frame.filename)
        frame.filename = path.relative_to(package).as_posix() if path.is_relative_to(package) else path.name
    return "".join(trace.format()).rstrip()


def numbers(flight: Flight, result: experiment.Result) -> dict[str, float]:
    """The finite numbers of a run: its metrics, and what explains them.

    ``lost_share`` of the scans after the first that no pair corrected, and how fast the error grew there and elsewhere
    (``growth_lost_m_s``, ``growth_paired_m_s``); ``wrong_share`` and ``slip_m`` of `find_slips`; ``bend_deg`` of the
    cloud built; and the angle between estimated and true attitude, mean and last.
    """
    error = position_error_m(result.corrected, result.truth.trajectory)
    lost = result.matches[1:] == 0
    growth = np.diff(error) / np.diff(result.corrected.stamp_s)
    slip = find_slips([result]).iloc[0]
    turned = turned_deg(result)
    found = {
        **result.metrics,
        "lost_share": float(lost.mean()) if len(lost) else 0.0,
        "growth_lost_m_s": float(growth[lost].mean()) if lost.any() else np.nan,
        "growth_paired_m_s": float(growth[~lost].mean()) if (~lost).any() else np.nan,
        "wrong_share": float(slip["wrong_share"]),
        "slip_m": float(slip["slip_m"]),
        "bend_deg": bend_of(flight, result),
        "turned_mean_deg": float(turned.mean()),
        "turned_final_deg": float(turned[-1]),
    }
    return {name: float(value) for name, value in found.items() if np.isfinite(value)}


def turned_deg(result: experiment.Result) -> Array:
    """Angle ``(N,)`` between the estimated and the true attitude at each scan."""
    true = result.truth.trajectory.at(result.corrected.stamp_s).T_world_drone[:, :3, :3]
    cosine = 0.5 * (np.einsum("nij,nij->n", true, result.corrected.T_world_drone[:, :3, :3]) - 1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def bend_of(flight: Flight, result: experiment.Result) -> float:
    """`Bend.bend_deg` of the cloud that the scans make at the estimated poses; NaN for one too small to tell."""
    try:
        return bend(*paired_clouds(flight, result)).bend_deg
    except ValueError:
        return float("nan")


def curves(result: experiment.Result) -> dict[str, np.ndarray]:
    """About `CURVE_SAMPLES` samples: times, errors without and with correction, and the pairs of that scan."""
    stamp = result.corrected.stamp_s
    chosen = np.unique(np.linspace(0, len(stamp) - 1, min(CURVE_SAMPLES, len(stamp))).round().astype(int))
    truth = result.truth.trajectory
    return {
        "curve_time_s": stamp[chosen].astype(np.float32),
        "curve_raw_m": position_error_m(result.prior, truth)[chosen].astype(np.float32),
        "curve_error_m": position_error_m(result.corrected, truth)[chosen].astype(np.float32),
        "curve_matches": result.matches[chosen].astype(np.int32),
    }


def frame_times(result: experiment.Result) -> dict[str, float]:
    """Milliseconds that a frame took, median and 95th percentile."""
    whole = 1e3 * np.sum(list(result.seconds.values()), axis=0)
    median, p95 = np.percentile(whole, [50, 95])
    return {"frame_median_ms": float(median), "frame_p95_ms": float(p95)}
