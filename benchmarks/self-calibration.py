"""Errors of a sensor that smoothing finds, beside those that it has: their errors, σ and NEES, and what poses gain.

    PYTHONPATH=. .venv/bin/python benchmarks/self-calibration.py [--seeds 101 102 …] [--duration 200]
        [--case none scale mount drawn] [--flight vertical orbit]

Flights with the ideal sensor under the random walk. Estimators are told a mount, ranges and stamps that are wrong:
*scale*, ranges 2 % too long; *mount*, 1 cm along each axis, 1° of pitch and of yaw; *drawn*, all nine errors at once,
drawn from the standard deviations that the estimator has. Prints the tables of self-calibration.md.
"""

import argparse
from dataclasses import replace

import numpy as np

from steelnb import experiment
from steelnb.fusion import smooth
from steelnb.fusion.sensor_errors import unknown_errors
from steelnb.metrics import score_trajectory
from steelnb.noise import drifting
from steelnb.odometry import make_odometry, run
from steelnb.rng import stream
from steelnb.settings import CalibrationSettings, ExperimentSettings, StructureSettings
from steelnb.simulation import Truth
from steelnb.types import Array, Estimate, Flight, RangeScans, SensorErrors

CASES = ("none", "scale", "mount", "drawn")
FLIGHTS = ("vertical", "orbit")
SHOWN = np.array([1e3, 100.0, 1e3, 1e3, 1e3, *3 * [180 / np.pi], 1e3])
UNITS = ("mm", "%", "mm", "mm", "mm", "°", "°", "°", "ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102])
    parser.add_argument("--duration", type=float, default=200.0)
    parser.add_argument("--case", choices=CASES, nargs="+", default=CASES)
    parser.add_argument("--flight", choices=FLIGHTS, nargs="+", default=FLIGHTS)
    arguments = parser.parse_args()
    print("| flight | case | seed | combined | smoothed | calibrated (mm) | found − true ± σ | NEES / 9 |")
    print("|---|---|---|---|---|---|---|---|")
    for flight_name in arguments.flight:
        for seed in arguments.seeds:
            settings = ExperimentSettings.preset(
                flight_name, "random-walk", seed=seed, duration_s=arguments.duration, method="combined"
            )
            flight, truth = experiment.simulate(settings)
            for case in arguments.case:
                print(f"| {flight_name} | {case} | {seed} | {row(settings, flight, truth, case)} |", flush=True)


def row(settings: ExperimentSettings, flight: Flight, truth: Truth, case: str) -> str:
    """Position errors by each method, the errors that were found but for those of the sensor, and their NEES."""
    true = errors_of(case, settings.seed)
    told = wrongly_told(settings, flight, truth, true)
    seen = settings.odometry.preprocess
    structure = StructureSettings(floor_m=seen.floor_m, range_max_m=seen.crop_m)
    online = run(told, make_odometry(settings.odometry, told.T_drone_sensor))
    smoothed = smooth(told, online, structure)
    calibrated = smooth(told, online, structure, calibration=CalibrationSettings())
    found = calibrated.sensor_errors
    assert found is not None
    off = found.value - true
    ate = " | ".join(f"{ate_mm(each, truth):.1f}" for each in (online, smoothed, calibrated))
    said = ", ".join(
        f"{name} {value:+.2f} ± {sigma:.2f} {unit}"
        for name, value, sigma, unit in zip(SensorErrors.NAMES, off * SHOWN, found.sigma * SHOWN, UNITS, strict=True)
    )
    return f"{ate} | {said} | {off @ np.linalg.solve(found.covariance, off) / len(off):.2f}"


def errors_of(case: str, seed: int) -> Array:
    """The true errors ``(9,)`` of a case, in the order of `SensorErrors.NAMES`."""
    errors = np.zeros(len(SensorErrors.NAMES))
    if case == "scale":
        errors[1] = 0.02
    elif case == "mount":
        errors[2:5], errors[6:8] = 0.01, np.radians(1.0)
    elif case == "drawn":
        errors = unknown_errors(CalibrationSettings()).prior_sigma * stream(seed, "errors").standard_normal(len(errors))
    return errors


def wrongly_told(settings: ExperimentSettings, flight: Flight, truth: Truth, errors: Array) -> Flight:
    """The flight as an estimator sees it that is not told of the errors."""
    sensor = SensorErrors(errors, np.eye(len(errors)), errors)
    scans = flight.scans
    assert isinstance(scans, RangeScans)
    ranges = (scans.range_m * (1 + errors[1]) + errors[0]).astype(np.float32)
    prior = flight.prior
    if errors[8]:
        drifted = drifting(truth.trajectory, settings.noise, settings.seed)
        prior = replace(prior, T_world_drone=drifted.between(prior.stamp_s - errors[8]))
    mount = flight.T_drone_sensor @ np.linalg.inv(sensor.T_assumed_true)
    return replace(flight, scans=RangeScans(scans.stamp_s, ranges, scans.ray), prior=prior, T_drone_sensor=mount)


def ate_mm(estimate: Estimate, truth: Truth) -> float:
    """Unaligned absolute trajectory error, millimetres."""
    return 1e3 * score_trajectory(estimate.corrected, truth.trajectory)["ate_rmse_m"]


if __name__ == "__main__":
    main()
