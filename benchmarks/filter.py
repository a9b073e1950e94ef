"""How far off the filter of `faces` is, in units of what it claims, with the faults of a real sensor and IMU.

    .venv/bin/python benchmarks/filter.py 21 22 23 24 25

Normalised squared errors (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
section 5.4) are 1 if a filter is as uncertain as it says. Prints the tables of filter.md, for the seeds that are given.
A flight takes about five minutes.
"""

import sys

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.core.determinism import machine
from steelnb.core.geometry import pose_difference
from steelnb.core.types import Array, Flight, Imu
from steelnb.fusion.adjustment.imu_factors import FORCE, GYRO, POSITION, ROTATION, VELOCITY
from steelnb.fusion.adjustment.smooth import with_range_sigmas
from steelnb.odometry import make_odometry, run
from steelnb.odometry.faces import FaceOdometry
from steelnb.odometry.inertial import InertialPrediction, State
from steelnb.points.ranges import calibrated
from steelnb.settings import ExperimentSettings, StructureSettings, TrajectoryName
from steelnb.simulation import Truth, fly, measured_imu

FLIGHTS: tuple[TrajectoryName, ...] = ("zigzag", "loops")
TOLD = "position, told"
"""With the standard deviations of scale and offset that the sensor's preset tells, those of its data sheet."""
DURATION_S, FIRST_S = 200.0, 30.0
DIFFERENCE_S = 0.01
"""Half of the interval over which true positions are differentiated."""
PARTS = {
    "position": POSITION, "velocity": VELOCITY, "roll, pitch": slice(ROTATION.start, ROTATION.start + 2),
    "heading": slice(ROTATION.start + 2, ROTATION.stop), "gyroscope": GYRO, "accelerometer": FORCE,
}  # fmt: skip


def states_of(settings: ExperimentSettings, flight: Flight) -> list[State]:
    """The state of the filter after each scan."""
    odometry = make_odometry(settings.odometry, flight.T_drone_sensor, flight.imu)
    assert isinstance(odometry, FaceOdometry)
    prediction, states = odometry.prediction, list[State | None]()
    assert isinstance(prediction, InertialPrediction)
    run(flight, odometry, lambda *_: states.append(prediction.state))
    return [state for state in states if state]


def biases(settings: ExperimentSettings, exact: Imu, stamp_s: Array) -> Array:
    """True biases ``(K, 6)`` of gyroscope and accelerometer at the stamps."""
    assert settings.imu is not None
    read = measured_imu(exact, settings.imu.replace(gyro_noise=0.0, accelerometer_noise=0.0), settings.seed)
    nearest = np.searchsorted(exact.stamp_s, stamp_s).clip(max=len(exact.stamp_s) - 1)
    apart = np.hstack([read.angular_rate - exact.angular_rate, read.specific_force - exact.specific_force])
    return np.asarray(apart[nearest])


def squares(settings: ExperimentSettings, flight: Flight, states: list[State], truth: Truth) -> pd.DataFrame:
    """Normalised squared errors, a row per scan."""
    stamp_s = np.array([state.stamp_s for state in states])
    told, structure = calibrated(flight, settings.tof), StructureSettings.of(settings.odometry.preprocess)
    T = np.array([state.T_world_drone for state in states]) @ flight.T_drone_sensor
    stretch = with_range_sigmas(np.zeros((len(states), 6, 6)), told, T, structure)[:, :3, :3]
    _, exact = fly(truth.tower, settings.flight, settings.seed)
    path, bias = truth.trajectory, biases(settings, exact, stamp_s)
    true = path.between(stamp_s)
    before_s, after_s = (np.clip(stamp_s + by, *path.stamp_s[[0, -1]]) for by in (-DIFFERENCE_S, DIFFERENCE_S))
    velocity = (path.between(after_s) - path.between(before_s))[:, :3, 3] / (after_s - before_s)[:, None]
    rows = []
    for k, state in enumerate(states):
        pose = pose_difference(state.T_world_drone, true[k])
        error = np.concatenate([pose, velocity[k] - state.velocity, bias[k] - state.bias])
        row = {}
        for name, part in PARTS.items():
            e, P = error[part], state.covariance[part, part] + 1e-18 * np.eye(len(error[part]))  # the first scan's is 0
            row[name] = float(e @ np.linalg.solve(P, e)) / len(e)
            if part == POSITION:
                row[TOLD] = float(e @ np.linalg.solve(P + stretch[k], e)) / len(e)
        rows.append(row)
    return pd.DataFrame(rows, index=pd.Index(stamp_s, name="time_s"))


def flown(trajectory: TrajectoryName, seed: int) -> tuple[pd.Series, pd.Series]:
    """Mean squares of one flight, in its first half minute and after it."""
    settings = ExperimentSettings.preset(trajectory, "random-walk", "faces", "starling2-honest", seed, DURATION_S)
    flight, truth = experiment.simulate(settings)
    found = squares(settings, flight, states_of(settings, flight), truth)
    return found[found.index <= FIRST_S].mean(), found[found.index > FIRST_S].mean()


def main(seeds: list[str]) -> None:
    print(machine())
    cases = [(trajectory, seed) for trajectory in FLIGHTS for seed in seeds]
    means = [flown(trajectory, int(seed)) for trajectory, seed in cases]
    for title, rows in zip(("first 30 s", "after 30 s"), zip(*means, strict=True), strict=True):
        print(f"\n| {title} | seed | {' | '.join(rows[0].index)} |\n|{'---|' * (2 + len(rows[0]))}")
        for case, row in zip([*cases, ("mean", "")], [*rows, pd.concat(rows, axis=1).mean(axis=1)], strict=True):
            print("| " + " | ".join([*case, *(f"{value:.1f}" for value in row)]) + " |")


if __name__ == "__main__":
    main(sys.argv[1:])
