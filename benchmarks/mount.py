"""Flights whose sensor is not where its owner says, or whose stamps are late: errors before and after estimating both.

`python benchmarks/mount.py ROWS.csv [CASE ...]` flies what ROWS.csv does not have yet, one row per flight, and prints
the table. `python benchmarks/mount.py --belief BELIEF.csv` writes what the odometry takes the mount for during two
flights. mount.md has the results, and notebook 09 draws them.
"""

import csv
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from limit import flight_information, mount_bound
from steelnb import experiment
from steelnb.core.estimates import OdometryStep
from steelnb.core.types import Array, Flight, RangeScans, Scan, Trajectory
from steelnb.fusion.adjustment.factors import DRIFT_SIGMA
from steelnb.fusion.adjustment.smooth import smooth
from steelnb.odometry import correct
from steelnb.odometry.base import run
from steelnb.odometry.methods import make_odometry
from steelnb.settings import ExperimentSettings, MountSettings, StructureSettings, TrajectoryName
from steelnb.simulation import Truth
from steelnb.simulation.drift import drifting

SENSOR, DURATION_S, SEED = "starling2", 120.0, 7021
STATED = 2
"""Number of seeds that are also corrected with the mount as stated. The bound is that of the first."""
VIO_SHARE, VIO_S = 0.01, 5.0
"""Drift of visual-inertial odometry: an error of the velocity of 1 % of the speed, correlated over 5 s."""
YAW_KNOWN = 0.04
"""The drift of these flights has no walk of yaw: smoothing measures this share of `DRIFT_SIGMA`."""
BOTH: tuple[TrajectoryName, ...] = ("zigzag", "loops")


class Case(NamedTuple):
    """What is wrong: roll, pitch, yaw in degrees and x, y, z in metres of the stated mount, or ``drawn``; ``late_s``;
    what the estimator is told (``known``); the drift, and the flights."""

    error: tuple[float, ...] = (0.0,) * 6
    late_s: float = 0.0
    known: MountSettings = MountSettings(rotation_sigma_deg=2.0, translation_sigma_m=0.03)
    vio: bool = False
    seeds: int = 1
    drawn: bool = False
    flights: tuple[TrajectoryName, ...] = BOTH


SMALL = MountSettings(rotation_sigma_deg=0.5, translation_sigma_m=0.005)
LATE = MountSettings(time_sigma_s=0.05)
ALL = (0.7, -1.0, 1.0, 0.015, 0.015, 0.0)
CASES = {
    "all six": Case(ALL, seeds=2),
    "drawn": Case(drawn=True, seeds=5),
    "all six, orbit and vertical": Case(ALL, flights=("orbit", "vertical")),
    "104 ms late": Case(late_s=0.104, known=LATE),
    "none": Case(seeds=2),
    "1.5° yaw and pitch": Case((0.0, 1.5, 1.5, 0.0, 0.0, 0.0)),
    "all six, VIO": Case(ALL, vio=True),
    "none, 0.5° and 5 mm allowed": Case(known=SMALL, seeds=2),
    "0.5° yaw and pitch": Case((0.0, 0.5, 0.5, 0.0, 0.0, 0.0)),
    "3° yaw and pitch": Case((0.0, 3.0, 3.0, 0.0, 0.0, 0.0)),
    "2 cm forward and left": Case((0.0, 0.0, 0.0, 0.02, 0.02, 0.0)),
    "48 ms late": Case(late_s=0.048, known=LATE),
    "none, VIO": Case(vio=True),
    "24 ms late": Case(late_s=0.024, known=LATE),
    "2° yaw and pitch, VIO": Case((0.0, 2.0, 2.0, 0.0, 0.0, 0.0), vio=True),
}  # fmt: skip


def vio(path: Trajectory, seed: int) -> Trajectory:
    """The path with the drift of visual-inertial odometry."""
    random, step_s = np.random.default_rng([seed, 99]), np.diff(path.stamp_s)
    step_m, share = np.linalg.norm(np.diff(path.position, axis=0), axis=1), VIO_SHARE / np.sqrt(3)
    velocity, error = random.standard_normal(3), np.zeros_like(path.position)
    for k, kept in enumerate(np.exp(-step_s / VIO_S)):
        velocity = kept * velocity + np.sqrt(1 - kept**2) * random.standard_normal(3)
        error[k + 1] = error[k] + share * step_m[k] * velocity
    T_world_drone = path.T_world_drone.copy()
    T_world_drone[:, :3, 3] += error
    return Trajectory(path.stamp_s, T_world_drone)


def flown(case: Case, trajectory: TrajectoryName, seed: int) -> tuple[Flight, Truth, ExperimentSettings, Array]:
    """The flight as its owner states it, with its truth, its settings and the true mount."""
    s = ExperimentSettings.preset(trajectory, "random-walk", "faces", SENSOR, seed, DURATION_S)
    flight, truth = experiment.simulate(s)
    path = vio(truth.trajectory, seed) if case.vio else drifting(truth.trajectory, s.noise, seed)
    error, T, scans = np.array(case.error), flight.T_drone_sensor.copy(), flight.scans
    if case.drawn:
        sigma = np.repeat([case.known.rotation_sigma_deg, case.known.translation_sigma_m], 3)
        error = sigma * np.random.default_rng([seed, 84]).standard_normal(6)
    T[:3, :3] = Rotation.from_euler("xyz", error[:3], degrees=True).as_matrix() @ T[:3, :3]
    T[:3, 3] += error[3:]
    stamp_s = flight.prior.stamp_s + case.late_s
    if case.late_s:
        assert isinstance(scans, RangeScans)
        count = int(np.count_nonzero(stamp_s <= truth.trajectory.stamp_s[-1]))
        stamp_s = stamp_s[:count]
        scans = RangeScans(stamp_s, scans.range_m[:count], scans.ray)
    stated = Flight(scans, path.at(stamp_s), T, flight.imu, path=path)
    return stated, truth, s, flight.T_drone_sensor


def squared(error: Array, covariance: Array) -> float:
    """Mean normalised squared error over rows and dimensions."""
    return float(
        np.einsum("ki,ki->k", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0]).mean() / error.shape[1]
    )


def row(name: str, trajectory: TrajectoryName, seed: int) -> dict[str, Any]:
    """The numbers of one flight; errors are root mean squares of unaligned positions, in mm."""
    case = CASES[name]
    flight, truth, s, T_true = flown(case, trajectory, seed)

    def error(path: Trajectory) -> Array:
        return path.position - truth.trajectory.at(path.stamp_s).position

    def rms_mm(path: Trajectory) -> float:
        return round(float(1e3 * np.sqrt((error(path) ** 2).sum(axis=1).mean())), 1)

    known = case.known.model_dump(exclude_defaults=True)
    told = s.odometry.override({f"mount.{key}": value for key, value in known.items()} | {"smooth": True})
    begin = time.process_time()
    faces = stated = None
    if seed < SEED + STATED:
        faces = correct(flight, s.odometry)
        between = time.process_time()
        stated = smooth(flight, faces, StructureSettings.of(s.odometry.preprocess))
    middle = time.process_time()
    found = correct(flight, told)
    end = time.process_time()
    online = run(flight, make_odometry(told, flight.T_drone_sensor)) if seed == SEED and name == "all six" else None
    sigma, stamp_s = case.known.sigma, flight.prior.stamp_s
    drift = DRIFT_SIGMA * [YAW_KNOWN, 1, 1, 1]
    if case.vio:
        drift = DRIFT_SIGMA * np.where(trajectory == "loops", 0.44, 0.11) * [YAW_KNOWN, 1, 1, 1]
    if seed == SEED:
        bound_mm, _ = mount_bound(flight_information(truth, s, stamp_s - case.late_s), stamp_s, sigma, drift)
    mount, covariance = found.mount, found.pose_covariance
    assert mount is not None
    off = np.zeros(7)
    off[:3] = Rotation.from_matrix(mount.T_drone_sensor[:3, :3] @ T_true[:3, :3].T).as_rotvec()
    off[3:6], off[6] = (mount.T_drone_sensor - T_true)[:3, 3], mount.late_s - case.late_s
    numbers: dict[str, Any] = {
        "case": name, "flight": trajectory, "seed": seed,
        "none": rms_mm(flight.prior), "faces": rms_mm(faces.corrected) if faces else "",
        "smoothed": rms_mm(stated.corrected) if stated else "",
        "online": rms_mm(online.corrected) if online else "", "estimated": rms_mm(found.corrected),
        "bound": round(bound_mm, 1) if seed == SEED else "", "nees": "", "mount_nees": "",
        "roll_deg": round(np.degrees(off[0]), 3), "pitch_deg": round(np.degrees(off[1]), 3),
        "yaw_deg": round(np.degrees(off[2]), 3), "off_mm": round(1e3 * np.linalg.norm(off[3:6]), 1),
        "off_ms": round(1e3 * off[6], 2), "faces_s": round(between - begin) if faces else "",
        "smooth_s": round(middle - between) if stated else "",
        "estimated_s": round(end - middle),
    }  # fmt: skip
    if covariance is not None and mount.covariance is not None:
        free = np.flatnonzero(sigma)
        numbers["nees"] = round(squared(error(found.corrected)[1:], covariance[1:, :3, :3]), 2)
        numbers["mount_nees"] = round(squared(off[None, free], mount.covariance[np.ix_(free, free)][None]), 2)
    return numbers


def missing(rows: Path, names: list[str]) -> Iterator[tuple[str, TrajectoryName, int]]:
    """Case, flight and seed of each row that the file does not have."""
    done = set()
    if rows.exists():
        done = set(pd.read_csv(rows)[["case", "flight", "seed"]].itertuples(index=False, name=None))
    for name in names:
        case = CASES[name]
        for seed in range(SEED, SEED + case.seeds):
            for trajectory in case.flights:
                if (name, trajectory, seed) not in done:
                    yield name, trajectory, seed


def belief(trajectory: TrajectoryName) -> pd.DataFrame:
    """The error that an odometry takes the stated mount to have, a row per part (``roll_deg`` … ``z_mm``) after
    each change; in the last ones, those of smoothing, with standard deviations. ``true``: the error that it has."""
    case, rows = CASES["all six"], list[Array]()
    flight, _, s, T_true = flown(case, trajectory, SEED)
    known = {f"mount.{key}": value for key, value in case.known.model_dump().items()}
    told = s.odometry.override(known | {"smooth": True})
    odometry, unit = make_odometry(told, flight.T_drone_sensor), np.repeat([180 / np.pi, 1e3], 3)

    def step(T: Array) -> Array:
        turn = Rotation.from_matrix(T[:3, :3] @ flight.T_drone_sensor[:3, :3].T).as_rotvec()
        return unit * np.append(turn, (T - flight.T_drone_sensor)[:3, 3])

    def note(k: int, scan: Scan, result: OdometryStep) -> None:
        found = np.append(scan.stamp_s, step(odometry.T_drone_sensor))
        if not rows or (rows[-1][1:] != found[1:]).any():
            rows.append(found)

    run(flight, odometry, note)
    mount = correct(flight, told).mount
    assert mount is not None
    assert mount.covariance is not None
    rows.append(np.append(flight.prior.stamp_s[-1], unit * mount.step[:6]))
    parts = ["roll_deg", "pitch_deg", "yaw_deg", "x_mm", "y_mm", "z_mm"]
    table = pd.DataFrame(rows, columns=["time_s", *parts]).melt("time_s", var_name="part", value_name="found")
    sigma = dict(zip(parts, unit * np.sqrt(np.diag(mount.covariance)[:6]), strict=True))
    is_last = table["time_s"] == flight.prior.stamp_s[-1]
    table["sigma"] = table["part"].map(sigma).where(is_last)
    table["true"] = table["part"].map(dict(zip(parts, step(T_true), strict=True)))
    return table.assign(flight=trajectory).round(4)


def main() -> None:
    if sys.argv[1] == "--belief":
        pd.concat(map(belief, BOTH)).to_csv(sys.argv[2], index=False)
        return
    rows, names = Path(sys.argv[1]), sys.argv[2:] or list(CASES)
    for each in missing(rows, names):
        numbers, starts = row(*each), not rows.exists()
        with rows.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(numbers))
            if starts:
                writer.writeheader()
            writer.writerow(numbers)
        print(numbers, flush=True)
    table = pd.read_csv(rows).drop(columns="seed").groupby(["case", "flight"], sort=False)
    print(table.mean(numeric_only=True).round(2).assign(flights=table.size()).to_markdown())


if __name__ == "__main__":
    main()
