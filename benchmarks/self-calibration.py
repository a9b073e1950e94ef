"""Errors of a sensor that smoothing finds, beside those that it has: their errors, σ and NEES, and what poses gain.

    PYTHONPATH=. .venv/bin/python benchmarks/self-calibration.py [--seeds 101 102 …] [--duration 200]
        [--case none scale mount drawn] [--flight vertical orbit]

Flights with the ideal sensor under the random walk. Estimators are told a mount, ranges and stamps that are wrong:
*scale*, ranges 2 % too long; *mount*, 1 cm along each axis, 1° of pitch and of yaw; *drawn*, all nine errors at once,
drawn from the standard deviations that the estimator has. Prints the tables of self-calibration.md.
"""

import argparse

import numpy as np

from steelnb import experiment
from steelnb.metrics import score_trajectory
from steelnb.report.calibration import SHOWN
from steelnb.report.self_calibration import DRAWN, METHODS, WITH_IMU, errors_of, estimates
from steelnb.settings import ExperimentSettings
from steelnb.simulation import Truth
from steelnb.types import Estimate, Flight

CASES = {"none": "none", "scale": "range × 1.02", "mount": "mount off by 1 cm and 1°", "drawn": DRAWN}
FLIGHTS = ("vertical", "orbit")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102])
    parser.add_argument("--duration", type=float, default=200.0)
    parser.add_argument("--case", choices=CASES, nargs="+", default=list(CASES))
    parser.add_argument("--flight", choices=FLIGHTS, nargs="+", default=FLIGHTS)
    arguments = parser.parse_args()
    print(
        f"| flight | case | seed | {' | '.join(METHODS)} (mm) | found − true ± σ | NEES / 9 | with the IMU | NEES / 9 |"
    )
    print("|---|---|---|" + "---|" * (len(METHODS) + 4))
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
    true = errors_of(CASES[case], settings.seed)
    estimates_of = estimates(settings, flight, truth, true)
    cells = [f"{ate_mm(each, truth):.1f}" for each in estimates_of.values()]
    for method in ("calibrated", WITH_IMU):
        found = estimates_of[method].sensor_errors
        assert found is not None
        off = found.value - true
        said = (
            f"{name} {SHOWN[unit][0] * value:+.2f} ± {SHOWN[unit][0] * sigma:.2f} {SHOWN[unit][1]}"
            for name, value, sigma, unit in zip(found.NAMES, off, found.sigma, found.UNITS, strict=True)
        )
        cells += [", ".join(said), f"{off @ np.linalg.solve(found.covariance, off) / len(off):.2f}"]
    return " | ".join(cells)


def ate_mm(estimate: Estimate, truth: Truth) -> float:
    """Unaligned absolute trajectory error, millimetres."""
    return 1e3 * score_trajectory(estimate.corrected, truth.trajectory)["ate_rmse_m"]


if __name__ == "__main__":
    main()
