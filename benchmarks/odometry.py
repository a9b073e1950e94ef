"""Every odometry scan by scan, beside third-party ones: time and error on one pinned core.

    .venv/bin/python benchmarks/odometry.py > benchmarks/odometry.md

KISS-ICP and small_gicp come with `pip install 'steelnb[peers]'`. Their voxel is the only setting not at its default, so
every value that was tried has a row. Times depend on the machine in the table, ratios less so.
"""

from shared import command  # first, as it pins the core

# isort: split
import importlib.metadata
import time

import numpy as np

from steelnb import experiment
from steelnb.core.determinism import machine
from steelnb.core.types import Array, Flight, Trajectory
from steelnb.metrics import position_error_m
from steelnb.odometry import make_odometry
from steelnb.settings import ExperimentSettings, OdometrySettings, TrajectoryName
from steelnb.simulation import Truth

FLIGHTS: tuple[TrajectoryName, ...] = ("zigzag", "loops")
OURS = ("least_squares", "least_squares_yaw", "icp", "icp-3dof", "gicp", "best", "faces", "loam")
PEERS = {"kiss-icp": "kiss-icp", "small-gicp": "small_gicp"}
"""Method → the name of its wheel."""
VOXELS_M = (0.1, 0.2, 0.4)
SEED, DURATION_S = 11, 30.0
BESIDE = "small-gicp, voxel 0.2 m"
NOTES = """{}, one thread. The prior predicts the motion of each scan.
Flights last {:g} s, with a random walk, a Starling 2's sensor and seed {}. Columns: CPU time per scan, ratio of the
median to that of {}, and unaligned absolute trajectory error. All methods get the same scans in
one process; imports, compilation and the first scan are not counted. `faces` adjusts poses and bars
every ten seconds, which a second core can do.

| flight | odometry | median (ms) | p95 (ms) | ratio | error (mm) |
|---|---|---|---|---|---|"""


def cases() -> dict[str, OdometrySettings]:
    """The odometries by the names of their rows."""
    found: dict[str, OdometrySettings] = {name: ExperimentSettings.preset(method=name).odometry for name in OURS}
    for name in PEERS:
        settings = ExperimentSettings.preset(method=name).odometry
        for voxel_m in VOXELS_M:
            found[f"{name}, voxel {voxel_m:g} m"] = settings.override({"preprocess.voxel_leaf_m": voxel_m})
    return found


def measured(settings: OdometrySettings, flight: Flight, truth: Truth) -> tuple[Array, float]:
    """Milliseconds of every scan but the first, and the error in millimetres."""
    odometry, seconds, poses = make_odometry(settings, flight.T_drone_sensor, flight.imu), [], []
    for scan, T_world_drone in zip(flight.scans, flight.prior.T_world_drone, strict=True):
        began = time.process_time()
        poses.append(odometry.update(scan, T_world_drone).T_world_drone)
        seconds.append(time.process_time() - began)
    error_m = position_error_m(Trajectory(flight.prior.stamp_s, np.array(poses)), truth.trajectory)
    return 1e3 * np.array(seconds[1:]), 1e3 * float(np.sqrt(np.mean(error_m**2)))


def main() -> None:
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in PEERS.values())
    print(f"# Odometry scan by scan on one core\n\n{machine()}. `{command(__doc__)}`\n")
    print(NOTES.format(versions, DURATION_S, SEED, BESIDE))
    warm = experiment.simulate(ExperimentSettings.preset(duration_s=3.0))
    for settings in cases().values():
        measured(settings, *warm)
    for trajectory in FLIGHTS:
        given = ExperimentSettings.preset(trajectory, "random-walk", seed=SEED, duration_s=DURATION_S)
        flown = experiment.simulate(given)
        found = {name: measured(settings, *flown) for name, settings in cases().items()}
        beside = np.median(found[BESIDE][0])
        for name, (ms, error_mm) in found.items():
            median, p95 = np.median(ms), np.percentile(ms, 95)
            print(f"| {trajectory} | {name} | {median:.1f} | {p95:.1f} | {median / beside:.2f} | {error_mm:.0f} |")


if __name__ == "__main__":
    main()
