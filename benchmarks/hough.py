"""The Hough transform beside the published program: the same points, the same lines, alternating runs on one core.

    .venv/bin/python benchmarks/hough.py REFERENCE_EXE --data FOLDER > benchmarks/hough.md

REFERENCE_EXE is hough3dlines, built with its own Makefile from https://github.com/cdalitz/hough-3d-lines; FOLDER holds
its point clouds (*.dat), and may be left out. The Python package hough3d is measured where it can be imported. Seconds
belong to the machine named in the table, ratios less so.
"""

# ruff: noqa: E402 - libraries count their threads when they are imported, so the core is pinned before
import argparse
import importlib.metadata
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from unittest.mock import patch

os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np
from numba import njit

from shared import command
from steelnb import rng
from steelnb.hough import detect_lines, directions, lines
from steelnb.hough.transform import iterate
from steelnb.hough.votes import far_apart
from steelnb.report.results import machine
from steelnb.settings import ExperimentSettings
from steelnb.simulation import build_tower, fly, scan_flight
from steelnb.types import Array, Lines, Trajectory

Found = TypeVar("Found")
SIZES, WIDTHS, MIN_VOTES, RUNS, DENSER = (2_000, 5_000, 10_000, 20_000, 50_000), (0.1, 0.05), 20, 3, 4
AT_S = (20.0, 60.0, 100.0, 140.0, 180.0)
GOAL = {0.1: 40, 0.05: 100}
NOTES = """The programs take turns on one core and get the same points, with six digits. *Time*: of the reference, what
its process used on the core less what it uses to start, to read the file and to refuse a dx that is too large; of ours,
what the call used, after compilation. *Same lines*: as many, each with the same count, its anchor within 1e-6 (the last
of the six digits printed) and its direction within 1e-4°. *Votes*: increments of a cell, for a point or a cube of
points, as a share of points × directions, which the reference casts before it takes votes back. *Plain loop*:
`image[index[i]] += 1` and no more, with the index at hand, over the points in the order of the scan and in one that
keeps neighbours apart.
"""
FRAMES = """{} of a sensor with {}² times the pixels of the flight's, at {} s; of each frame so many points by chance.
Times are medians over the frames, *ratio* the median of the ratios that follow it.

| points | dx (m) | lines | same | reference (ms) | ours (ms) | ratio | goal | votes | ns a vote | plain loop (ns) |
|---|---|---|---|---|---|---|---|---|---|---|"""
CLOUDS = """| cloud | points | dx | lines | same lines | reference (ms) | steelnb (ms) | ratio |
|---|---|---|---|---|---|---|---|"""
LARGE = """dx {} m, min_votes {}, granularity {}, skip_weak {}; *experiments*: at most {} lines. Peak memory is of a
process of its own, libraries included.

| cloud | points | lines | time (ms) | votes | ns a vote | peak memory (MB) |
|---|---|---|---|---|---|---|"""
PACKAGE = """hough3d {}, {} directions, after compilation: the same method in Numba, all votes kept. It cuts off where
the reference rounds, and it stops otherwise, so its lines differ.

| points | dx (m) | hough3d: lines, ms | steelnb: lines, ms | ratio |
|---|---|---|---|---|"""


def frames(at_s: tuple[float, ...]) -> list[tuple[Array, Array]]:
    """(points in the sensor frame, pose) of scans of the tower from a zigzag; the ground is left out."""
    s = ExperimentSettings.preset(duration_s=max(at_s) + 1.0)
    tof = s.tof.model_copy(update={"columns": DENSER * s.tof.columns, "rows": DENSER * s.tof.rows, "rate_hz": 1.0})
    tower = build_tower(s.tower)
    flight, _ = fly(tower, s.flight, s.seed)
    poses = flight.at(np.array([*at_s, at_s[-1]])).T_world_drone  # a flight has one pose after its last scan
    scans, _ = scan_flight(
        tower, Trajectory(np.arange(len(poses), dtype=np.float64), poses), tof.T_drone_sensor, tof, s.seed
    )
    found = []
    for scan, T in zip(scans, poses @ tof.T_drone_sensor, strict=False):
        points = np.asarray(scan.points, dtype=np.float64).reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)]
        found.append((points[points @ T[2, :3] + T[2, 3] > 0.3], T))
    return found


def some(points: Array, size: int) -> Array:
    """So many of the points, in their order, with the six digits that a file gets."""
    chosen = rng.stream(1, "benchmark", size).permutation(len(points))[:size]
    return np.round(points[np.sort(chosen)], 6)


def reference(exe: Path, file: Path, *options: str) -> tuple[float, Array]:
    """Seconds on the core of one run of the reference, and its lines (anchor, direction, count) ``(M, 7)``."""
    process = subprocess.Popen(
        [exe, "-raw", *options, file], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert process.stdout
    rows = process.stdout.read().splitlines()[2:]
    process.stdout.close()
    _, process.returncode, usage = os.wait4(process.pid, 0)
    return usage.ru_utime + usage.ru_stime, np.array([row.split() for row in rows], dtype=float).reshape(-1, 7)


def timed(call: Callable[[], Found]) -> tuple[float, Found]:
    """(seconds on the core, what the call returned)."""
    began = time.process_time()
    found = call()
    return time.process_time() - began, found


def votes_of(call: Callable[[], Lines]) -> int:
    """The votes that a call of `detect_lines` casts."""
    cast: list[int] = []

    def counted(*arguments: Any) -> tuple[int, int]:
        found, votes = iterate(*arguments)
        cast.append(votes)
        return found, votes

    with patch.object(lines, "iterate", counted):
        call()
    return cast[0]


def same(ours: Lines, theirs: Array) -> bool:
    """Whether two programs found the same lines, in the same order."""
    if len(ours) != len(theirs) or not (ours.count == theirs[:, 6]).all():
        return False
    u = theirs[:, 3:6] / np.linalg.norm(theirs[:, 3:6], axis=1)[:, None]
    angle = np.degrees(np.arcsin(np.minimum(np.linalg.norm(np.cross(ours.direction, u), axis=1), 1)))
    return bool(np.abs(ours.anchor - theirs[:, :3]).max(initial=0) <= 1.05e-6 and angle.max(initial=0) < 1e-4)


def compare(exe: Path, file: Path, points: Array, dx: float, min_votes: int) -> tuple[float, float, Lines, bool]:
    """Seconds of the reference and ours in alternating runs, our lines, and whether they are the reference's."""
    options = ("-dx", repr(dx), "-minvotes", str(min_votes))
    their_s, our_s = [], []
    for _ in range(RUNS):
        start_s, _ = reference(exe, file, "-dx", "1e9")
        run_s, theirs = reference(exe, file, *options)
        seconds, ours = timed(lambda: detect_lines(points, dx, min_votes))
        their_s.append(run_s - start_s)
        our_s.append(seconds)
    return float(np.median(their_s)), float(np.median(our_s)), ours, same(ours, theirs)


def lattice_frames(exe: Path, clouds: list[Array], folder: Path) -> dict[str, bool]:
    """Print the times on frames of each size and dx; which goals were reached."""
    print(FRAMES.format(len(clouds), DENSER, ", ".join(f"{t:.0f}" for t in AT_S)))
    file, reached, equal, cost = folder / "frame.dat", {}, [], []
    for dx in WIDTHS:
        for size in SIZES:
            runs, votes = [], []
            for cloud in clouds:
                points = some(cloud, size)
                np.savetxt(file, points, fmt="%.6f", delimiter=",")
                runs.append(compare(exe, file, points, dx, MIN_VOTES))
                votes.append(votes_of(partial(detect_lines, points, dx, MIN_VOTES)))
            theirs, ours = (np.array([run[k] for run in runs]) for k in (0, 1))
            ratio, vote_ns = theirs / ours, 1e9 * np.median(ours / votes)
            plain = [plain_loop_ns(points, dx, apart) for apart in (False, True)]
            equal += [run[3] for run in runs]
            cost.append((vote_ns / plain[0], vote_ns / plain[1]))
            goal = f"{GOAL[dx]} × on {size} points, dx {dx}"
            reached[goal] = bool(np.median(ratio) >= GOAL[dx])
            numbers, ratios = ", ".join(str(len(run[2])) for run in runs), ", ".join(f"{r:.0f}" for r in ratio)
            print(
                f"| {size} | {dx} | {numbers} | {sum(run[3] for run in runs)} of {len(runs)} "
                f"| {1e3 * np.median(theirs):.0f} | {1e3 * np.median(ours):.1f} "
                f"| **{np.median(ratio):.0f}**: {ratios} | {GOAL[dx]} "
                f"| {np.median(votes) / size / len(directions(4)):.2f} | {vote_ns:.2f} "
                f"| {plain[0]:.2f}, {plain[1]:.2f} |",
                flush=True,
            )
    worst = np.max(cost, axis=0)
    reached[f"a vote in 2 × a plain loop in the order of the scan (worst {worst[0]:.1f})"] = bool(worst[0] <= 2)
    reached[f"a vote in 2 × a plain loop over neighbours apart (worst {worst[1]:.1f})"] = bool(worst[1] <= 2)
    reached["the reference's lines on every frame"] = all(equal)
    print()
    return reached


@njit
def plain_loop(index, image, times):  # type: ignore[no-untyped-def]
    for _ in range(times):
        for i in range(len(index)):
            image[index[i]] += 1


def plain_loop_ns(points: Array, dx: float, apart: bool) -> float:
    """Nanoseconds for each increment of the image of the direction z."""
    order = far_apart(len(points)) if apart else np.arange(len(points))
    cell = np.round((points[order, :2] - points[:, :2].min(axis=0)) / dx).astype(np.uint32)
    columns = int(2 * np.linalg.norm(np.ptp(points, axis=0)) / dx)
    image, times = np.zeros(columns**2, np.int32), 20_000_000 // len(points)
    index = cell[:, 0] * np.uint32(columns) + cell[:, 1]
    plain_loop(index, image, 1)
    return 1e9 * min(timed(lambda: plain_loop(index, image, times))[0] for _ in range(RUNS)) / times / len(points)


def public_clouds(exe: Path, folder: Path) -> dict[str, bool]:
    """Print the times on the reference's own clouds, with its default dx and two others; whether the lines agree."""
    print(CLOUDS)
    equal = []
    for file in sorted(folder.rglob("*.dat")):
        points = np.loadtxt(file, delimiter=",", comments="#")[:, :3]
        diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
        for parts in (64, 40, 100):
            theirs, ours, found, agree = compare(exe, file, points, diagonal / parts, 2)
            equal.append(agree)
            print(
                f"| {file.stem} | {len(points)} | diagonal/{parts} | {len(found)} | {'yes' if agree else 'no'} "
                f"| {1e3 * theirs:.0f} | {1e3 * ours:.1f} | {theirs / ours:.0f} |",
                flush=True,
            )
    print()
    return {f"the reference's lines on its {len(equal) // 3} clouds × 3 dx": all(equal)}


def large_clouds(cloud: Array, tower: Array, folder: Path) -> dict[str, bool]:
    """Print time and memory with the settings of the experiments, on one frame and on the tower that a flight saw."""
    s = ExperimentSettings.preset().odometry.hough
    assert s, "the default odometry is by segments"
    print(LARGE.format(s.dx_m, s.min_votes, s.granularity, s.skip_weak, s.max_lines))
    reached = {}
    for what, points, limit_ms in (("frame", some(cloud, 10_000), 12), ("tower", some(tower, 100_000), 150),
                                   ("tower", some(tower, 1_000_000), 3000)):  # fmt: skip
        for most in (s.max_lines, None):
            call = partial(detect_lines, points, s.dx_m, s.min_votes, most, s.granularity, s.skip_weak)
            ours = [timed(call) for _ in range(2 * RUNS - 1)]
            seconds, votes = float(np.median([run[0] for run in ours])), votes_of(call)
            peak = peak_mb(points, folder, s.dx_m, s.min_votes, most, s.granularity, s.skip_weak)
            name = f"{what}, {'experiments' if most else 'all lines'}"
            print(
                f"| {name} | {len(points)} | {len(ours[0][1])} | {1e3 * seconds:.1f} "
                f"| {votes / len(points) / len(directions(s.granularity)):.2f} | {1e9 * seconds / votes:.2f} "
                f"| {peak:.0f} |",
                flush=True,
            )
            if most:
                reached[f"{len(points)} points in {limit_ms} ms"] = 1e3 * seconds <= limit_ms
            reached["under 1 GB"] = reached.get("under 1 GB", True) and peak < 1000
    print()
    return reached


def peak_mb(points: Array, folder: Path, *arguments: object) -> float:
    """Peak memory of a process that loads the points and finds their lines, MB."""
    np.save(folder / "cloud.npy", points)
    code = (
        "import numpy as np; from steelnb.hough import detect_lines; "
        f"detect_lines(np.load('cloud.npy'), *{arguments!r}); "
        "print([row.split()[1] for row in open('/proc/self/status') if row.startswith('VmHWM')][0])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, stdout=subprocess.PIPE, text=True, check=True)
    return float(done.stdout) * 1024 / 1e6


def python_package(clouds: list[Array]) -> None:
    """Print the time of hough3d on the smallest frames. Its cells, its stop and its radius are a little different."""
    if not importlib.util.find_spec("hough3d"):
        print("hough3d is not installed.\n")
        return
    hough3d = importlib.import_module("hough3d")
    sphere = hough3d.genIcosahedron(4)
    print(PACKAGE.format(importlib.metadata.version("hough3d"), len(sphere)))
    hough3d.hough3D(some(clouds[0], 100), sphere, 20, 0.01, 2)
    for size, dx in ((2_000, 0.1), (5_000, 0.1), (2_000, 0.05)):
        points = some(clouds[0], size)
        diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
        began = time.process_time()
        theirs = hough3d.hough3D(points, sphere, round(diagonal / dx), dx / diagonal, MIN_VOTES)
        middle = time.process_time()
        ours = detect_lines(points, dx, MIN_VOTES)
        their_s, our_s = middle - began, time.process_time() - middle
        print(
            f"| {size} | {dx} | {len(theirs)}, {1e3 * their_s:.0f} | {len(ours)}, {1e3 * our_s:.1f} "
            f"| {their_s / our_s:.0f} |",
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
    clouds = [points for points, _ in frames(AT_S)]
    parts = frames(tuple(np.arange(10.0, 200.0, 19.0).tolist()))
    tower = np.concatenate([points @ T[:3, :3].T + T[:3, 3] for points, T in parts])
    detect_lines(some(clouds[0], 100), 0.1)
    reached: dict[str, bool] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if given.data:
            print("## The reference's own clouds, all lines\n")
            reached |= public_clouds(exe, given.data)
        print(f"## Ray-cast frames of the tower, min_votes {MIN_VOTES}, all lines\n")
        reached |= lattice_frames(exe, clouds, folder)
        print("## The settings of the experiments, and larger clouds\n")
        reached |= large_clouds(clouds[0], tower, folder)
    print("## The Python package\n")
    python_package(clouds)
    print("## Goals\n\n| goal | reached |\n|---|---|")
    for goal, done in reached.items():
        print(f"| {goal} | {'yes' if done else '**no**'} |")


if __name__ == "__main__":
    main()
