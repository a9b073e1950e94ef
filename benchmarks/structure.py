"""The final reconstruction: time and memory over the area of a cloud, on whole flights, on surveyed towers.

    .venv/bin/python benchmarks/structure.py --surveyed FOLDER > benchmarks/structure.md

Every row is a process of its own on one pinned core, so its memory is its own. FOLDER holds clouds of towers as text,
such as the files 001Tower.txt to 010Tower.txt of https://github.com/HyperLambdaX/Insulator-PowerGrid-Extractor; without
--surveyed those are left out. Seconds belong to the machine named in the table, ratios less so.
"""

# ruff: noqa: E402 - libraries count their threads when they are imported, so the core is pinned before
import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[name] = "1"

import networkx as nx
import numpy as np
from scipy.spatial import cKDTree

from shared import command, in_own_process, peak_bytes
from steelnb import experiment, rng
from steelnb.fusion.reconstruct import reconstruct, reconstruct_cloud
from steelnb.fusion.structure import Structure
from steelnb.hough.blocks import within
from steelnb.hough.tube import tube_radius
from steelnb.io.clouds import read_cloud
from steelnb.report.results import machine
from steelnb.settings import ExperimentSettings, StructureSettings, TrajectoryName
from steelnb.simulation import build_tower
from steelnb.types import Array, IntArray, Segments

LEG_MIN_M, LEG_NEAR_M, LEG_GAP_M, LEG_SLOPE_MAX = 6.0, 0.3, 3.0, 0.35
"""Least length of a leg; distance of a bar or a point from it; largest gap; largest run over rise."""
TOWERS = (1, 2, 4, 8, 16)
POINTS = 312_500
"""On each tower: 16 of them make 5 million."""
APART_M, NOISE_M, JITTER_M = 12.0, 0.005, 1.0
NOTES = f"""Times are those of the process on its core, which on an idle core is the time that passes; compiled
parts are loaded before. *Peak* is that of the whole process, with the libraries and the cloud itself.

## A cloud against its area

Simulated towers side by side, {APART_M:g} m apart, {POINTS} points on the steel of each, 5 mm of noise. The goal: 60 s
and 2 GB for 5 million points, in time that grows with the area.
"""
FLIGHTS = """
## A whole flight

200 s, sensor starling2, random walk; `combined`: poses corrected by that odometry, whose time is not counted. The goal:
5 s."""
SURVEYED = f"""
## Surveyed towers

{{source}}
As `steelnb segment` would: *tube* is what it chooses from the points (`hough.tube.tube_radius`), all other lengths in
proportion. *Largest*: bars in the largest part that joints hold together. *Within*: share of the points within the
tube of a bar; *control*: the same share of points that are moved by up to 1 m along each axis, which is what bars
anywhere in so small a space would explain. *Bars in control*: what the reconstruction finds in the moved points.

*Legs*: straight pieces of legs, {LEG_MIN_M:g} m or longer, that are fitted apart, to the outermost point of each slice
of 1 m towards the four corners of the faces. *Leg coverage*: the largest share of a leg's visible length (points within
{LEG_NEAR_M:g} m) that one bar covers, which runs within {LEG_NEAR_M:g} m and 5° of it; the mean over the legs.

There is no list of the true bars, so recall is not known. To the eye, the X-bracing of the body, the rings and the
outlines of the arms are there. Missed or wrong: some legs come out in pieces or side by side, where braces
join them every metre or so; the small bars inside arms and feet, less than two tubes apart, merge or
are left out; many ends reach no joint, so there are fewer joints than bars; insulators and fittings stay
unexplained. Points a quarter of a metre apart do not show the width of a bar, so no section is fitted."""


def surface(size: int, seed: int) -> np.ndarray:
    """Points at random on the steel of the report's tower, with noise."""
    tower = build_tower()
    a, b, c = (tower.vertices[tower.triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    draw = rng.stream(1, "benchmark", seed)
    k = draw.choice(len(area), size, p=area / area.sum())
    share = draw.random((size, 2))
    outside = share.sum(axis=1) > 1
    share[outside] = 1 - share[outside]
    on = a[k] + share[:, :1] * (b - a)[k] + share[:, 1:] * (c - a)[k]
    return np.asarray(on + NOISE_M * draw.standard_normal((size, 3)))


def cloud(towers: int) -> dict:
    """A row of towers, reconstructed."""
    reconstruct_cloud(surface(20_000, 0))
    points = np.empty((towers * POINTS, 3))
    for k in range(towers):
        points[k * POINTS : (k + 1) * POINTS] = surface(POINTS, k) + np.array([APART_M * k, 0, 0])
    began = time.process_time()
    return _measured(reconstruct_cloud(points), began) | {"points": len(points)}


def flight(trajectory: TrajectoryName, poses: str) -> dict:
    """A whole flight, reconstructed from true or corrected poses."""
    settings = ExperimentSettings.preset(trajectory, "random-walk", sensor="starling2", method="combined")
    recording, truth = experiment.simulate(settings)
    T_world_drone = truth.trajectory.at(recording.prior.stamp_s).T_world_drone
    if poses == "combined":
        T_world_drone = experiment.estimate(settings, recording, truth).corrected.T_world_drone
    some = slice(0, 60)
    reconstruct(recording.scans[some], T_world_drone[some], recording.T_drone_sensor)
    began = time.process_time()
    found = reconstruct(recording.scans, T_world_drone, recording.T_drone_sensor)
    return _measured(found, began) | {"scans": len(recording.scans)}


def surveyed(file: str) -> dict:
    """A cloud of a tower from a file, reconstructed, and the control."""
    reconstruct_cloud(surface(20_000, 0))
    points = read_cloud(file).points
    moved = points + rng.stream(1, "control").uniform(-JITTER_M, JITTER_M, points.shape)
    began = time.process_time()
    tube = tube_radius(points)
    settings = StructureSettings.for_cloud(tube)
    found = reconstruct_cloud(points, settings)
    row = _measured(found, began)
    legs = fit_legs(points)
    inside, control = (float(within(some, found.segments, tube).mean()) for some in (points, moved))
    extent = " × ".join(f"{side:.0f}" for side in np.ptp(points, axis=0))
    return row | {
        "points": len(points), "extent": extent, "tube": tube, "length": float(found.segments.length.sum()),
        "largest": largest(found), "within": inside, "control": control,
        "bars_in_control": len(reconstruct_cloud(moved, settings)),
        "legs": len(legs), "leg_coverage": float(leg_coverage(points, legs, found.segments).mean()) if len(legs) else 0,
    }  # fmt: skip


def fit_legs(points: Array) -> Array:
    """Legs ``(L, 2, 3)`` of a tower ``(N, 3)``, metres, z up: straight lines through its corners at each height."""
    heights = np.arange(points[:, 2].min() + 0.5, points[:, 2].max() - 0.5, 0.5)
    slices = [some for z in heights if len(some := points[np.abs(points[:, 2] - z) <= 0.5]) > 5]

    def area(angle: float) -> float:
        c, s = np.cos(angle), np.sin(angle)
        return float(sum(np.ptp(some[:, :2] @ [[c, -s], [s, c]], axis=0).prod() for some in slices))

    turn = min(np.radians(np.arange(90.0)), key=area)
    legs: list[Array] = []
    for quarter in range(4):
        angle = turn + np.pi / 4 + quarter * np.pi / 2
        outward = np.array([np.cos(angle), np.sin(angle)])
        corners = np.unique([some[np.argmax(some[:, :2] @ outward)] for some in slices], axis=0)
        while len(on := _longest_line(corners)) and np.ptp(corners[on, 2]) >= LEG_MIN_M:
            z = corners[on, 2]
            fit = np.linalg.lstsq(np.column_stack([np.ones_like(z), z]), corners[on, :2], rcond=None)[0]
            legs.append(np.array([[*(fit[0] + fit[1] * end), end] for end in (z.min(), z.max())]))
            corners = corners[(corners[:, 2] < z.min()) | (corners[:, 2] > z.max())]
    return np.array(legs).reshape(-1, 2, 3)


def _longest_line(corners: Array) -> IntArray:
    """Places of the corners on the steep line through two of them that most lie on, its longest part without a gap."""
    best = np.zeros(0, dtype=np.int64)
    for i, first in enumerate(corners):
        for second in corners[i + 1 :]:
            rise = second[2] - first[2]
            slope = (second[:2] - first[:2]) / rise if abs(rise) >= LEG_GAP_M else np.full(2, np.inf)
            if not np.linalg.norm(slope) <= LEG_SLOPE_MAX:
                continue
            off = corners[:, :2] - first[:2] - np.outer(corners[:, 2] - first[2], slope)
            on = np.flatnonzero(np.linalg.norm(off, axis=1) < 0.5 * LEG_NEAR_M)
            best = on if len(on) > len(best) else best
    if len(best) < 6:
        return best[:0]
    best = best[np.argsort(corners[best, 2])]
    runs = np.split(best, np.flatnonzero(np.diff(corners[best, 2]) > LEG_GAP_M) + 1)
    return max(runs, key=lambda run: float(np.ptp(corners[run, 2])))


def leg_coverage(points: Array, legs: Array, bars: Segments) -> Array:
    """Share ``(L,)`` of the visible length of each leg ``(L, 2, 3)`` that the bar which covers most of it covers."""
    tree, shares = cKDTree(points), np.zeros(len(legs))
    for k, (start, end) in enumerate(legs):
        length = np.linalg.norm(end - start)
        axis, step = (end - start) / length, 0.25
        at = start + np.linspace(0, 1, int(length / step) + 1)[:, None] * (end - start)
        at = at[tree.query(at)[0] <= LEG_NEAR_M + step / 2]
        away = at[:, None] - bars.start
        along = np.einsum("sbc,bc->sb", away, bars.direction)
        beside = np.linalg.norm(away - along[..., None] * bars.direction, axis=2)
        on = (beside <= LEG_NEAR_M) & (along >= -step) & (along <= bars.length + step)
        on &= np.abs(bars.direction @ axis) > np.cos(np.radians(5))
        shares[k] = on.mean(axis=0).max(initial=0) if len(at) else 0
    return shares


def largest(structure: Structure) -> int:
    """Number of bars in the largest part that joints hold together."""
    ties = nx.Graph()
    ties.add_nodes_from(("bar", bar) for bar in range(len(structure)))
    ties.add_edges_from((("joint", joint), ("bar", bar)) for joint, bar in structure.tie.tolist())
    return max((sum(kind == "bar" for kind, _ in part) for part in nx.connected_components(ties)), default=0)


def _measured(found: Structure, began: float) -> dict:
    return {
        "seconds": time.process_time() - began, "bars": len(found), "joints": len(found.joint), "reason": found.reason,
        "peak_gb": peak_bytes() / 1e9,
    }  # fmt: skip


def print_tables(folder: Path | None, source: str) -> None:
    print("| towers | points (million) | bars | joints | seconds | seconds per million | peak (GB) |")
    print(f"{'|---' * 7}|")
    for towers in TOWERS:
        row = in_own_process(__file__, "--case", "cloud", str(towers))
        million = row["points"] / 1e6
        print(
            f"| {towers} | {million:.2f} | {row['bars']} | {row['joints']} | {row['seconds']:.1f} "
            f"| {row['seconds'] / million:.2f} | {row['peak_gb']:.2f} |",
            flush=True,
        )
    print(
        f"{FLIGHTS}\n\n| flight | poses | scans | bars | joints | seconds | peak (GB) |\n|---|---|---|---|---|---|---|"
    )
    for trajectory in ("zigzag", "loops"):
        for poses in ("true", "combined"):
            row = in_own_process(__file__, "--case", "flight", trajectory, poses)
            print(
                f"| {trajectory} | {poses} | {row['scans']} | {row['bars']} | {row['joints']} | {row['seconds']:.1f} "
                f"| {row['peak_gb']:.2f} |",
                flush=True,
            )
    if folder is None:
        return
    print(SURVEYED.format(source=source))
    print("\n| cloud | points | extent (m) | tube (m) | bars | metres | joints | largest | within | control ", end="")
    print(f"| bars in control | legs | leg coverage | seconds |\n{'|---' * 14}|")
    for file in sorted(folder.glob("*.txt")):
        row = in_own_process(__file__, "--case", "surveyed", str(file))
        print(
            f"| {file.stem} | {row['points']} | {row['extent']} | {row['tube']:.3f} | {row['bars']} "
            f"| {row['length']:.0f} | {row['joints']} | {row['largest']} | {row['within']:.2f} | {row['control']:.2f} "
            f"| {row['bars_in_control']} | {row['legs']} | {row['leg_coverage']:.2f} | {row['seconds']:.1f} |"
            f"{' ' + row['reason'] if row['reason'] else ''}",
            flush=True,
        )


CASES: dict[str, Callable[..., dict]] = {
    "cloud": lambda towers: cloud(int(towers)),
    "flight": flight,
    "surveyed": surveyed,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--surveyed", type=Path, metavar="FOLDER", help="folder with clouds of towers, *.txt")
    parser.add_argument("--source", default="", help="a sentence on where those clouds are from, and their licence")
    parser.add_argument("--case", nargs="+", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.case:
        kind, *rest = given.case
        print(json.dumps(CASES[kind](*rest)))
        return
    print(f"# The final reconstruction on one core\n\n{machine()}. `{command(__doc__)}`\n\n{NOTES}")
    print_tables(given.surveyed, given.source)


if __name__ == "__main__":
    main()
