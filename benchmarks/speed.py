"""Speed and memory of the simulation and of one frame of every odometry, on one core. Run by hand:

    taskset -c 0 .venv/bin/python benchmarks/speed.py > benchmarks/speed.md

Seconds belong to the machine named in the table; on another only their ratios hold.
"""

import time

import numpy as np

from shared import command, map_mb, peak_bytes
from steelnb import experiment
from steelnb.noise import drifting
from steelnb.odometry import CloudOdometry, make_odometry
from steelnb.points import preprocess_scan
from steelnb.report.results import machine
from steelnb.settings import ExperimentSettings, TrajectoryName
from steelnb.simulation import build_tower, fly, scan_flight
from steelnb.types import Flight

FLOWN: tuple[TrajectoryName, ...] = ("zigzag", "loops")
SENSORS = ("report-4cm", "starling2")
METHODS: tuple[str, ...] = ("least_squares", "least_squares_yaw", "icp", "icp-3dof", "gicp", "best", "combined")
FLIGHTS = "| flight, sensor | flight, × real time | scans, million rays/s | points a frame |"
FRAMES = "| flight, sensor | odometry | median (ms) | p95 (ms) | stages, median (ms) | last tenth / first | map (MB) |"

NOTE = """The goals: 50 × real time, 5 million rays/s.

## One frame, under a random walk

*Last tenth / first*: time per point in the last tenth of the 200 s against that in the first, whose frames have fewer
points than the last."""
GOALS = """The goals: segments 30 ms; `best` 10 ms, p95 20 ms,
growth 1.2, 100 MB; `combined` 25 ms."""


def main() -> None:
    for method in METHODS:  # imports and compilation, not timed
        experiment.run(ExperimentSettings.preset(duration_s=3.0, method=method))
    print(f"# Speed on one core\n\n{machine()}. `{command(__doc__)}`\n")
    print(f"{FLIGHTS}\n{'|---' * (FLIGHTS.count('|') - 1)}|")
    frames = [row for t in FLOWN for sensor in SENSORS for row in measure(t, sensor)]
    print(f"\n{NOTE}\n\n{FRAMES}\n{'|---' * (FRAMES.count('|') - 1)}|")
    print("\n".join(frames))
    peak = peak_bytes() / 2**30
    print(f"\nPeak memory of the process: {peak:.2f} GiB. {GOALS}")


def measure(trajectory: TrajectoryName, sensor: str) -> list[str]:
    """Print a row on a flight and its scans; give the rows of its odometries."""
    s = ExperimentSettings.preset(trajectory, "random-walk", sensor=sensor)
    tower = build_tower(s.tower)
    began = time.perf_counter()
    truth, imu = fly(tower, s.flight, s.seed)
    flown = time.perf_counter()
    scans, _ = scan_flight(tower, truth, s.tof.T_drone_sensor, s.tof, s.seed)
    scanned = time.perf_counter()
    flight = Flight(scans, drifting(truth, s.noise, s.seed).at(scans.stamp_s), s.tof.T_drone_sensor, imu)
    rows = []
    for method in METHODS:
        case = ExperimentSettings.preset(trajectory, "random-walk", sensor=sensor, method=method)
        odometry = make_odometry(case.odometry, flight.T_drone_sensor, flight.imu)
        steps = [odometry.update(*frame) for frame in zip(scans, flight.prior.T_world_drone, strict=True)]
        frame = 1e3 * np.array([sum(step.seconds.values()) for step in steps])
        points = np.array([
            len(preprocess_scan(scan, T, flight.T_drone_sensor, case.odometry.preprocess))
            for scan, T in zip(scans[::5], flight.prior.T_world_drone[::5], strict=True)
        ])  # fmt: skip
        tenth = len(points) // 10
        each = np.add.reduceat(frame, np.arange(0, len(frame), 5)) / np.maximum(points, 1)
        growth = np.median(each[-tenth:]) / np.median(each[1 : tenth + 1])
        stages = ", ".join(
            f"{name} {1e3 * np.median([x.seconds[name] for x in steps]):.1f}" for name in steps[0].seconds
        )
        size = f"{map_mb(odometry.map):.0f}" if isinstance(odometry, CloudOdometry) else ""
        rows.append(
            f"| {trajectory}, {sensor} | {method} | {np.median(frame):.1f} | {np.percentile(frame, 95):.1f} | {stages} "
            f"| {growth:.2f} | {size} |"
        )
    print(
        f"| {trajectory}, {sensor} | {s.flight.duration_s / (flown - began):.0f} "
        f"| {scans.range_m.size / (scanned - flown) / 1e6:.1f} | {np.median(points):.0f} |",
        flush=True,
    )
    return rows


if __name__ == "__main__":
    main()
