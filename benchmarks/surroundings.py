"""Bars and poses of flights before a tower with ground in view and a wall behind it.

PYTHONPATH=. .venv/bin/python benchmarks/surroundings.py [--seeds 21 22] [--towers slender heavy] [--odometry faces]

A Starling 2 in a zigzag before the tower for 100 s. `reconstruct` gets the true poses, `--odometry` drifting ones.
"""

import argparse

import numpy as np
import pandas as pd

from steelnb.core.types import Flight
from steelnb.experiment import estimate, redrift
from steelnb.fusion import reconstruct
from steelnb.metrics.structure import reference, score_structure
from steelnb.settings import ExperimentSettings, StructureSettings
from steelnb.simulation import Tower, Truth, build_tower, fly, measured_imu, scan_flight
from tests.lattice import with_plate

WALL_M, BEHIND_M = (12.0, 12.0), 1.0
"""Width and height of the wall, and its distance from the tower."""
GROUND = {"preprocess.floor_m": -10.0}
"""Settings that keep the ground."""
CASES = {"alone": (False, {}), "ground": (False, GROUND), "ground and wall": (True, GROUND)}


def before_a_wall(tower: Tower) -> Tower:
    """The tower with a wall behind it, as the drone sees it."""
    y = tower.vertices[:, 1].max() + BEHIND_M
    return with_plate(tower, np.array([[x, y, z] for x in (-WALL_M[0] / 2, WALL_M[0] / 2) for z in (0.0, WALL_M[1])]))


def trial(name: str, seed: int, case: str, odometry: str | None) -> dict[str, object]:
    """One row of the table."""
    has_wall, changed = CASES[case]
    settings = ExperimentSettings.preset(
        "zigzag", "random-walk", odometry or "best", "starling2", seed, 100.0, changed, name
    )
    tower = build_tower(settings.tower)
    tower = before_a_wall(tower) if has_wall else tower
    trajectory, imu = fly(tower, settings.flight, seed)
    scans, visibility = scan_flight(tower, trajectory, settings.tof, seed)
    imu = measured_imu(imu, settings.imu, seed) if settings.imu else imu
    truth, at = Truth(trajectory, tower, visibility), trajectory.at(scans.stamp_s)
    flight = redrift(settings, Flight(scans, at, settings.tof.T_drone_sensor, imu), truth)
    floor = StructureSettings(floor_m=settings.odometry.preprocess.floor_m)
    found = reconstruct(flight.scans, at.T_world_drone, flight.T_drone_sensor, floor)
    score = score_structure(found, reference(tower, visibility)).metrics
    row = {"tower": name, "seed": seed, "case": case, "bars": len(found)}
    row |= {measure: score[measure] for measure in ("recall", "precision", "offset_median_m")}
    if odometry:
        row[f"{odometry}_ate_rmse_m"] = estimate(settings, flight, truth).metrics["ate_rmse_m"]
    return row


def main() -> None:
    """Print one row per tower, seed and case, and the means over the seeds."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, nargs="+", default=[21])
    parser.add_argument("--towers", nargs="+", default=["slender", "heavy", "light", "report", "tapered"])
    parser.add_argument("--odometry")
    options = parser.parse_args()
    rows = []
    for name in options.towers:
        for seed in options.seeds:
            for case in CASES:
                rows.append(trial(name, seed, case, options.odometry))
                print(*rows[-1].values(), flush=True)
    means = pd.DataFrame(rows).groupby(["case", "tower"], sort=False).mean(numeric_only=True)
    print(means.drop(columns="seed").round(4).to_string())


if __name__ == "__main__":
    main()
