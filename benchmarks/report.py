"""The report's flights: our methods on the scans of its sensor, and when its flights started.

    PYTHONPATH=. .venv/bin/python benchmarks/report.py [--parts ours start] [--figures 3.2 3.3 3.5 3.6]

`ours` prints the errors of `best`, `faces` and `smoothed` on the flights of the report's plots, with the driver's half
pixel in the points, also with a mount that is said to be unknown, and without it. `start` prints how well the time that
a slow program took for a sample agrees with the number of points in view, by the seconds of rest before the flight. The
report's programs are notebooks 02 and 03. With STEELNB_CACHE set to a folder, flights and estimates are kept between
calls."""

import argparse
from typing import Any

import numpy as np

from steelnb import experiment
from steelnb.core.determinism import machine
from steelnb.core.types import Array, Flight
from steelnb.metrics import position_error_m
from steelnb.points import preprocess_scan
from steelnb.settings import ExperimentSettings, read_report_plots
from steelnb.settings.report_plots import STEP_S

OURS = ("best", "faces", "smoothed")
UNKNOWN: dict[str, Any] = {"mount.rotation_sigma_deg": 2.0, "mount.translation_sigma_m": 0.03}
HALVES: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("with", "corner", {}),
    ("with, mount unknown", "corner", UNKNOWN),
    ("without", "centre", {}),
)
"""Name, `TofSettings.pixel_origin`, and what our methods are told of the mount, which the half pixel turns."""
REST_S = np.arange(0.0, 15.1, 0.5)
"""Seconds of rest that `start` tries."""


def ours(figure: str) -> None:
    """Print the errors of our methods on the flights of a figure, with every scan of the sensor from the start."""
    for plot in (plot for plot in read_report_plots() if plot.figure == figure and plot.method in ("average", "icp")):
        for half, origin, mount in HALVES:
            every = {"tof.samples": (), "tof.pixel_origin": origin}
            given = (plot.figure, plot.trajectory, plot.method)
            errors = []
            for method in OURS:
                if mount and method == "best":  # does not estimate it
                    errors.append(np.full(1, np.nan))
                    continue
                settings = ExperimentSettings.report(*given, method, every | mount)
                flight, truth = experiment.simulate(settings)
                found = experiment.estimate(settings, flight, truth)
                errors.append(position_error_m(found.corrected, truth.trajectory))
            raw = position_error_m(flight.prior, truth.trajectory)
            told = (f"{1e3 * np.sqrt((e**2).mean()):.1f} / {1e3 * e.max():.0f}" for e in (raw, *errors))
            print(f"| {plot.figure} {plot.trajectory}, {plot.noise} | {half} | {' | '.join(told)} |", flush=True)


def points_in_view(flight: Flight, by_segments: bool, settings: ExperimentSettings) -> Array:
    """Number of points that a program of the report takes from each scan."""
    if by_segments:
        crop = settings.odometry.preprocess.replace(floor_m=-1e6)
        return np.array([
            len(preprocess_scan(scan, T, np.eye(4), crop))
            for scan, T in zip(flight.scans, flight.prior.T_world_drone, strict=True)
        ])  # fmt: skip
    return np.array([np.isfinite(scan.points[..., 0]).sum() for scan in flight.scans])


def detrended(values: Array) -> Array:
    """Logarithms without their quadratic trend: a program slows down as its map grows."""
    x = np.arange(len(values))
    logs = np.log(values)
    return np.asarray(logs - np.polyval(np.polyfit(x, logs, 2), x))


def start() -> None:
    """Print, for each plot of a slow program, the correlation of its time a sample with the points in view. Then print
    the rest that is likeliest for all plots of a trajectory."""
    together: dict[str, Array] = {}
    for plot in (each for each in read_report_plots() if not each.steps_per_sample):
        settings = ExperimentSettings.preset(
            plot.flight or plot.trajectory,  # type: ignore[arg-type]
            "none", "report-segments", "report", "report", plot.duration_s - 10.0, {"tof.sigma_floor_m": 0.0},
        ).override({"flight.still_s": 0.0})  # fmt: skip
        flight, _ = experiment.simulate(settings)
        count = points_in_view(flight, plot.method == "average", settings)
        time_s, took_s = STEP_S * plot.steps[:-1], STEP_S * np.diff(plot.steps)
        shared = []
        for rest_s in REST_S:
            seen = np.interp(np.maximum(time_s - rest_s, 0.0), flight.prior.stamp_s, count)
            shared.append(float(np.corrcoef(detrended(took_s), detrended(seen + 20.0))[0, 1]))
        trajectory = plot.flight or plot.trajectory
        likelihood = -0.5 * len(took_s) * np.log(1 - np.square(shared))  # of a Gaussian scatter about the trend
        together[trajectory] = together.get(trajectory, 0.0) + likelihood
        best = int(np.argmax(shared))
        near = REST_S[np.array(shared) > max(shared) - 0.02]
        print(
            f"| {plot.name} | {REST_S[best]:g} s | {near.min():g}–{near.max():g} s | {shared[best]:.2f} "
            f"| {shared[0]:.2f} |", flush=True,
        )  # fmt: skip
    for trajectory, likelihood in together.items():
        print(f"| {trajectory}, all | {REST_S[int(np.argmax(likelihood))]:g} s | | | |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figures", nargs="+", default=["3.2", "3.3", "3.5", "3.6"])
    parser.add_argument("--parts", nargs="+", choices=["ours", "start"], default=["ours", "start"])
    asked = parser.parse_args()
    print(f"{machine()}\n")
    if "ours" in asked.parts:
        print(f"| flight | half pixel | drift | {' | '.join(OURS)} |\n{'|---' * (3 + len(OURS))}|")
        for name in asked.figures:
            ours(name)
    if "start" in asked.parts:
        print(f"\n| plot | best | within 0.02 | correlation | without rest |\n{'|---' * 5}|")
        start()


if __name__ == "__main__":
    main()
