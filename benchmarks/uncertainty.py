"""Stated covariances of smoothed flights against the truth: NEES and coverage, before and after calibration.

    PYTHONPATH=. .venv/bin/python benchmarks/uncertainty.py [--seeds 101 102 …] [--sensor starling2] [--figure FILE.png]

Flights of 200 s with random walk. “Before”: every point an observation of its own, bars without errors of their
own. Set STEELNB_CACHE to a folder to keep flights and estimates between calls. Prints the table of uncertainty.md.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import chi2

from steelnb import experiment
from steelnb.fusion import smooth, uncertainty
from steelnb.metrics import axis_errors, coverage, nees, pose_errors
from steelnb.metrics.matching import match_members
from steelnb.metrics.reconstruction import reference
from steelnb.metrics.uncertainty import HELD
from steelnb.settings import ExperimentSettings, TrajectoryName

FLIGHTS: tuple[TrajectoryName, ...] = ("zigzag", "loops")
NOISE = "random-walk"
START = {"starling2": "combined", "report-4cm": "best"}
CASES = {"before": (0.0, 0.0), "after": (uncertainty.SHARED_SIGMA_M, uncertainty.END_SIGMA_M)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(101, 111)))
    parser.add_argument("--sensor", choices=START, default="starling2")
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {case: [] for case in CASES}
    print("| flight | case | poses, NEES | inside 95 % | axes, NEES | inside 95 % | seeds |")
    print("|---|---|---|---|---|---|---|")
    for flight_name in FLIGHTS:
        for case in CASES:
            rows = [measure(flight_name, arguments.sensor, seed, *CASES[case]) for seed in arguments.seeds]
            found[case] += rows
            print(row(flight_name, case, rows), flush=True)
    for case in CASES:
        print(row("both", case, found[case]), flush=True)
    if arguments.figure:
        draw(found, arguments)


def measure(
    flight_name: TrajectoryName, sensor: str, seed: int, shared_sigma_m: float, end_sigma_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """NEES per degree of freedom of all poses but the first, which is held, and of all axes that lie on a member."""
    settings = ExperimentSettings.preset(flight_name, NOISE, sensor=sensor, seed=seed, method=START[sensor])
    flight, truth = experiment.simulate(settings)
    uncertainty.SHARED_SIGMA_M, uncertainty.END_SIGMA_M = shared_sigma_m, end_sigma_m
    smoothed = smooth(flight, experiment.estimate(settings, flight, truth))
    assert smoothed.pose_covariance is not None, smoothed.unsmoothed
    assert smoothed.axis_covariance is not None
    held = np.array(HELD)
    error = pose_errors(smoothed.corrected, truth.trajectory)[1:, held]
    axes = reference(truth.tower, truth.visibility).axes
    match = match_members(smoothed.segments, axes)
    on = match.right
    off = axis_errors(smoothed.segments.take(on), axes[match.member[on]])
    return (
        nees(error, smoothed.pose_covariance[1:, held[:, None], held]) / len(held),
        nees(off, smoothed.axis_covariance[on]) / off.shape[1],
    )


def row(flight_name: str, case: str, found: list[tuple[np.ndarray, np.ndarray]]) -> str:
    poses, axes = (np.concatenate(each) for each in zip(*found, strict=True))
    cells = " | ".join(f"{each.mean():.2f} | {coverage(4 * each, 4):.2f}" for each in (poses, axes))
    return f"| {flight_name} | {case} | {cells} | {len(found)} |"


def draw(found: dict[str, list[tuple[np.ndarray, np.ndarray]]], arguments: argparse.Namespace) -> None:
    """Histograms of NEES beside the distribution that it should have."""
    figure, panels = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
    edges = np.geomspace(0.01, 100, 49)
    for panel, which, title in zip(panels, (0, 1), ("poses", "axes of bars"), strict=True):
        for case, rows in found.items():
            values = np.concatenate([each[which] for each in rows]).clip(edges[0], edges[-1])
            panel.hist(values, edges, weights=np.full(len(values), 1 / len(values)), alpha=0.6, label=case)
        panel.stairs(np.diff(chi2.cdf(4 * edges, 4)), edges, color="k", label="expected")
        panel.set(xscale="log", xlabel="NEES per degree of freedom", ylabel="share", title=title)
    panels[0].legend()
    seeds = f"seeds {min(arguments.seeds)}–{max(arguments.seeds)}"
    figure.suptitle(f"{arguments.sensor}, zigzag and loops, {seeds}, {NOISE}", fontsize=9)
    figure.savefig(arguments.figure, dpi=110)


if __name__ == "__main__":
    main()
