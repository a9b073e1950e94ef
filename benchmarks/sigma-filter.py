"""Position errors of odometry by clouds with and without the sigma filter on range images.

    PYTHONPATH=. .venv/bin/python benchmarks/sigma-filter.py [--seeds 11 12] [--duration 30]

Unaligned absolute trajectory errors in millimetres under the random walk, and the median time of the filter for a scan.
Prints the tables of sigma-filter.md.
"""

import argparse
import time

import numpy as np

from steelnb import experiment
from steelnb.points import smooth_ranges
from steelnb.settings import ExperimentSettings, TrajectoryName
from steelnb.types import Flight

FLIGHTS: tuple[TrajectoryName, ...] = ("zigzag", "loops")
SENSORS = {
    "σ 1 % of the range, as in the preset": ("starling2", {}),
    "σ 2 %": ("starling2", {"tof.sigma_relative": 0.02}),
    "all faults of a real sensor": ("starling2-honest", {}),
}
HALVES = (0, 1)
METHODS = ("best", "combined")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12])
    parser.add_argument("--duration", type=float, default=30.0)
    arguments = parser.parse_args()
    print("| sensor | flight | method | " + " | ".join(map(heading, HALVES)) + " |")
    print("|---|---|---|" + "---|" * len(HALVES))
    for name, (sensor, faults) in SENSORS.items():
        for flight_name in FLIGHTS:
            errors: dict[tuple[str, int], list[float]] = {}
            for seed in arguments.seeds:
                usual = {"sensor": sensor, "seed": seed, "duration_s": arguments.duration}
                flown = ExperimentSettings.preset(flight_name, "random-walk", **usual, overrides=faults)
                flight, truth = experiment.simulate(flown)
                for method in METHODS:
                    for half in HALVES:
                        told = {"clouds.sigma_filter_px": half}
                        settings = ExperimentSettings.preset(
                            flight_name, "random-walk", **usual, method=method, overrides=faults | told
                        )
                        ate = 1e3 * experiment.estimate(settings, flight, truth).metrics["ate_rmse_m"]
                        errors.setdefault((method, half), []).append(ate)
            for method in METHODS:
                said = [f"{np.mean(each):.1f} ({max(each):.1f})" for each in (errors[method, h] for h in HALVES)]
                print(f"| {name} | {flight_name} | `{method}` | {' | '.join(said)} |", flush=True)
    print("\n" + ", ".join(f"{heading(half)}: {filter_ms(flight, half):.1f} ms" for half in HALVES[1:]) + " a scan")


def heading(half: int) -> str:
    """The window of a filter."""
    return f"{2 * half + 1} × {2 * half + 1}" if half else "none"


def filter_ms(flight: Flight, half: int) -> float:
    """Median time of the filter for a scan, milliseconds."""
    seconds = []
    for scan in flight.scans:
        begin = time.perf_counter()
        smooth_ranges(scan.points, half)
        seconds.append(time.perf_counter() - begin)
    return 1e3 * float(np.median(seconds))


if __name__ == "__main__":
    main()
