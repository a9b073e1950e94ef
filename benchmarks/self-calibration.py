"""Errors of a sensor that smoothing finds, beside those that it has: their errors, σ and NEES, and what poses gain.

    PYTHONPATH=. .venv/bin/python benchmarks/self-calibration.py [--seeds 101 102 …] [--duration 200]
        [--case none scale mount drawn] [--flight zigzag loops] [--next]

Flights with the ideal sensor under the random walk. Estimators are told a mount, ranges and stamps that are wrong:
*scale*, ranges 2 % too long; *mount*, 1 cm along each axis, 1° of pitch and of yaw; *drawn*, all nine errors at once,
drawn from the standard deviations that the estimator has. With ``--next``, `combined` then flies the other flight with
the next seed and the same sensor, told wrongly and with what the IMU helped to find. Prints the tables of
self-calibration.md.
"""

import argparse
from typing import NamedTuple

import numpy as np

from steelnb import experiment
from steelnb.fusion.sensor_errors import true_flight
from steelnb.metrics import score_trajectory
from steelnb.odometry import make_odometry, run
from steelnb.report.calibration import SHOWN
from steelnb.report.self_calibration import DRAWN, METHODS, WITH_IMU, errors_of, estimates, wrongly_told
from steelnb.settings import ExperimentSettings, TrajectoryName
from steelnb.simulation import Truth
from steelnb.types import Estimate, Flight

CASES = {"none": "none", "scale": "range × 1.02", "mount": "mount off by 1 cm and 1°", "drawn": DRAWN}
FLIGHTS: tuple[TrajectoryName, ...] = ("zigzag", "loops")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102])
    parser.add_argument("--duration", type=float, default=200.0)
    parser.add_argument("--case", choices=CASES, nargs="+", default=list(CASES))
    parser.add_argument("--flight", choices=FLIGHTS, nargs="+", default=FLIGHTS)
    parser.add_argument("--next", action="store_true")
    arguments = parser.parse_args()
    heads = ["flight", "case", "seed", *METHODS, "found − true ± σ", "NEES / 9", "with the IMU", "NEES / 9"]
    heads += ["next flight, combined (mm): told wrongly", "corrected"] if arguments.next else []
    print(f"| {' | '.join(heads)} |\n" + "|---" * len(heads) + "|")
    for flight_name in arguments.flight:
        for seed in arguments.seeds:
            flown = fly(flight_name, seed, arguments.duration)
            other = FLIGHTS[1 - FLIGHTS.index(flight_name)]
            after = fly(other, seed + 1, arguments.duration) if arguments.next else None
            for case in arguments.case:
                print(f"| {flight_name} | {case} | {seed} | {row(flown, case, after)} |", flush=True)


class Flown(NamedTuple):
    settings: ExperimentSettings
    flight: Flight
    truth: Truth


def fly(flight_name: TrajectoryName, seed: int, duration_s: float) -> Flown:
    settings = ExperimentSettings.preset(
        flight_name, "random-walk", seed=seed, duration_s=duration_s, method="combined"
    )
    return Flown(settings, *experiment.simulate(settings))


def row(flown: Flown, case: str, after: Flown | None) -> str:
    """Position errors by each method, the errors that were found but for those of the sensor, and their NEES; and the
    position errors on the flight ``after``."""
    true, truth = errors_of(CASES[case], flown.settings.seed), flown.truth
    estimates_of = estimates(*flown, true)
    cells = [f"{ate_mm(each, truth):.1f}" for each in estimates_of.values()]
    for method in ("calibrated", WITH_IMU):
        found = estimates_of[method].sensor_errors
        if found is None:
            cells += [f"not found: {estimates_of[method].unsmoothed}", "–"]
            continue
        off = found.value - true
        said = (
            f"{name} {SHOWN[unit][0] * value:+.2f} ± {SHOWN[unit][0] * sigma:.2f} {SHOWN[unit][1]}"
            for name, value, sigma, unit in zip(found.NAMES, off, found.sigma, found.UNITS, strict=True)
        )
        cells += [", ".join(said), f"{off @ np.linalg.solve(found.covariance, off) / len(off):.2f}"]
    if after is not None:
        told = wrongly_told(*after, true)
        for flight in (told, true_flight(told, found)):
            odometry = make_odometry(after.settings.odometry, flight.T_drone_sensor)
            cells.append(f"{ate_mm(run(flight, odometry), after.truth):.1f}")
    return " | ".join(cells)


def ate_mm(estimate: Estimate, truth: Truth) -> float:
    """Unaligned absolute trajectory error, millimetres."""
    return 1e3 * score_trajectory(estimate.corrected, truth.trajectory)["ate_rmse_m"]


if __name__ == "__main__":
    main()
