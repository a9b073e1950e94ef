"""Odometries that others maintain, on the flights of notebook 17: KISS-ICP, and small_gicp's VGICP to a voxel map.

Run: .venv/bin/python benchmarks/peers.py [--seeds 21 22 23] [--voxels 0.05 0.1 0.2] > benchmarks/peers.md
KISS-ICP (`pip install kiss-icp`) is not in the lock. Each peer starts at the first pose of the prior and predicts the
next scan by the prior's increment, as our own odometries do, KISS-ICP also by its own constant velocity. The voxel is
the one with the smallest error on other seeds (`--choose`); everything else is the peer's default. Beside them are
`loam-midlines` and `combined`, on the same flights.
"""

import argparse
import importlib.metadata
import shlex
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import small_gicp
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP

from steelnb import experiment
from steelnb.metrics import score_trajectory
from steelnb.odometry import make_odometry, run
from steelnb.report.results import machine
from steelnb.settings import ExperimentSettings, TrajectoryName
from steelnb.types import Array, Flight, Trajectory

FLIGHTS: tuple[TrajectoryName, ...] = ("vertical", "orbit")
NEIGHBOURS = 10
"""Of a point's covariance, as in small_gicp's own example of an odometry."""
Register = Callable[[Array, Array], Array]
"""Points of a scan ``(N, 3)`` in the sensor's frame and the increment that the prior predicts → pose of the sensor."""


def kiss_icp(voxel_m: float, first: Array, range_max_m: float, prior: bool) -> Register:
    config = KISSConfig()
    config.data.max_range, config.data.deskew = range_max_m, False
    config.mapping.voxel_size, config.registration.max_num_threads = voxel_m, 1
    peer = KissICP(config)
    peer.last_pose = first

    def register(points: Array, increment: Array) -> Array:
        if prior:
            peer.last_delta = increment
        peer.register_frame(points, np.zeros(0))
        return peer.last_pose

    return register


def vgicp(voxel_m: float, first: Array, range_max_m: float, prior: bool) -> Register:
    target, pose = small_gicp.GaussianVoxelMap(voxel_m), [first]

    def register(points: Array, increment: Array) -> Array:
        near = points[np.linalg.norm(points, axis=1) < range_max_m]
        source, _ = small_gicp.preprocess_points(near, voxel_m / 4, NEIGHBOURS)
        if target.size():
            guess = pose[0] @ increment
            pose[0] = small_gicp.align(target, source, guess, voxel_m).T_target_source
        target.insert(source, pose[0])
        return pose[0]

    return register


PEERS: dict[str, tuple[Callable[[float, Array, float, bool], Register], bool]] = {
    "KISS-ICP": (kiss_icp, False),
    "KISS-ICP, predicted by the prior": (kiss_icp, True),
    "small_gicp VGICP, predicted by the prior": (vgicp, True),
}


def fly(seeds: list[int], duration_s: float) -> Iterator[tuple[TrajectoryName, ExperimentSettings, Flight, Trajectory]]:
    for trajectory in FLIGHTS:
        for seed in seeds:
            settings = ExperimentSettings.preset(
                trajectory, "random-walk", method="combined", sensor="starling2", seed=seed, duration_s=duration_s
            )
            flight, truth = experiment.simulate(settings)
            yield trajectory, settings, flight, truth.trajectory


def drive(name: str, voxel_m: float, flight: Flight, range_max_m: float) -> tuple[Trajectory, float]:
    """The poses of the drone by a peer, and the median of its milliseconds a frame."""
    T_world_sensor = flight.prior.T_world_drone @ flight.T_drone_sensor
    make, prior = PEERS[name]
    register = make(voxel_m, T_world_sensor[0], range_max_m, prior)
    increments = np.linalg.inv(T_world_sensor[:-1]) @ T_world_sensor[1:]
    poses, taken_ms = [], []
    for scan, increment in zip(flight.scans, [np.eye(4), *increments], strict=True):
        points = scan.points.reshape(-1, 3)
        points = np.ascontiguousarray(points[np.isfinite(points).all(axis=1)], dtype=float)
        start = time.perf_counter()
        poses.append(register(points, increment))
        taken_ms.append(1e3 * (time.perf_counter() - start))
    T_sensor_drone = np.linalg.inv(flight.T_drone_sensor)
    return Trajectory(flight.prior.stamp_s, np.array(poses) @ T_sensor_drone), float(np.median(taken_ms))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[21, 22, 23])
    parser.add_argument("--choose", type=int, nargs="+", default=[11, 12], help="seeds that choose the voxel")
    parser.add_argument("--voxels", type=float, nargs="+", default=[0.05, 0.1, 0.2, 0.4], help="metres")
    parser.add_argument("--duration", type=float, default=200.0, help="seconds")
    asked = parser.parse_args()
    tried: dict[tuple[str, float], list[float]] = {}
    for _, settings, flight, truth in fly(asked.choose, asked.duration / 2):
        for name in PEERS:
            for voxel_m in asked.voxels:
                found, _ = drive(name, voxel_m, flight, settings.tof.range_max_m)
                tried.setdefault((name, voxel_m), []).append(score_trajectory(found, truth)["ate_rmse_m"])
    mean_m = {pair: float(np.mean(values)) for pair, values in tried.items()}
    chosen = {name: min(asked.voxels, key=lambda voxel_m: mean_m[name, voxel_m]) for name in PEERS}
    errors: dict[tuple[str, str], list[float]] = {}
    times: dict[str, list[float]] = {}
    for trajectory, settings, flight, truth in fly(asked.seeds, asked.duration):
        for name, voxel_m in chosen.items():
            found, taken_ms = drive(name, voxel_m, flight, settings.tof.range_max_m)
            errors.setdefault((name, trajectory), []).append(score_trajectory(found, truth)["ate_rmse_m"])
            times.setdefault(name, []).append(taken_ms)
        for method in ("loam-midlines", "combined"):
            own = ExperimentSettings.preset(trajectory, "random-walk", method=method, sensor="starling2")
            estimate = run(flight, make_odometry(own.odometry, flight.T_drone_sensor, flight.imu))
            score = score_trajectory(estimate.corrected, truth)["ate_rmse_m"]
            errors.setdefault((method, trajectory), []).append(score)
            times.setdefault(method, []).append(1e3 * float(np.median(estimate.update_s)))
        drift = score_trajectory(flight.prior, truth)["ate_rmse_m"]
        errors.setdefault(("the drifting prior", trajectory), []).append(drift)
    seeds = " ".join(map(str, asked.seeds))
    print("# Odometries that others maintain, on the flights of notebook 17\n")
    print(f"{machine()}. `.venv/bin/python {shlex.join(sys.argv)}`\n")
    print(
        f"Flights of {asked.duration:g} s under the random walk with a Starling 2's sensor; absolute trajectory error, "
        f"unaligned, mean (worst) of seeds {seeds},\nmillimetres. KISS-ICP {importlib.metadata.version('kiss-icp')}, "
        f"small_gicp {importlib.metadata.version('small_gicp')}, one thread.\n"
    )
    print("| odometry | voxel (m) | vertical | orbit | frame (ms) |\n|---|---|---|---|---|")
    for name in dict.fromkeys(name for name, _ in errors):
        cells = [1e3 * np.array(errors[name, trajectory]) for trajectory in FLIGHTS]
        shown = " | ".join(f"{values.mean():.0f} ({values.max():.0f})" for values in cells)
        print(f"| {name} | {chosen.get(name, '–')} | {shown} | {np.mean(times[name]):.0f} |" if name in times
              else f"| {name} | – | {shown} | – |")  # fmt: skip
    print(
        f"\nThe voxel was chosen on seeds {' '.join(map(str, asked.choose))}, {asked.duration / 2:g} s; mean ATE, mm:\n"
    )
    print("| voxel (m) |", " | ".join(f"{voxel_m:g}" for voxel_m in asked.voxels), "|")
    print("|---|" + "---|" * len(asked.voxels))
    for name in PEERS:
        print(f"| {name} |", " | ".join(f"{1e3 * mean_m[name, voxel_m]:.0f}" for voxel_m in asked.voxels), "|")


if __name__ == "__main__":
    main()
