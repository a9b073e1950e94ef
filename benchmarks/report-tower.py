"""The report's segmentation program on our pole, beside a run of it that its authors published.

    PYTHONPATH=. .venv/bin/python benchmarks/report-tower.py [--members report-tower FILE.csv] [--section round]
        [--draws 3] [--granularity 6] [--shift 0 0 0]

The run (zhuzhengming/geometric_informed_planning, `pointcloud_segmentation/output`) is no flight of the report: a
planner steered it around the pole. report-flight.py estimated that flight, report-segmentation-flight.csv.
report-segments.csv has its 230 segments in the order in which they were found, report-segmentation-run.csv its scans.
Here the flight is flown at the published times with the sensor's half pixel and the ignored mount: with true poses, and
with the program's own correction for several draws of the sensor's noise. Prints, for each list of members, lines a
scan in each 40 s, bars found, and how much of the length of the 230 segments lies near one of our bars. ``--shift``
moves the pole.
"""

import argparse
import csv
import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.types import Array, Trajectory
from steelnb.odometry import ReportSegmentOdometry
from steelnb.settings import ExperimentSettings, TowerSettings
from steelnb.simulation import build_tower, scan_flight
from steelnb.simulation.tower import Tower

FOLDER = Path(__file__).parent
LAST_S = 440.0
"""The planner's flight ends here; the drone then returns to its start."""
BLOCK_S = 40.0
BARS_S = 40, 120, 240, 440
NEAR_M, NEAR_DEG = 0.15, 8.0
STEP_S = 0.008
CENTRE_Y = 0.04
"""Of the published map."""
DISPLACED = 0.06, 0.12, -0.06
"""The run's map minus the pole of the pictures: a fit of the segments to its members. The program ignores the sensor's
mount and half a pixel, and its correction then moves the map."""


def table(name: str) -> Array:
    """The columns of a CSV file of this folder, ``(rows, columns)``."""
    with (FOLDER / name).open(newline="") as file:
        return np.array([list(map(float, row)) for row in itertools.islice(csv.reader(file), 1, None)])


def flown() -> Trajectory:
    """The estimated flight at every step of the simulator."""
    known, time_s = table("report-segmentation-flight.csv"), np.arange(0, LAST_S + 2, STEP_S)
    heading = np.unwrap(known[:, 4], period=360)
    x, y, z, yaw = (np.interp(time_s, known[:, 0], column) for column in (*known[:, 1:4].T, heading))
    T_world_drone = np.tile(np.eye(4), (len(time_s), 1, 1))
    T_world_drone[:, :3, :3] = Rotation.from_euler("z", yaw[:, None], degrees=True).as_matrix()
    T_world_drone[:, :3, 3] = np.stack([x, y, z], axis=1)
    return Trajectory(time_s, T_world_drone)


def program(
    tower: Tower, start_s: Array, granularity: int, draw: int, is_corrected: bool
) -> tuple[Array, Array, Array]:
    """Lines and bars after each scan, ``(K,)``, and the bars at the end, ``(B, 2, 3)``. Without the correction, the
    poses stay true, and the map is moved to the published one."""
    settings = ExperimentSettings.preset("vertical", "none", "report-segments", "report", "report")
    settings = settings.override({"odometry.hough.granularity": granularity})
    tof = settings.tof.replace(samples=tuple(np.round(start_s / STEP_S).astype(int).tolist()), draw=draw)
    trajectory, lines, bars = flown(), [], []
    scans, _ = scan_flight(tower, trajectory, tof, settings.seed)
    prior, odometry = trajectory.at(scans.stamp_s), ReportSegmentOdometry(settings.odometry)
    for scan, T_world_drone in zip(scans, prior.T_world_drone, strict=True):
        odometry.update(scan, T_world_drone)
        odometry.error *= is_corrected
        lines.append(odometry.lines)
        bars.append(len(odometry.bars))
    segments = odometry.map_segments()
    ours = np.stack([segments.start, segments.end], axis=1)
    return np.array(lines), np.array(bars), ours if is_corrected else ours + DISPLACED


def near(segments: Array, others: Array) -> tuple[Array, Array]:
    """Length of each of the ``segments (N, 2, 3)``, and how much of it lies near one of the ``others``."""
    along = others[:, 1] - others[:, 0]
    reach = np.linalg.norm(along, axis=1)
    along /= reach[:, None]
    length, covered = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1), np.zeros(len(segments))
    for k, (start, end) in enumerate(segments):
        parallel = np.abs(along @ (end - start)) >= length[k] * np.cos(np.radians(NEAR_DEG))
        place = start + np.arange(0.5, 40)[:, None, None] / 40 * (end - start) - others[parallel, 0]
        t = np.clip((place * along[parallel]).sum(axis=2), 0, reach[parallel])
        off_m = np.linalg.norm(place - t[..., None] * along[parallel], axis=2)
        covered[k] = length[k] * (off_m.min(axis=1, initial=np.inf) <= NEAR_M).mean()
    return length, covered


def scores(lines: Array, bars: Array, ours: Array, run: Array) -> Iterator[tuple[str, float, float]]:
    """Name, our value and the published one."""
    start_s, theirs = run[:, 0], table("report-segments.csv").reshape(-1, 2, 3)
    for first in np.arange(0, LAST_S, BLOCK_S):
        block = (start_s >= first) & (start_s < first + BLOCK_S)
        yield f"lines {first:.0f} s", lines[block].mean(), run[block, 2].mean()
    for until in BARS_S:
        yield f"bars {until} s", bars[start_s < until][-1], run[start_s < until, 3][-1]
    (length, covered), y, odd = near(theirs, ours), theirs[:, :, 1].mean(axis=1), np.arange(len(theirs)) % 2 == 1
    parts = {"all": y > -np.inf, "even": ~odd, "odd": odd, "y > 0": y > CENTRE_Y, "y < 0": y <= CENTRE_Y}
    for name, part in parts.items():
        yield f"% of their length, {name}", 100 * covered[part].sum() / length[part].sum(), 100.0
    length, covered = near(ours, theirs)
    yield "% of our length", 100 * covered.sum() / length.sum(), 100.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--members", nargs="+", default=["report-tower"])
    parser.add_argument("--section", choices=["angle", "round"], default="round")
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--granularity", type=int, default=6)
    parser.add_argument("--shift", type=float, nargs=3, default=[0.0, 0.0, 0.0])
    asked = parser.parse_args()
    run = table("report-segmentation-run.csv")
    run = run[run[:, 0] < LAST_S]
    for members in asked.members:
        tower = build_tower(TowerSettings.preset("report").replace(members=members, section=asked.section))
        tower.vertices[:] += asked.shift
        columns = [(0, False), *((draw, True) for draw in range(asked.draws))]
        found = [list(scores(*program(tower, run[:, 0], asked.granularity, *each), run)) for each in columns]
        print(
            f"| {members} | true poses | corrected, mean | lowest and highest draw | published |\n|---|---|---|---|---|"
        )
        for (name, true, published), *others in zip(*found, strict=True):
            ours = [value for _, value, _ in others]
            print(f"| {name} | {true:.1f} | {np.mean(ours):.1f} | {min(ours):.1f}–{max(ours):.1f} | {published:.1f} |")


if __name__ == "__main__":
    main()
