"""The voxel of the methods `kiss-icp` and `small-gicp`, chosen on development seeds.

Run: .venv/bin/python benchmarks/peers.py [--seeds 11 12] [--voxels 0.05 0.1 0.2 0.4] > benchmarks/peers.md
KISS-ICP and small_gicp come with the package; the voxel is the one setting of theirs that notebook
17 does not leave at its default.
"""

import argparse
import importlib.metadata
import shlex
import sys

import numpy as np

from steelnb import experiment
from steelnb.metrics import score_trajectory
from steelnb.odometry import make_odometry, run
from steelnb.report.results import machine
from steelnb.settings import ExperimentSettings, TrajectoryName

FLIGHTS: tuple[TrajectoryName, ...] = ("zigzag", "loops")
PEERS = {"kiss-icp": "kiss-icp", "small-gicp": "small_gicp"}
"""Method → the name of its wheel."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12])
    parser.add_argument("--voxels", type=float, nargs="+", default=[0.05, 0.1, 0.2, 0.4], help="metres")
    parser.add_argument("--duration", type=float, default=30.0, help="seconds")
    asked = parser.parse_args()
    error_mm: dict[tuple[str, float, str], list[float]] = {}
    for trajectory in FLIGHTS:
        for seed in asked.seeds:
            settings = ExperimentSettings.preset(
                trajectory, "random-walk", "kiss-icp", "starling2", seed=seed, duration_s=asked.duration
            )
            flight, truth = experiment.simulate(settings)
            for method in PEERS:
                for voxel_m in asked.voxels:
                    chosen = ExperimentSettings.preset(trajectory, "random-walk", method, "starling2").odometry
                    chosen = chosen.override({"preprocess.voxel_leaf_m": voxel_m})
                    found = run(flight, make_odometry(chosen, flight.T_drone_sensor))
                    score = score_trajectory(found.corrected, truth.trajectory)["ate_rmse_m"]
                    error_mm.setdefault((method, voxel_m, trajectory), []).append(1e3 * score)
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in PEERS.values())
    print("# The voxel of odometries that others maintain\n")
    print(f"{machine()}. `.venv/bin/python {shlex.join(sys.argv)}`\n")
    seeds = " ".join(map(str, asked.seeds))
    print(
        f"{versions}, one thread, each scan's motion predicted by the prior. Flights of {asked.duration:g} s under "
        f"the random walk with a\nStarling 2's sensor, seeds {seeds}: mean absolute trajectory error, unaligned, mm, "
        "zigzag / loops.\n"
    )
    print("| voxel (m) |", " | ".join(f"{voxel_m:g}" for voxel_m in asked.voxels), "|")
    print("|---|" + "---|" * len(asked.voxels))
    for method in PEERS:
        cells = [
            " / ".join(f"{np.mean(error_mm[method, voxel_m, trajectory]):.0f}" for trajectory in FLIGHTS)
            for voxel_m in asked.voxels
        ]
        print(f"| {method} |", " | ".join(cells), "|")


if __name__ == "__main__":
    main()
