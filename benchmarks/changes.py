"""Localisation in the structure of an earlier flight, and the changes found in a tower since.

    PYTHONPATH=. .venv/bin/python benchmarks/changes.py [--seeds 102 103 …] [--map-seed 101] [--maps FOLDER]
        [--flights zigzag loops] [--picture changes.png]

The map of each flight path is the structure of a smoothed flight around the unchanged tower with the map's seed, with
its own errors. In each later flight some members are removed, moved by 1, 2 and 5 cm or bent by 3 cm, in directions
across them that the seed draws, and it starts 0.47 m and 4.5° beside the map. Prints the tables of changes.md.
FOLDER keeps the maps between calls; the picture is that of the first flight.
"""

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from shared import aligned_m
from steelnb import KnownStructureOdometry, Structure, experiment, find_changes, odometry, reconstruct, smooth
from steelnb.fusion.changes import Changes
from steelnb.io import read_structure, write_structure
from steelnb.metrics.matching import match_members
from steelnb.noise import drifting
from steelnb.report.three_views import figure_changes
from steelnb.settings import ExperimentSettings, StructureSettings, TrajectoryName
from steelnb.simulation import build_tower, changed_tower, fly, scan_flight
from steelnb.types import Flight, Trajectory

FLIGHTS: tuple[TrajectoryName, ...] = ("zigzag", "loops")
NOISE = "random-walk+yaw-random-walk"
CHANGES = {"removed": 0.0, "moved 5 cm": 0.05, "moved 2 cm": 0.02, "moved 1 cm": 0.01, "bent 3 cm": 0.03}
EACH = 6
"""Members with each change in one flight; legs stay, and so do members shorter than half a metre."""
START_M, START_RAD = 0.27, np.radians(4.5)
FOUND = {"removed": ("missing",)} | dict.fromkeys([*CHANGES][1:], ("moved", "bent", "missing"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(102, 106)))
    parser.add_argument("--map-seed", type=int, default=101)
    parser.add_argument("--maps", type=Path)
    parser.add_argument("--flights", nargs="+", choices=FLIGHTS, default=FLIGHTS)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    for name in arguments.flights:
        known = map_of(name, arguments.map_seed, arguments.maps)
        total: dict[str, Counter[str]] = {change: Counter() for change in (*CHANGES, "same", "new")}
        print("| flight | seed | scans placed | rms, mm | aligned | median | p95 | yaw, ° | ms a scan |")
        print("|---|---|---|---|---|---|---|---|---|", flush=True)
        for seed in arguments.seeds:
            numbers, told, changes = measure(name, seed, known)
            if arguments.picture and (name, seed) == (arguments.flights[0], arguments.seeds[0]):
                figure_changes(changes, f"Changes found on the {name} flight of seed {seed}").savefig(arguments.picture)
            print(f"| {name} | {seed} | " + " | ".join(numbers) + " |", flush=True)
            for change, counts in told.items():
                total[change] += counts
            print(seed, {change: dict(counts) for change, counts in told.items()}, file=sys.stderr, flush=True)
        print(f"\n{name}: {len(known)} bars in the map")
        print("| change | bars | of them seen | found | other verdicts |")
        print("|---|---|---|---|---|")
        for change, counts in total.items():
            bars, seen = counts.total(), counts.total() - counts["not seen"]
            found = sum(counts[kind] for kind in FOUND.get(change, ("missing", "moved", "bent")))
            print(f"| {change} | {bars} | {seen} | {found / max(seen, 1):.3f} | {dict(counts)} |", flush=True)


def map_of(name: TrajectoryName, seed: int, folder: Path | None) -> Structure:
    """The structure of a smoothed flight around the unchanged tower."""
    kept = folder / f"{name}-{seed}.json" if folder else None
    if kept is not None and kept.exists():
        return read_structure(kept)
    settings = ExperimentSettings.preset(name, NOISE, seed=seed, method="combined")
    flight, truth = experiment.simulate(settings)
    poses = smooth(flight, experiment.estimate(settings, flight, truth)).corrected.T_world_drone
    known = reconstruct(flight.scans, poses, flight.T_drone_sensor)
    if kept is not None:
        write_structure(known, kept)
    return known


def measure(name: TrajectoryName, seed: int, known: Structure) -> tuple[list[str], dict[str, Counter[str]], Changes]:
    """Localise a flight around the changed tower and compare: numbers of the poses, and the verdicts by change."""
    settings = ExperimentSettings.preset(name, NOISE, seed=seed)
    tower, rng = build_tower(settings.tower), np.random.default_rng(seed)
    member = match_members(known.segments, tower.axes).member
    length = np.linalg.norm(tower.axes[:, 1] - tower.axes[:, 0], axis=1)
    free = [m for m in np.unique(member[member >= 0]) if tower.members[m].kind != "leg" and length[m] > 0.5]
    chosen = rng.permutation(free)[: EACH * len(CHANGES)].reshape(len(CHANGES), EACH)
    what = {int(m): change for change, row in zip(CHANGES, chosen, strict=True) for m in row}
    by = {}
    for m, change in what.items():
        axis = (tower.axes[m, 1] - tower.axes[m, 0]) / length[m]
        across = np.cross(axis, rng.normal(size=3))
        by[m] = CHANGES[change] * across / np.linalg.norm(across)
    gone = [m for m, change in what.items() if change == "removed"]
    bent = {m: by[m] for m, change in what.items() if change.startswith("bent")}
    now = changed_tower(tower, gone, {m: v for m, v in by.items() if m not in bent and m not in gone}, bent)

    trajectory, _ = fly(tower, settings.flight, seed)
    scans, _ = scan_flight(now, trajectory, settings.tof.T_drone_sensor, settings.tof, seed)
    prior = drifting(trajectory, settings.noise, seed).at(scans.stamp_s)
    beside = np.eye(4)
    beside[:3, :3] = Rotation.from_rotvec([0, 0, START_RAD * rng.choice([-1, 1])]).as_matrix()
    beside[:3, 3] = prior.position[0] - beside[:3, :3] @ prior.position[0] + START_M * rng.choice([-1, 1], 3)
    prior = Trajectory(prior.stamp_s, beside @ prior.T_world_drone)
    flight = Flight(scans, prior, settings.tof.T_drone_sensor)
    begin_s = time.process_time()
    found = odometry.run(flight, KnownStructureOdometry(known, flight.T_drone_sensor))
    ms = 1e3 * (time.process_time() - begin_s) / len(flight)
    placed = np.mean([not reason for reason in found.reason])
    changes = find_changes(known, scans, found.corrected.T_world_drone, flight.T_drone_sensor, StructureSettings())
    told = {change: Counter[str]() for change in (*CHANGES, "same", "new")}
    for kind, m in zip(changes.kind, member, strict=False):
        if m >= 0:
            told[what.get(int(m), "same")][kind] += 1
    new = match_members(changes.new.segments, tower.axes).member
    told["new"].update("on a changed member" if m in what else "on a member" if m >= 0 else "on none" for m in new)
    return [f"{placed:.3f}", *errors(found.corrected, trajectory.at(scans.stamp_s)), f"{ms:.1f}"], told, changes


def errors(found: Trajectory, true: Trajectory) -> list[str]:
    """Root mean square error in mm, without and with a turn about z and a shift of the whole path; its median and 95th
    percentile; and the angle of the error, root mean square."""
    apart = np.linalg.norm(found.position - true.position, axis=1)
    turned = found.T_world_drone[:, :3, :3] @ true.T_world_drone[:, :3, :3].transpose(0, 2, 1)
    angle = np.degrees(Rotation.from_matrix(turned).magnitude())
    rms = [1e3 * np.sqrt((each**2).mean()) for each in (apart, aligned_m(found.position, true.position))]
    return [*(f"{each:.1f}" for each in (*rms, *1e3 * np.quantile(apart, [0.5, 0.95]))),
            f"{np.sqrt((angle**2).mean()):.3f}"]  # fmt: skip


if __name__ == "__main__":
    main()
