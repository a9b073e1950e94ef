"""Position errors of `combined` and of `smoothed` on seeds that chose no setting, and the time of smoothing.

    PYTHONPATH=. .venv/bin/python benchmarks/smoothing.py [--seeds 101 102 …] [--sensor starling2]

Flights of 200 s, unaligned absolute trajectory errors in millimetres. Set STEELNB_CACHE to a folder to keep flights and
estimates between calls. Prints the table of smoothing.md.
"""

import argparse
import itertools
import time

import numpy as np

from shared import aligned_m
from steelnb import experiment
from steelnb.fusion import smooth
from steelnb.metrics import score_trajectory
from steelnb.settings import ExperimentSettings, TrajectoryName

FLIGHTS: tuple[TrajectoryName, ...] = ("zigzag", "loops")
NOISES = ("random-walk", "constant-drift", "random-walk+yaw-random-walk")
START = {"starling2": "combined", "report-4cm": "best"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(101, 106)))
    parser.add_argument("--sensor", choices=START, default="starling2")
    arguments = parser.parse_args()
    start = START[arguments.sensor]
    print(f"| flight | noise | uncorrected | {start} | smoothed, mean / worst seed | aligned | smoothing, s | seeds |")
    print("|---|---|---|---|---|---|---|---|")
    for flight_name, noise in itertools.product(FLIGHTS, NOISES):
        rows = np.array([measure(flight_name, noise, arguments.sensor, start, seed) for seed in arguments.seeds])
        raw, before, after, aligned, seconds = rows.T
        print(
            f"| {flight_name} | {noise} | {raw.mean():.0f} | {before.mean():.1f} | {after.mean():.1f} / "
            f"{after.max():.1f} | {aligned.mean():.1f} | {seconds.mean():.0f} | {len(rows)} |",
            flush=True,
        )


def measure(flight_name: TrajectoryName, noise: str, sensor: str, start: str, seed: int) -> tuple[float, ...]:
    """Errors without correction, of the odometry, smoothed, smoothed and aligned, in millimetres; seconds."""
    settings = ExperimentSettings.preset(flight_name, noise, sensor=sensor, seed=seed, method=start)
    flight, truth = experiment.simulate(settings)
    result = experiment.estimate(settings, flight, truth)
    begin_s = time.process_time()
    smoothed = smooth(flight, result)
    seconds = time.process_time() - begin_s
    after = score_trajectory(smoothed.corrected, truth.trajectory)["ate_rmse_m"]
    left = aligned_m(smoothed.corrected.position, truth.trajectory.at(flight.prior.stamp_s).position)
    aligned = float(np.sqrt((left**2).mean()))
    errors = result.metrics["raw_ate_rmse_m"], result.metrics["ate_rmse_m"], after, aligned
    return *(1e3 * error for error in errors), seconds


if __name__ == "__main__":
    main()
