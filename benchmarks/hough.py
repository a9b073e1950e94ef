"""The Hough transform beside the published program: the same points, the same lines, alternating runs on one core.

    .venv/bin/python benchmarks/hough.py REFERENCE_EXE --data FOLDER > benchmarks/hough.md

REFERENCE_EXE is hough3dlines, built with its own Makefile from https://github.com/cdalitz/hough-3d-lines. FOLDER holds
its point clouds (*.dat) and may be omitted. Times depend on the machine named in the table, ratios less so.
"""

from shared import command  # first, as it pins the core

# isort: split
import argparse
import os
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from steelnb.core import rng
from steelnb.core.determinism import machine
from steelnb.core.types import Array, Lines, Trajectory
from steelnb.hough import detect_lines
from steelnb.settings import ExperimentSettings
from steelnb.simulation import build_tower, fly, scan_flight

SIZES, WIDTHS, MIN_VOTES, RUNS, DENSER = (2_000, 5_000, 10_000, 20_000, 50_000), (0.1, 0.05), 20, 3, 4
AT_S = (20.0, 60.0, 100.0, 140.0, 180.0)
NOTES = """The programs take turns on one core and get the same points, with six digits. *Time* is CPU time: for the
reference, that of its process without starting, reading the file and refusing a dx that is too large; for ours, that of
the call after compilation. *Same lines*: the same number of lines, each with the same count, its anchor within 1e-6
(the last of the six digits printed) and its direction within 1e-4°.
"""
FRAMES = """{} frames of a sensor with {}² times the flight's pixels, at {} s; a random subset of each frame's points.
Times are medians over the frames; *ratio* is the median of the ratios that follow it.

| points | dx (m) | lines | same | reference (ms) | ours (ms) | ratio |
|---|---|---|---|---|---|---|"""
CLOUDS = """| cloud | points | dx | lines | same lines | reference (ms) | steelnb (ms) | ratio |
|---|---|---|---|---|---|---|---|"""


def frames() -> list[Array]:
    """Points of scans of the tower from a zigzag, in the sensor frame, without the ground."""
    s = ExperimentSettings.preset(duration_s=max(AT_S) + 1.0)
    tof = s.tof.model_copy(update={"columns": DENSER * s.tof.columns, "rows": DENSER * s.tof.rows, "rate_hz": 1.0})
    tower = build_tower(s.tower)
    flight, _ = fly(tower, s.flight, s.seed)
    poses = flight.at(np.array([*AT_S, AT_S[-1]])).T_world_drone  # a flight has one pose after its last scan
    scans, _ = scan_flight(tower, Trajectory(np.arange(len(poses), dtype=np.float64), poses), tof, s.seed)
    found = []
    for scan, T in zip(scans, poses @ tof.T_drone_sensor, strict=False):
        points = np.asarray(scan.points, dtype=np.float64).reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)]
        found.append(points[points @ T[2, :3] + T[2, 3] > 0.3])
    return found


def some(points: Array, size: int) -> Array:
    """A random subset of ``size`` points in their order, rounded to the six digits that the file has."""
    chosen = rng.stream(1, "benchmark", size).permutation(len(points))[:size]
    return np.round(points[np.sort(chosen)], 6)


def reference(exe: Path, file: Path, *options: str) -> tuple[float, Array]:
    """CPU seconds of one run of the reference, and its lines (anchor, direction, count) ``(M, 7)``."""
    process = subprocess.Popen(
        [exe, "-raw", *options, file], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert process.stdout
    rows = process.stdout.read().splitlines()[2:]
    process.stdout.close()
    _, process.returncode, usage = os.wait4(process.pid, 0)
    return usage.ru_utime + usage.ru_stime, np.array([row.split() for row in rows], dtype=float).reshape(-1, 7)


def same(ours: Lines, theirs: Array) -> bool:
    """Whether two programs found the same lines, in the same order."""
    if len(ours) != len(theirs) or not (ours.count == theirs[:, 6]).all():
        return False
    u = theirs[:, 3:6] / np.linalg.norm(theirs[:, 3:6], axis=1)[:, None]
    angle = np.degrees(np.arcsin(np.minimum(np.linalg.norm(np.cross(ours.direction, u), axis=1), 1)))
    return bool(np.abs(ours.anchor - theirs[:, :3]).max(initial=0) <= 1.05e-6 and angle.max(initial=0) < 1e-4)


def compare(exe: Path, file: Path, points: Array, dx: float, min_votes: int) -> tuple[float, float, Lines, bool]:
    """Median CPU seconds of the reference and ours in alternating runs, our lines, and whether both agree."""
    options = ("-dx", repr(dx), "-minvotes", str(min_votes))
    their_s, our_s = [], []
    for _ in range(RUNS):
        start_s, _ = reference(exe, file, "-dx", "1e9")
        run_s, theirs = reference(exe, file, *options)
        began = time.process_time()
        ours = detect_lines(points, dx, min_votes)
        our_s.append(time.process_time() - began)
        their_s.append(run_s - start_s)
    return float(np.median(their_s)), float(np.median(our_s)), ours, same(ours, theirs)


def lattice_frames(exe: Path, folder: Path) -> None:
    """Print the times on frames of each size and dx."""
    clouds = frames()
    print(FRAMES.format(len(clouds), DENSER, ", ".join(f"{t:.0f}" for t in AT_S)))
    file = folder / "frame.dat"
    for dx in WIDTHS:
        for size in SIZES:
            runs = []
            for cloud in clouds:
                points = some(cloud, size)
                np.savetxt(file, points, fmt="%.6f", delimiter=",")
                runs.append(compare(exe, file, points, dx, MIN_VOTES))
            theirs, ours = (np.array([run[k] for run in runs]) for k in (0, 1))
            ratio = theirs / ours
            numbers, ratios = ", ".join(str(len(run[2])) for run in runs), ", ".join(f"{r:.0f}" for r in ratio)
            print(
                f"| {size} | {dx} | {numbers} | {sum(run[3] for run in runs)} of {len(runs)} "
                f"| {1e3 * np.median(theirs):.0f} | {1e3 * np.median(ours):.1f} "
                f"| **{np.median(ratio):.0f}**: {ratios} |",
                flush=True,
            )


def public_clouds(exe: Path, folder: Path) -> None:
    """Print the times on the reference's own clouds, with its default dx and two others."""
    print(CLOUDS)
    for file in sorted(folder.rglob("*.dat")):
        points = np.loadtxt(file, delimiter=",", comments="#")[:, :3]
        diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
        for parts in (64, 40, 100):
            theirs, ours, found, agree = compare(exe, file, points, diagonal / parts, 2)
            print(
                f"| {file.stem} | {len(points)} | diagonal/{parts} | {len(found)} | {'yes' if agree else 'no'} "
                f"| {1e3 * theirs:.0f} | {1e3 * ours:.1f} | {theirs / ours:.0f} |",
                flush=True,
            )
    print()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reference_exe", type=Path, help="the built program hough3dlines")
    parser.add_argument("--data", type=Path, help="folder with the reference's point clouds, *.dat")
    given = parser.parse_args()
    print(f"# The Hough transform on one core\n\n{machine()}. `{command(__doc__)}`\n\n{NOTES}")
    exe = given.reference_exe.resolve()
    detect_lines(rng.stream(1, "benchmark").random((100, 3)), 0.1)  # compiled before it is timed
    if given.data:
        print("## The reference's own clouds, all lines\n")
        public_clouds(exe, given.data)
    print(f"## Ray-cast frames of the tower, min_votes {MIN_VOTES}, all lines\n")
    with tempfile.TemporaryDirectory() as name:
        lattice_frames(exe, Path(name))


if __name__ == "__main__":
    main()
