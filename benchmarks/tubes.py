"""Round tubes beside angle sections: axes found from all round and from one side, and angle sections taken for tubes.

    PYTHONPATH=. .venv/bin/python benchmarks/tubes.py [--seeds 101 102 …] [--steel 101 …]

Seven tubes seen by the sensor starling2 at true poses: the bars that a reconstruction starts from, in the middle of
their points; its structure with angle sections alone, as it was before; and as it is. With --steel, the bars of flights
around towers of angle sections, both sensors. Prints the tables of tubes.md.
"""

import argparse
import importlib
from unittest.mock import patch

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb import experiment
from steelnb.fusion.proposals import find_bars
from steelnb.metrics.matching import match_members
from steelnb.settings import ExperimentSettings, StructureSettings, TrajectoryName
from steelnb.simulation import CastScans, Tower, build_tubes
from steelnb.types import Array, RangeScans, Segments, Trajectory

reconstruction = importlib.import_module("steelnb.fusion.reconstruct")
AXES = np.array([
    [[-1, -1, 0.3], [-1, -1, 3.6]], [[1, -1, 0.3], [1, -1, 3.6]], [[1, 1, 0.3], [1, 1, 3.6]],
    [[-1, 1, 0.3], [-1, 1, 3.6]], [[-1, -1, 3.0], [1, -1, 3.0]], [[1, 1, 1.5], [-1, 1, 1.5]],
    [[-1, -1, 0.8], [-1, 1, 2.8]],
])  # fmt: skip
"""Four posts, two beams and a brace, metres."""
FLIGHTS: tuple[TrajectoryName, ...] = ("zigzag", "loops")
RADII_M, SIDES = (0.025, 0.05, 0.1), {"all round": np.pi, "one side": 0.6}
SCANS, STANDOFF_M = 240, 3.5
TUBE_MIN_M, TUBE_SHARE = 0.06, 1.2
"""The tube that holds the points of a bar is the default one, or larger for wide bars."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="*", default=[101, 102])
    parser.add_argument("--steel", type=int, nargs="*", default=[])
    arguments = parser.parse_args()
    if arguments.seeds:
        print("| radius, cm | seen from | poses | plain bars | angle sections alone | both sections | round |")
        print("|---|---|---|---|---|---|---|", flush=True)
    for radius_m in RADII_M if arguments.seeds else ():
        for side in SIDES:
            for adjust in (False, True):
                rows = [measure(radius_m, side, adjust, seed) for seed in arguments.seeds]
                plain, angles, both, share = (np.concatenate(each) for each in zip(*rows, strict=True))
                cells = " | ".join(map(cell, (plain, angles, both)))
                poses = "adjusted" if adjust else "kept"
                print(f"| {100 * radius_m:g} | {side} | {poses} | {cells} | {share.mean():.2f} |", flush=True)
    if arguments.steel:
        print("\n| flight | sensor | seed | bars | round |\n|---|---|---|---|---|")
    for seed in arguments.steel:
        for sensor in ("starling2", "report-4cm"):
            for name in FLIGHTS:
                flight, truth = experiment.simulate(
                    ExperimentSettings.preset(name, "random-walk", sensor=sensor, seed=seed)
                )
                T = truth.trajectory.at(flight.prior.stamp_s).T_world_drone
                found = reconstruction.reconstruct(flight.scans, T, flight.T_drone_sensor)
                tubes = 0 if found.tube is None else found.tube.sum()
                print(f"| {name} | {sensor} | {seed} | {len(found)} | {tubes} |", flush=True)


def cell(off_m: Array) -> str:
    """Mean and largest distance in millimetres, and the share of the tubes that were found."""
    off = 1e3 * off_m
    return f"{np.nanmean(off):.1f} ({np.nanmax(off):.1f}), {np.isfinite(off).mean():.2f}"


def measure(radius_m: float, side: str, adjust: bool, seed: int) -> tuple[Array, Array, Array, Array]:
    """Distances of the axes to the middles of the plain bars, of angle sections alone and of both sections, each
    ``(7,)``, metres, NaN for a tube that was not found; and which of the last are round."""
    tower = build_tubes(AXES, radius_m)
    scans, T = seen(tower, SIDES[side], seed)
    settings = StructureSettings(adjust=adjust, tube_m=max(TUBE_MIN_M, TUBE_SHARE * radius_m))
    plain, _ = find_bars(reconstruction.map_scans(scans, T, settings), settings)
    with patch.object(reconstruction, "fit_rounds", lambda *_: None):  # no bar is taken for a round tube
        angles = reconstruction.reconstruct(scans, T, None, settings)
    both = reconstruction.reconstruct(scans, T, None, settings)
    tube = np.zeros(len(both)) if both.tube is None else both.tube.astype(float)
    return offsets(plain, tower), offsets(angles.segments, tower), offsets(both.segments, tower), tube


def seen(tower: Tower, turn_rad: float, seed: int) -> tuple[RangeScans, Array]:
    """Scans of the sensor starling2 on an arc around the z axis, up and down, and its true poses."""
    turn = np.linspace(-turn_rad, turn_rad, SCANS)
    angle, T = 0.3 + turn, np.tile(np.eye(4), (SCANS + 1, 1, 1))
    T[:-1, :3, :3] = Rotation.from_rotvec(np.outer(angle, [0, 0, 1])).as_matrix()
    height = 1.8 + 0.8 * np.sin(7 * turn)
    T[:-1, :3, 3] = np.stack([-STANDOFF_M * np.cos(angle), -STANDOFF_M * np.sin(angle), height], axis=1)
    T[-1] = T[-2]
    path = Trajectory(0.2 * np.arange(SCANS + 1, dtype=np.float64), T)
    tof = ExperimentSettings.preset("loops", "random-walk", sensor="starling2").tof
    scans = CastScans(tower, path, np.eye(4), tof, seed)
    image = np.array([measured for measured, *_ in scans.cast()])
    return RangeScans(scans.stamp_s, image, scans.ray), path.at(scans.stamp_s).T_world_drone


def offsets(found: Segments, tower: Tower) -> Array:
    """Distance ``(M,)`` of each true axis to the middle of the bar on it, of the farthest of several, NaN for none."""
    match, result = match_members(found, tower.axes, distance_max_m=0.15), np.full(len(tower.axes), np.nan)
    for bar in np.flatnonzero(match.right):
        start, end = tower.axes[match.member[bar]]
        off = np.linalg.norm(np.cross(found.middle[bar] - start, end - start)) / np.linalg.norm(end - start)
        result[match.member[bar]] = np.fmax(result[match.member[bar]], off)
    return result


if __name__ == "__main__":
    main()
