"""The learned odometry `deepvo`: error against the amount of training data and the distance from it.

    .venv/bin/python benchmarks/deepvo.py FOLDER > benchmarks/deepvo.md

FOLDER holds the simulated data, the weights of each training, SHARE_SEED.npz, and the flights on which they are judged;
what is missing there is made. Training, by scripts/train-deepvo, needs PyTorch.
"""

import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from runpy import run_path
from typing import Any

import numpy as np
from tqdm import tqdm

from steelnb import experiment, rng
from steelnb.errors import CollisionError, InputError
from steelnb.odometry.deepvo import motions, paired
from steelnb.odometry.network import Network, read_network
from steelnb.settings import ExperimentSettings, FlightSettings, TofSettings, TowerSettings, TrajectoryName
from steelnb.simulation import CastScans, build_tower, fly
from steelnb.types import Array, Scan

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "scripts/train-deepvo"
TRAININGS = {0.0625: (1,), 0.25: (1,), 1.0: (1, 2, 3)}
"""Share of the flights → seeds of the training."""
SEEDS = (21, 22, 23, 101, 102, 103)
TRAJECTORIES: tuple[TrajectoryName, ...] = ("zigzag", "loops")
FLIGHTS = 6
FIRST_S = 5.0
"""Time from the start whose mean velocity is kept by who keeps a constant one."""
ABOUT = f"""Sensor `starling2`, random walk, 200 s, seeds {", ".join(map(str, SEEDS))}; ATE in metres, unaligned: mean
(least–most), over seeds and trainings. The gain is the slope of motions found over true ones. In the second table all
but the ATE of each training is that of training 1, whose weights the package has. Made by [deepvo.py](deepvo.py).
"""

training = run_path(str(SCRIPT), run_name="train_deepvo")


class Seen:
    """Pairs of consecutive scans of a flight: ``images (N, 4, H, W)``, ``R (N, 3, 3)`` of the levelled camera, and the
    true motion ``moved (N, 3)`` in it, metres."""

    def __init__(self, images: np.ndarray, R: Array, moved: Array, prior: Array) -> None:
        self.images, self.R, self.moved, self.prior = images, R, moved, prior

    @staticmethod
    def of(scans: Sequence[Scan], T_world_sensor: Array, prior: Array) -> "Seen":
        """``prior (N + 1, 3)``: drifting places of the drone less the true ones."""
        images, turns = [], []
        for k in range(len(scans) - 1):
            R = T_world_sensor[k, :3, :3], T_world_sensor[k + 1, :3, :3]
            pair = paired((scans[k].points, scans[k + 1].points), R)
            images.append(pair.images.astype(np.float16))
            turns.append(pair.R_world_level)
        moved = np.einsum("nji,nj->ni", np.array(turns), np.diff(T_world_sensor[:, :3, 3], axis=0))
        return Seen(np.array(images), np.array(turns), moved, prior)

    def constant_velocities(self) -> tuple[Array, Array]:
        """Motions of who keeps the prior's velocity over the first seconds, along the axes of the world or of the
        levelled drone."""
        first = round(FIRST_S * 5)
        moved = self.moved[:first] + np.einsum("nji,nj->ni", self.R[:first], np.diff(self.prior[: first + 1], axis=0))
        world = np.einsum("nij,nj->ni", self.R[:first], moved).mean(axis=0)
        return self.R.transpose(0, 2, 1) @ world, np.tile(moved.mean(axis=0), (len(self.moved), 1))

    def found(self, network: Network) -> tuple[Array, Array]:
        """Motions and standard deviations, each ``(N, 3)``."""
        parts = [motions(network, self.images[k : k + 64].astype(np.float32)) for k in range(0, len(self.moved), 64)]
        moved, sigma = (np.concatenate(column) for column in zip(*parts, strict=True))
        return moved, sigma

    def ate_m(self, moved: Array) -> float:
        """Error of the path that motions ``(N, 3)`` add up to, where the attitude is known."""
        off = np.cumsum(np.einsum("nij,nj->ni", self.R, moved - self.moved), axis=0)
        return rms(off)


Report = Mapping[tuple[str, int], Seen]
"""The report's flights, by name and seed."""
Networks = Mapping[tuple[float, int], Network]
"""Weights by share of the flights learned from and seed of the training."""


def scanned(tower: TowerSettings, flight: FlightSettings, seed: int) -> Seen:
    tof = TofSettings.preset("starling2")
    trajectory, _ = fly(build_tower(tower), flight, seed)
    scans = CastScans(build_tower(tower), trajectory, tof.T_drone_sensor, tof, seed)
    T = trajectory.T_world_drone[np.round(scans.stamp_s / 0.008).astype(int)] @ tof.T_drone_sensor
    return Seen.of(list(scans), T, np.zeros((len(T), 3)))


def drawn(
    stream: int, tower: TowerSettings | None = None, wide: float = 1.0, far: float = 1.0, other: bool = False
) -> list[Seen]:
    """Random flights of 16 s, each around a tower of its own, or all around one. ``wide`` and ``far``: factors of
    widths and stand-off; ``other``: flights that are not those learned from."""
    found: list[Seen] = []
    k = 0
    while len(found) < FLIGHTS:
        draw, k = rng.stream(stream, "deepvo", k), k + 1
        try:
            own = tower or training["random_tower"](draw)
            widths = {name: wide * getattr(own, name) for name in WIDTHS}
            flight = training["random_flight"](draw, own)
            if other:
                flight = training["random_flight"](rng.stream(9, "deepvo", k), own)
            flight = flight.replace(standoff_m=far * flight.standoff_m)
            found.append(scanned(own.replace(**widths), flight, int(draw.integers(1 << 30))))
        except (CollisionError, InputError):
            continue
    return found


WIDTHS = ("base_width_m", "waist_width_m", "top_width_m")


def headline(trajectory: TrajectoryName, seed: int) -> list[Seen]:
    """One of the report's flights."""
    flight, truth = experiment.simulate(ExperimentSettings.preset(trajectory, seed=seed, method="deepvo"))
    true = truth.trajectory.at(flight.prior.stamp_s)
    T_world_sensor = true.T_world_drone @ flight.T_drone_sensor
    return [Seen.of(flight.scans, T_world_sensor, flight.prior.position - true.position)]


def kept(path: Path, make: Callable[[], list[Seen]]) -> list[Seen]:
    """Flights from a file, or made and written there."""
    if not path.exists():
        made = make()
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(each, name) for each in made]) for name in ("images", "R", "moved", "prior")
        }
        np.savez(path, ends=np.cumsum([len(each.moved) for each in made]), **arrays)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    ends = arrays.pop("ends")
    more = {"images": 0, "R": 0, "moved": 0, "prior": 1}  # a place more than motions
    parts = {name: np.split(arrays[name], (ends + (np.arange(len(ends)) + 1) * n)[:-1]) for name, n in more.items()}
    return [Seen(*(parts[name][k] for name in more)) for k in range(len(ends))]


GROUPS: dict[str, Callable[[], list[Seen]]] = {
    "the paths learned from, in other gusts": lambda: drawn(0),
    "other flights around towers learned from": lambda: drawn(0, other=True),
    "other random towers": lambda: drawn(1),
    "the report's tower": lambda: drawn(2, TowerSettings()),
    "tower `heavy`": lambda: drawn(2, TowerSettings.preset("heavy")),
    "tower `light`": lambda: drawn(2, TowerSettings.preset("light")),
    "random towers, 1.5 times as wide": lambda: drawn(1, wide=1.5),
    "random towers, twice as wide": lambda: drawn(1, wide=2.0),
    "random towers, three times as wide": lambda: drawn(1, wide=3.0),
    "random towers from twice as far": lambda: drawn(1, far=2.0),
}


def prepared(folder: Path) -> tuple[Report, dict[str, list[Seen]]]:
    """All flights: the report's by name and seed, and the others by group."""
    names = [(trajectory, seed) for seed in SEEDS for trajectory in TRAJECTORIES]
    report = {
        name: kept(folder / f"flight_{name[0]}_{name[1]}.npz", partial(headline, *name))[0]
        for name in tqdm(names, "the report's flights")
    }
    groups = {
        name: kept(folder / f"group_{k}.npz", make)
        for k, (name, make) in enumerate(tqdm(GROUPS.items(), "groups of flights"))
    }
    return report, groups


def rms(error: Array) -> float:
    """Root mean square length of vectors ``(N, 3)``."""
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def scores(flights: Sequence[Seen], network: Network) -> tuple[float, float, float, float]:
    """Of pairs: error of a motion (rms, mm), the same over the rms motion, gain, and error over stated σ (rms)."""
    moved, sigma = (np.concatenate(c) for c in zip(*(each.found(network) for each in flights), strict=True))
    true = np.concatenate([each.moved for each in flights])
    error = rms(moved - true)
    gain = (moved * true).sum() / (true**2).sum()
    return 1e3 * error, error / rms(true), float(gain), float(np.sqrt((((moved - true) / sigma) ** 2).mean()))


def spread(values: Sequence[float], form: str = "{:.2f}") -> str:
    """Mean (least–most)."""
    mean = form.format(np.mean(values))
    return mean if len(values) < 2 else f"{mean} ({form.format(min(values))}–{form.format(max(values))})"


def print_flights(report: Report, networks: Networks) -> None:
    print("| flight | without correction | standing still | constant velocity, world | constant velocity, drone |"
          + "".join(f" deepvo, {share:g} of the data |" for share in TRAININGS) + "\n" + "|---" * 8 + "|")  # fmt: skip
    for trajectory in TRAJECTORIES:
        own = [report[trajectory, seed] for seed in SEEDS]
        baselines = [
            (rms(seen.prior), seen.ate_m(0 * seen.moved), *map(seen.ate_m, seen.constant_velocities())) for seen in own
        ]
        cells = [spread(column) for column in zip(*baselines, strict=True)]
        for share, seeds in TRAININGS.items():
            cells.append(spread([seen.ate_m(seen.found(networks[share, s])[0]) for s in seeds for seen in own]))
        print(f"| {trajectory} | " + " | ".join(cells) + " |", flush=True)
    print("\n| flight | seed |" + "".join(f" training {s} |" for s in TRAININGS[1.0]) + " error of a motion (mm) |"
          " ATE if errors were independent | gain | ATE with that gain taken out |\n|---|---|---|---|---|---|"
          + "---|" * len(TRAININGS[1.0]))  # fmt: skip
    for (name, seed), seen in report.items():
        found = [seen.found(networks[1.0, s])[0] for s in TRAININGS[1.0]]
        error = rms(found[0] - seen.moved)
        gain = (found[0] * seen.moved).sum() / (seen.moved**2).sum()
        ates = " | ".join(f"{seen.ate_m(each):.2f}" for each in found)
        alone, mended = error * np.sqrt(len(seen.moved) / 2), seen.ate_m(found[0] / gain)
        print(f"| {name} | {seed} | {ates} | {1e3 * error:.1f} | {alone:.2f} | {gain:.2f} | {mended:.2f} |")


def print_groups(groups: Mapping[str, list[Seen]], networks: Networks) -> None:
    print("\n| pairs of | motion (rms, mm) |" + "".join(f" {share:g} of the data: error (mm) |" for share in TRAININGS)
          + " relative | gain | error over stated σ |\n" + "|---" * (5 + len(TRAININGS)) + "|")  # fmt: skip
    for name, pairs in groups.items():
        size = 1e3 * rms(np.concatenate([each.moved for each in pairs]))
        table = {share: [scores(pairs, networks[share, s]) for s in seeds] for share, seeds in TRAININGS.items()}
        errors = " | ".join(spread([row[0] for row in rows], "{:.1f}") for rows in table.values())
        last = np.mean(table[1.0], axis=0)
        print(f"| {name} | {size:.0f} | {errors} | {last[1]:.2f} | {last[2]:.2f} | {last[3]:.1f} |", flush=True)


def main(folder: Path) -> None:
    report, groups = prepared(folder)
    networks: dict[tuple[float, int], Network] = {}
    for share, seed in ((share, seed) for share, seeds in TRAININGS.items() for seed in seeds):
        path = folder / f"{share:g}_{seed}.npz"
        if not path.exists():
            given = ["--data", folder / "data.npz", "--share", share, "--seed", seed, "--output", path]
            subprocess.run([sys.executable, SCRIPT, *map(str, given)], check=True)
        networks[share, seed] = read_network(path)
    print(f"# Learned odometry\n\n{ABOUT}")
    print_flights(report, networks)
    flights = {f"{t}, the report's flight": [report[t, s] for s in SEEDS] for t in TRAJECTORIES}
    print_groups({**groups, **flights}, networks)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
