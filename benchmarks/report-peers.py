"""The report's programs: ours beside PCL's registrations, on the flights of its plots, and GICP trait by trait.

    PYTHONPATH=. .venv/bin/python benchmarks/report-peers.py [--repeats 3] [--traits 3.5 vertical gicp]

Prints the tables of report-peers.md. Builds `pcl-peer.cpp` first, which takes a minute and Debian's libpcl-dev, g++ and
pkg-config. Both programs get the same scans and the same drifting poses, in a few draws of the sensor's noise: PCL
stops GICP where single precision hides the gradient, so that micrometres decide what it finds."""

import argparse
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from steelnb import experiment
from steelnb.core.determinism import machine
from steelnb.core.types import Array, Flight, Trajectory
from steelnb.metrics import position_error_m
from steelnb.odometry import make_odometry, run
from steelnb.settings import ExperimentSettings, OdometrySettings, read_report_plots
from steelnb.simulation import Truth

ROWS: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "as it was": ({}, ()),
    "floor removed": ({}, ("floor",)),
    "scan thinned": ({}, ("thinning",)),
    "no step refused": ({}, ("gates",)),
    "right order of composition": ({}, ("order",)),
    "covariances as they are": ({}, ("covariances",)),
    "our solver and stopping rule": ({}, ("solver",)),
    "mount of the sensor known": ({}, ("mount",)),
    "noise of 4 cm": ({"tof.sigma_floor_m": 0.04}, ()),
    "noise along the ray": ({"tof.noise_on": "range"}, ()),
    "noise of 4 cm along the ray, floor removed": ({"tof.sigma_floor_m": 0.04, "tof.noise_on": "range"}, ("floor",)),
    "every scan of the sensor": ({"tof.samples": ()}, ()),
    "half pixel in place": ({"tof.pixel_origin": "centre"}, ()),
}
"""Rows of the second table: overrides of the simulation, and the traits that are switched."""


Run = tuple[Flight | None, Flight]
"""The flight that was broken off before, or None, and the flight."""


def repeated(given: tuple[str, str, str], changes: dict[str, Any], repeats: int) -> tuple[list[Run], Truth]:
    """Draws of the sensor's noise on the flight of a plot."""
    settings = ExperimentSettings.report(*given, f"report-{given[2]}", changes)
    drawn = list(experiment.draws(settings, repeats))
    return [(experiment.broken_off(each), flight) for each, flight, _ in drawn], drawn[0][2]


def ours(method: str, flown: Run, switched: tuple[str, ...] = ()) -> Trajectory:
    """Poses of our program."""
    before, flight = flown
    settings = OdometrySettings.preset(method, "report", {"switched": switched})
    return run(flight, make_odometry(settings, flight.T_drone_sensor), before=before).corrected


def peer(program: Path, method: str, flown: Run) -> Trajectory:
    """Poses of PCL's program."""
    scans, poses = program.with_name("scans"), program.with_name("poses")
    given = [
        (scan, T) for each in flown if each for scan, T in zip(each.scans, each.prior.T_world_drone, strict=True)
    ]  # fmt: skip
    with scans.open("wb") as file:
        file.write(np.uint32(len(given)).tobytes())
        for scan, T in given:
            points = scan.points[np.isfinite(scan.points).all(axis=-1)]
            file.write(np.uint32(len(points)).tobytes() + T.tobytes() + points.astype(np.float32).tobytes())
    subprocess.run([program, method, scans, poses], check=True, capture_output=True)
    prior = flown[1].prior
    correction = np.fromfile(poses).reshape(-1, 17)[-len(prior) :, :16].reshape(-1, 4, 4)
    return Trajectory(prior.stamp_s, correction @ prior.T_world_drone)


def built(folder: str) -> Path:
    """The peer's program, compiled into a folder."""
    source, program = Path(__file__).with_name("pcl-peer.cpp"), Path(folder) / "pcl-peer"
    asked = ["pkg-config", "--cflags", "--libs", "pcl_registration", "pcl_filters"]
    flags = subprocess.run(asked, check=True, capture_output=True, text=True).stdout.split()
    subprocess.run(["g++", "-O2", "-std=c++17", source, "-o", program, *flags], check=True)
    return program


def errors(found: list[Trajectory], truth: Truth) -> Array:
    """Mean, largest and last error of each trajectory ``(R, 3)``, metres."""
    return np.array([[e.mean(), e.max(), e[-1]] for e in (position_error_m(each, truth.trajectory) for each in found)])


def told(error: Array) -> str:
    """Means over the repeats, and the range of the mean error."""
    mean, low, high = error.mean(axis=0), error[:, 0].min(), error[:, 0].max()
    return f"{mean[0]:.3f} / {mean[1]:.3f} / {mean[2]:.3f} | {low:.3f}–{high:.3f}"


def by_program(asked: argparse.Namespace) -> None:
    """Print the first table."""
    print("| plot | program | PCL | range | ours | range | ours / PCL |\n|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        program = built(folder)
        for plot in (each for each in read_report_plots() if each.method != "average" and not each.run):
            method, given = f"report-{plot.method}", (plot.figure, plot.trajectory, plot.method)
            flights, truth = repeated(given, {}, asked.repeats)
            theirs = errors([peer(program, method, each) for each in flights], truth)
            mine = errors([ours(method, each) for each in flights], truth)
            ratio = mine[:, 0].mean() / theirs[:, 0].mean()
            row = f"{plot.figure} {plot.trajectory} | {method} | {told(theirs)} | {told(mine)} | {ratio:.2f}"
            print(f"| {row} |", flush=True)


def by_trait(asked: argparse.Namespace) -> None:
    """Print the second table, of one plot."""
    method = f"report-{asked.traits[2]}"
    print(f"| trait of `{method}` | error | range |\n|---|---|---|")
    for name, (changes, switched) in ROWS.items():
        flights, truth = repeated(tuple(asked.traits), changes, asked.repeats)
        found = [ours(method, each, switched) for each in flights]
        print(f"| {name} | {told(errors(found, truth))} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3, help="draws of the sensor's noise")
    parser.add_argument("--traits", nargs=3, metavar=("FIGURE", "TRAJECTORY", "METHOD"), help="the second table")
    asked = parser.parse_args()
    print(f"{machine()}; {asked.repeats} repeats\n")
    (by_trait if asked.traits else by_program)(asked)


if __name__ == "__main__":
    main()
