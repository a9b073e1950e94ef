"""The report's programs as they were, ours beside PCL's own registrations in the same loop; and GICP trait by trait.

Run: .venv/bin/python benchmarks/report-peers.py [--duration 60] [--repeats 3] [--traits] > benchmarks/report-peers.md
Builds `pcl-peer.cpp` first, which takes a minute and Debian's libpcl-dev, g++ and pkg-config. Both programs get the
same scans and the same drifting poses. In each repeat other micrometres of noise are added to the points: PCL stops
GICP where single precision hides the slope, so that such noise decides what it finds.
"""

import argparse
import itertools
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from steelnb import experiment
from steelnb.metrics import position_error_m
from steelnb.odometry import make_odometry, run
from steelnb.report.results import machine
from steelnb.rng import stream
from steelnb.settings import ExperimentSettings, OdometrySettings, TrajectoryName
from steelnb.simulation import Truth
from steelnb.types import Array, Flight, Scan, Trajectory

METHODS = ("report-icp", "report-icp-3dof", "report-gicp")
JITTER_M = 1e-6
NOISE = {"tof.sigma_floor_m": 0.01}
"""The report's: 1 cm."""
Row = tuple[dict[str, float], tuple[str, ...]]
ROWS: dict[str, Row] = {
    "as it was": (NOISE, ()),
    "floor removed": (NOISE, ("floor",)),
    "scan thinned": (NOISE, ("thinning",)),
    "no step refused": (NOISE, ("gates",)),
    "right order of composition": (NOISE, ("order",)),
    "covariances as they are": (NOISE, ("covariances",)),
    "our solver and stopping rule": (NOISE, ("solver",)),
    "mount of the sensor known": (NOISE, ("mount",)),
    "noise of 4 cm": ({"tof.sigma_floor_m": 0.04}, ()),
}
"""Rows of the second table: overrides of the sensor, where noise along the ray or across the image belongs, too, and
the traits that are switched."""


def simulated(
    trajectory: TrajectoryName, noise: str, asked: argparse.Namespace, sensor: dict[str, float] = NOISE
) -> tuple[Flight, Truth]:
    """The flight of a row."""
    given = (trajectory, noise, "report-gicp", asked.sensor, asked.seed, asked.duration, sensor)
    return experiment.simulate(ExperimentSettings.preset(*given))


def jittered(flight: Flight, every: int, repeat: int) -> Flight:
    """One scan in ``every``, its points moved by micrometres."""
    noise, kept = stream(0, "jitter", repeat), range(0, len(flight), every)
    scans = [
        Scan(s.stamp_s, s.points + noise.normal(0, JITTER_M, s.points.shape)) for s in (flight.scans[k] for k in kept)
    ]
    return replace(flight, scans=scans, prior=Trajectory(flight.prior.stamp_s[kept], flight.prior.T_world_drone[kept]))


def ours(method: str, flight: Flight, switched: tuple[str, ...] = ()) -> tuple[Trajectory, float]:
    """Poses by our program, and its milliseconds a scan."""
    settings = OdometrySettings.preset(method, "report", {"report_clouds.switched": switched})
    found = run(flight, make_odometry(settings, flight.T_drone_sensor))
    return found.corrected, 1e3 * float(found.update_s.mean())


def peer(program: Path, method: str, flight: Flight) -> tuple[Trajectory, float]:
    """Poses by PCL's, and its milliseconds a scan."""
    scans, poses = program.with_name("scans"), program.with_name("poses")
    with scans.open("wb") as file:
        file.write(np.uint32(len(flight)).tobytes())
        for scan, T in zip(flight.scans, flight.prior.T_world_drone, strict=True):
            points = scan.points[np.isfinite(scan.points).all(axis=-1)]
            file.write(np.uint32(len(points)).tobytes() + T.tobytes() + points.astype(np.float32).tobytes())
    done = subprocess.run([program, method, scans, poses], check=True, capture_output=True, text=True)
    correction = np.fromfile(poses).reshape(-1, 17)[:, :16].reshape(-1, 4, 4)
    return Trajectory(flight.prior.stamp_s, correction @ flight.prior.T_world_drone), float(done.stdout)


def built(folder: str) -> Path:
    """The peer's program, compiled into a folder."""
    source, program = Path(__file__).with_name("pcl-peer.cpp"), Path(folder) / "pcl-peer"
    asked = ["pkg-config", "--cflags", "--libs", "pcl_registration", "pcl_filters"]
    flags = subprocess.run(asked, check=True, capture_output=True, text=True).stdout.split()
    subprocess.run(["g++", "-O2", "-std=c++17", source, "-o", program, *flags], check=True)
    return program


def errors(found: list[Trajectory], truth: Truth) -> Array:
    """Mean, largest and last error of each trajectory ``(R, 3)``, metres."""
    error = [position_error_m(trajectory, truth.trajectory) for trajectory in found]
    return np.array([[e.mean(), e.max(), e[-1]] for e in error])


def told(error: Array) -> str:
    """Means over the repeats, and the range of the mean error."""
    mean, low, high = error.mean(axis=0), error[:, 0].min(), error[:, 0].max()
    return f"{mean[0]:.3f} / {mean[1]:.3f} / {mean[2]:.3f} | {low:.3f}–{high:.3f}"


def by_program(asked: argparse.Namespace) -> None:
    """Print the first table."""
    print("| flight | program | PCL | range | ours | range | ours / PCL | ms a scan, PCL | ours |")
    print("|---|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        program = built(folder)
        for trajectory, noise in itertools.product(asked.trajectories, asked.noises):
            flight, truth = simulated(trajectory, noise, asked)
            for method in METHODS:
                flights = [jittered(flight, asked.every if "gicp" in method else 1, k) for k in range(asked.repeats)]
                sides = [peer(program, method, moved) for moved in flights], [ours(method, moved) for moved in flights]
                theirs, mine = (errors([found for found, _ in side], truth) for side in sides)
                ms = [np.mean([cost for _, cost in side]) for side in sides]
                print(f"| {trajectory}, {noise} | {method} | {told(theirs)} | {told(mine)} ", end="")
                print(f"| {mine[:, 0].mean() / theirs[:, 0].mean():.2f} | {ms[0]:.0f} | {ms[1]:.0f} |", flush=True)


def by_trait(asked: argparse.Namespace) -> None:
    """Print the second table."""
    print("| flight | trait of `report-gicp` | error | range |\n|---|---|---|---|")
    for trajectory, noise in itertools.product(asked.trajectories, asked.noises):
        for name, (sensor, switched) in ROWS.items():
            flight, truth = simulated(trajectory, noise, asked, sensor)
            flights = [jittered(flight, asked.every, k) for k in range(asked.repeats)]
            found = [ours("report-gicp", moved, switched)[0] for moved in flights]
            print(f"| {trajectory}, {noise} | {name} | {told(errors(found, truth))} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trajectories", nargs="+", default=["orbit", "vertical"])
    parser.add_argument("--noises", nargs="+", default=["random-walk", "constant-drift"])
    parser.add_argument("--sensor", default="report")
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--duration", type=float, default=60.0, help="seconds")
    parser.add_argument("--every", type=int, default=1, help="GICP takes one scan in so many")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--traits", action="store_true", help="the second table instead of the first")
    asked = parser.parse_args()
    given = f"seed {asked.seed}, {asked.duration:g} s, GICP takes one scan in {asked.every}, {asked.repeats} repeats"
    print(f"{machine()}; {given}.\nErrors in metres: mean / largest / last, each the mean over the repeats, and the")
    print("range of the mean.\n")
    (by_trait if asked.traits else by_program)(asked)


if __name__ == "__main__":
    main()
