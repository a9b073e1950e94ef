"""Bars of merged clouds of towers, by `steelnb segment` and by the plain Hough transform in blocks ("before").

PYTHONPATH=. .venv/bin/python benchmarks/segment.py [--seeds 21 22] [--towers slender heavy] [--shares 10 40]

The clouds are the preprocessed scans of a Starling 2 in loops around a tower, placed at the true poses, ground
included; a random one in ``share`` of their points is taken.
"""

import argparse
import time

import numpy as np

from steelnb import experiment
from steelnb.core.types import Array, Segments
from steelnb.fusion.structure import Structure
from steelnb.fusion.whole_cloud import bars_of_cloud
from steelnb.hough.lines import default_dx
from steelnb.hough.whole_structure.search import segment_structure
from steelnb.metrics.structure import Reference, reference, score_structure
from steelnb.points import preprocess_scan, voxel_grid
from steelnb.settings import ExperimentSettings, TowerSettings


def cloud_of(tower: str, seed: int, duration_s: float) -> tuple[Array, Reference]:
    """Points ``(N, 3)`` of a flight at the true poses, metres, and the true bars."""
    settings = ExperimentSettings.preset("loops", "none", "best", "starling2", seed, duration_s)
    settings = settings.override({"preprocess.floor_m": -10.0})
    if tower != "tapered":
        settings = settings.replace(tower=TowerSettings.preset(tower))
    flight, truth = experiment.simulate(settings)
    T = truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    placed = [
        preprocess_scan(scan, T[k], flight.T_drone_sensor, settings.odometry.preprocess) @ T[k, :3, :3].T + T[k, :3, 3]
        for k, scan in enumerate(flight.scans)
    ]
    return np.concatenate(placed), reference(truth.tower, truth.visibility)


def row(name: str, bars: Segments, truth: Reference, seconds: float) -> None:
    """Print one row of the table."""
    nothing = np.full(len(bars), np.nan)
    structure = Structure(
        bars, nothing, np.ones(len(bars), dtype=np.int64), nothing, np.zeros((0, 3)), np.zeros((0, 2), int)
    )
    numbers = score_structure(structure, truth).metrics
    seen_m = sum(0.05 * slices.sum() for slices, is_seen in zip(truth.slices, truth.observed, strict=True) if is_seen)
    print(
        f"| {name} | {len(bars)} of {truth.observed.sum()} | {numbers['recall']:.2f} | {numbers['precision']:.2f} "
        f"| {numbers['duplicates']:.0f} | {bars.length.sum():.0f} of {seen_m:.0f} "
        f"| {1e3 * numbers['offset_median_m']:.0f} | {seconds:.1f} |", flush=True,
    )  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, nargs="+", default=[21])
    parser.add_argument("--towers", nargs="+", default=["slender", "heavy", "light", "report", "tapered"])
    parser.add_argument("--shares", type=int, nargs="+", default=[10, 40])
    options = parser.parse_args()
    print("| cloud | bars | recall | precision | duplicates | length (m) | offset (mm) | seconds |")
    print("|---|---|---|---|---|---|---|---|")
    for seed in options.seeds:
        for tower in options.towers:
            points, truth = cloud_of(tower, seed, 200.0 if tower == "tapered" else 120.0)
            order = np.random.default_rng(seed).permutation(len(points))
            for share in options.shares:
                some = points[np.sort(order[: len(points) // share])]
                name = f"{tower}, seed {seed}, {len(some)} points"
                began = time.perf_counter()
                row(name, bars_of_cloud(some).bars, truth, time.perf_counter() - began)
                if share == options.shares[0] and seed == options.seeds[0]:
                    began, dx = time.perf_counter(), default_dx(some)
                    plain = segment_structure(voxel_grid(some, dx / np.sqrt(3)), dx)
                    row(f"{name}, before", plain, truth, time.perf_counter() - began)


if __name__ == "__main__":
    main()
