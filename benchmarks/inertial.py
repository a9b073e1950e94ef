"""What the readings of an IMU do between scans and for smoothing, on flights with the honest sensor, which has one.

    PYTHONPATH=. .venv/bin/python benchmarks/inertial.py [--seeds 101 102 …] [--duration 200] [--flight zigzag loops]

Roll and pitch of the prior are those of a filter. Prints a row a flight: errors of `combined` and `faces` without and
with the IMU, and of smoothing with the prior's roll and pitch as they are, with their standard deviation stated, and
with the IMU; then how far roll and pitch are off. See inertial.md.
"""

import argparse
from typing import Any

import numpy as np

from steelnb import experiment
from steelnb.metrics import score_trajectory
from steelnb.odometry import make_odometry, run_kept
from steelnb.odometry.run import smoothed
from steelnb.report.honest import HONEST
from steelnb.settings import ExperimentSettings, OdometrySettings, TrajectoryName
from steelnb.types import Estimate, Trajectory

KINDS: dict[str, tuple[str, dict[str, Any]]] = {
    "combined": ("combined", {"inertial": None}),
    "combined, IMU": ("combined", {}),
    "faces": ("faces", {"inertial": None}),
    "faces, IMU": ("faces", {}),
    "smoothed": ("smoothed", {"inertial": None}),
    "smoothed, tilt 1°": ("smoothed", {"inertial": None, "tilt_sigma_rad": 0.0175}),
    "smoothed, IMU": ("smoothed", {}),
    "calibrated, IMU": ("calibrated", {}),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102])
    parser.add_argument("--duration", type=float, default=200.0)
    parser.add_argument("--flight", choices=("zigzag", "loops"), nargs="+", default=("zigzag", "loops"))
    arguments = parser.parse_args()
    print(f"| flight | seed | {' | '.join(KINDS)} (mm) | roll and pitch: prior | with the IMU (°, rms) |")
    print("|---|---|" + "---|" * (len(KINDS) + 2))
    for name in arguments.flight:
        for seed in arguments.seeds:
            print(f"| {name} | {seed} | {row(name, seed, arguments.duration)} |", flush=True)


def row(flight_name: TrajectoryName, seed: int, duration_s: float) -> str:
    """Position errors of each of `KINDS`, and the leans of the prior and of the one with the IMU."""
    usual: dict[str, Any] = {"sensor": HONEST, "seed": seed, "duration_s": duration_s}
    flight, truth = experiment.simulate(ExperimentSettings.preset(flight_name, "random-walk", **usual))
    true = truth.trajectory.at(flight.prior.stamp_s)
    found: dict[str, Estimate] = {}
    for kind, (method, changed) in KINDS.items():
        settings = OdometrySettings.preset(method, HONEST, changed)
        odometry = make_odometry(settings, flight.T_drone_sensor, flight.imu)
        online = found.get("combined, IMU" if settings.inertial else "combined")
        found[kind] = smoothed(flight, online, odometry) if settings.smooth and online else run_kept(flight, odometry)
    ate = [f"{1e3 * score_trajectory(each.corrected, truth.trajectory)['ate_rmse_m']:.1f}" for each in found.values()]
    leans = [lean_deg(each, true) for each in (flight.prior, found["smoothed, IMU"].corrected)]
    return " | ".join([*ate, *(f"{lean:.3f}" for lean in leans)])


def lean_deg(trajectory: Trajectory, true: Trajectory) -> float:
    """Root mean square angle between the verticals of two trajectories, degrees."""
    up = np.cross(trajectory.T_world_drone[:, 2, :3], true.T_world_drone[:, 2, :3])
    return float(np.degrees(np.sqrt((up**2).sum(axis=1).mean())))


if __name__ == "__main__":
    main()
