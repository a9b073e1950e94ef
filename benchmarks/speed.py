"""Speed and memory of the simulation and of one frame of segment odometry, on one core. Run by hand:

    taskset -c 0 .venv/bin/python benchmarks/speed.py > benchmarks/speed.md

Seconds belong to the machine named in the table; on another only their ratios hold.
"""

import resource
import time

import numpy as np

from steelnb import experiment
from steelnb.config import SENSORS, TRAJECTORIES, ExperimentSettings
from steelnb.odometry import SegmentOdometry
from steelnb.results import machine
from steelnb.simulation import build_tower, fly, scan_flight


def main() -> None:
    tower = build_tower()
    print(f"# Speed on one core\n\n{machine()}. `{__doc__.split('by hand:')[1].split('>')[0].strip()}`\n")
    print("| flight, sensor | flight, × real time | scans, Mrays/s | frame median (ms) | p95 (ms) | of it Hough (ms) |")
    print("|---|---|---|---|---|---|")
    for trajectory in TRAJECTORIES:
        for sensor in SENSORS:
            s = ExperimentSettings.preset(trajectory, "random-walk", "least_squares", sensor)
            if trajectory == TRAJECTORIES[0] and sensor == SENSORS[0]:  # imports and compilation, not timed
                experiment.run(ExperimentSettings.preset(sensor="report", duration_s=2.0))
                experiment.run(ExperimentSettings.preset(duration_s=2.0))
            began = time.perf_counter()
            truth, _ = fly(tower, s.flight, s.seed)
            flown = time.perf_counter()
            scans, _ = scan_flight(tower, truth, experiment.T_DRONE_SENSOR, s.tof, s.seed)
            scanned = time.perf_counter()
            odometry = SegmentOdometry(s.preprocess, s.hough, s.fusion, s.odometry, experiment.T_DRONE_SENSOR)
            poses = truth.at(scans.stamp_s).T_world_drone
            steps = [odometry.update(scan, T) for scan, T in zip(scans, poses, strict=True)]
            frame = 1e3 * np.array([sum(step.seconds.values()) for step in steps])
            hough = 1e3 * np.median([step.seconds["hough"] for step in steps])
            print(
                f"| {trajectory}, {sensor} | {s.flight.duration_s / (flown - began):.0f} "
                f"| {scans.range_m.size / (scanned - flown) / 1e6:.1f} | {np.median(frame):.1f} "
                f"| {np.percentile(frame, 95):.1f} | {hough:.1f} |",
                flush=True,
            )
            del scans
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"\nPeak memory of the process: {peak:.2f} GiB. The goals: 50 × real time, 5 million rays/s, 30 ms.")


if __name__ == "__main__":
    main()
