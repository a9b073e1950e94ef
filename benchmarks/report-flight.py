"""Estimate the flight of the published run, report-segmentation-flight.csv, from the order of its segments.

    PYTHONPATH=. .venv/bin/python benchmarks/report-flight.py [--members report-tower] [--lines 0.4] [--fit all]
        [--write]

Ten minutes. The run lists its 230 segments in the order in which they were found, and their number after each scan. So
it tells when each was first seen. Poses on a grid around the pole are candidates. In each, the program sees a scan
without drift, and its segments are matched to the published ones. A pose is likely at a time if it shows the segments
that were found then, and unlikely if it shows some that were found later. A Viterbi search finds the best path of one
pose a second: first on a grid of 0.4 m and 30°, then on one of 0.2 m and 15° around that path. ``--lines`` weighs
the difference from the published number of lines a scan; with 0, it is not used. ``--fit even`` uses every other
segment, and prints how many of the rest are seen when they were found. The map of the run is displaced from the floor
plate (`DISPLACED` in report-tower.py).
"""

import argparse
import csv
import itertools
import runpy
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from steelnb.core import rng
from steelnb.core.types import Array, IntArray, Scan
from steelnb.odometry.report_segments import sorted_segments
from steelnb.points import preprocess_scan
from steelnb.settings import ExperimentSettings, HoughSettings, TowerSettings
from steelnb.settings.presets import sensor_tables
from steelnb.settings.stages import NO_FLOOR_M
from steelnb.simulation import build_tower
from steelnb.simulation.raycasting import cast_rays, make_scene, rays
from steelnb.simulation.tof import measured_ranges, reported_rays
from steelnb.simulation.tower import Tower, half_width

shared = runpy.run_path(__file__.replace("report-flight", "report-tower"))
NEAR_M, NEAR_DEG = 0.28, 12.0
FOUND, KNOWN, SOON, LATER, UNKNOWN = 4.0, 0.05, -0.2, -1.5, -0.4
"""Scores of a segment in view: found within 0.75 s, found before, within the next 3 s, later, not published."""
PER_M, PER_RAD = 1.0, 0.8
"""Cost of moving and turning."""
REACH_M, TURN_RAD = {0.4: 0.95, 0.2: 0.62}, 0.7
"""How far the drone moves and turns in a second, by step of the grid."""
START_M = 0.5, 2.5, 0.1
SMOOTH_S = 0.7
SEEN_S = 2


class Views(NamedTuple):
    """What the program sees from C poses: ``lines (C,)``; segments without a published one, ``unknown (C,)``; for
    each of M matches its ``pose``, and for each of N pairs its published ``segment`` and its ``match``."""

    lines: IntArray
    unknown: IntArray
    pose: IntArray
    segment: IntArray
    match: IntArray


def coarse_poses(tower: Tower) -> Array:
    """Poses ``(C, 4)``, x, y, z and heading, 0.55 to 1.75 m from steel, outside the body, turned towards the steel."""
    axes = np.concatenate([tower.axes, tower.plates[:, :2], tower.plates[:, 1:]])
    steel = np.concatenate(
        [a + np.linspace(0, 1, int(np.linalg.norm(b - a) / 0.1) + 2)[:, None] * (b - a) for a, b in axes]
    )
    z = np.append(0.1, np.arange(0.5, 17.3, 0.55))
    place = np.stack(np.meshgrid(np.arange(-5.2, 5.3, 0.4), np.arange(-3.6, 3.7, 0.4), z, indexing="ij"), -1).reshape(
        -1, 3
    )
    distance, nearest = cKDTree(steel).query(place)
    half = np.interp(place[:, 2], z, [half_width(tower.settings, height) for height in z])
    kept = (distance > 0.55) & (distance < 1.75) & (np.abs(place[:, :2]).max(axis=1) > half)
    towards = steel[nearest[kept]] - place[kept]
    heading = np.arange(12) * np.pi / 6 - np.pi
    off = np.abs(np.angle(np.exp(1j * (heading - np.arctan2(towards[:, 1], towards[:, 0])[:, None]))))
    which, turn = np.nonzero(off < np.radians(61))
    return np.column_stack([place[kept][which], heading[turn]])


def fine_poses(path: Array) -> Array:
    """Poses within 0.45 m and 15° of a path."""
    offset = [(*o, t) for o in itertools.product((-2, -1, 0, 1, 2), repeat=3) if np.dot(o, o) <= 5 for t in (-1, 0, 1)]
    cells = (np.round(path / (0.2, 0.2, 0.2, np.pi / 12)).astype(int)[:, None] + offset).reshape(-1, 4)
    cells[:, 3] = (cells[:, 3] + 12) % 24 - 12
    poses = np.unique(cells, axis=0) * (0.2, 0.2, 0.2, np.pi / 12)
    poses[:, 2] = np.maximum(poses[:, 2], 0.1)
    return poses


def view(tower: Tower, poses: Array, published: Array) -> Views:
    """Scan the pole from each pose, and match the program's segments to the ``published (230, 2, 3)``."""
    settings = ExperimentSettings.preset("vertical", "none", "report-segments", "report", "report")
    tof, hough = settings.tof, HoughSettings(**sensor_tables("report")["hough"]).replace(granularity=4)
    preprocess = settings.odometry.preprocess.replace(floor_m=NO_FLOOR_M)
    scene, ray, reported, noise = make_scene(tower), rays(tof), reported_rays(tof), rng.stream(0, "tof")
    lines: list[int] = []
    pose: list[int] = []
    segment: list[int] = []
    match: list[int] = []
    unknown = np.zeros(len(poses), int)
    for k, (x, y, z, heading) in enumerate(poses):
        T = np.eye(4)
        T[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
        T[:3, 3] = x, y, z
        image = measured_ranges(cast_rays(scene, (T @ tof.T_drone_sensor)[None], ray)[0][0], tof, noise)
        points = preprocess_scan(Scan(0.0, image[..., None] * reported), T, np.eye(4), preprocess)
        found, count = sorted_segments(points, hough)
        found = found.transformed(T)
        lines.append(count)
        for start, end in zip(found.start, found.end, strict=True):
            if max(start[2], end[2]) > settings.odometry.preprocess.floor_m:
                same = matching(start, end, published)
                unknown[k] += not len(same)
                segment += same
                match += [len(pose)] * len(same)
                pose += [k] * bool(same)
    return Views(np.array(lines), unknown, np.array(pose), np.array(segment), np.array(match))


def matching(start: Array, end: Array, published: Array) -> list[int]:
    """The published segments that a segment may be part of."""
    along = published[:, 1] - published[:, 0]
    reach = np.linalg.norm(along, axis=1)
    along = along / reach[:, None]
    length = np.linalg.norm(end - start)
    near = (np.abs(along @ (end - start)) > length * np.cos(np.radians(NEAR_DEG))) & (length > 0.15)
    for point in (start, end):
        t = np.clip(((point - published[:, 0]) * along).sum(axis=1), -0.3, reach + 0.3)
        near &= np.linalg.norm(point - published[:, 0] - t[:, None] * along, axis=1) < NEAR_M
    return np.flatnonzero(near).tolist()


def best_path(poses: Array, views: Views, found_s: Array, lines: Array, weight: float, step_m: float) -> IntArray:
    """The pose of each second, as indices of the ``poses``."""
    first = np.flatnonzero(np.diff(views.match, prepend=-1))
    score = np.empty((len(lines), len(poses)), dtype=np.float32)
    for second in range(len(lines)):
        ahead = found_s - second - 0.5
        value = np.select([np.abs(ahead) <= 0.75, ahead < 0, ahead < 3], [FOUND, KNOWN, SOON], LATER)
        best = np.maximum.reduceat(value[views.segment], first)
        score[second] = np.bincount(views.pose, best, len(poses)) + UNKNOWN * views.unknown
        score[second] -= weight * np.abs(views.lines - lines[second])
    near = cKDTree(poses[:, :3]).query_ball_point(poses[:, :3], REACH_M[step_m])
    one, other = np.repeat(np.arange(len(poses)), [len(each) for each in near]), np.concatenate(near).astype(int)
    turn = np.abs(np.angle(np.exp(1j * (poses[one, 3] - poses[other, 3]))))
    one, other, turn = (each[turn < TURN_RAD] for each in (one, other, turn))
    cost = PER_M * np.linalg.norm(poses[one, :3] - poses[other, :3], axis=1) + PER_RAD * turn
    begin = np.searchsorted(one, np.arange(len(poses) + 1))
    score[0] -= 5 * np.linalg.norm(poses[:, :3] - START_M, axis=1)
    return viterbi(score, begin, other, cost.astype(np.float32))


@njit
def viterbi(score, begin, other, cost):  # type: ignore[no-untyped-def]
    """The path with the highest sum of ``score (seconds, poses)`` minus the ``cost`` of its moves."""
    seconds, count = score.shape
    total, back = score[0].copy(), np.zeros((seconds, count), np.int32)
    for second in range(1, seconds):
        after = np.empty(count, np.float32)
        for k in range(count):
            best = begin[k]
            for m in range(begin[k], begin[k + 1]):
                if total[other[m]] - cost[m] > total[other[best]] - cost[best]:
                    best = m
            back[second, k] = other[best]
            after[k] = total[other[best]] - cost[best] + score[second, k]
        total = after
    path = np.empty(seconds, np.int64)
    path[-1] = np.argmax(total)
    for second in range(seconds - 1, 0, -1):
        path[second - 1] = back[second, path[second]]
    return path


def seen(path: IntArray, views: Views, found_s: Array) -> Array:
    """Whether each published segment is seen within `SEEN_S` seconds of when it was found."""
    shown = [set(views.segment[np.isin(views.match, np.flatnonzero(views.pose == k))].tolist()) for k in path]
    return np.array([any(k in each for each in shown[max(int(s) - SEEN_S, 0) : int(s) + SEEN_S + 1])
                     for k, s in enumerate(found_s)])  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--members", default="report-tower")
    parser.add_argument("--lines", type=float, default=0.4)
    parser.add_argument("--fit", choices=["all", "even", "odd"], default="all")
    parser.add_argument("--write", action="store_true")
    asked = parser.parse_args()
    tower = build_tower(TowerSettings.preset("report").replace(members=asked.members))
    published = shared["table"]("report-segments.csv").reshape(-1, 2, 3) - shared["DISPLACED"]
    run = shared["table"]("report-segmentation-run.csv")
    found_s = run[np.searchsorted(run[:, 3], np.arange(len(published)), side="right"), 0]
    second = np.arange(shared["LAST_S"]) + 0.5
    lines = np.array([run[np.argsort(np.abs(run[:, 0] - s))[:3], 2].mean() for s in second])
    fitted = (
        np.ones(len(published), bool) if asked.fit == "all" else np.arange(len(published)) % 2 == (asked.fit == "odd")
    )
    poses, path = coarse_poses(tower), np.zeros((0, 4))
    for step_m in (0.4, 0.2):
        views = view(tower, poses, published)
        chosen = best_path(poses, views, np.where(fitted, found_s, -np.inf), lines, asked.lines, step_m)
        path, hit, within = poses[chosen], seen(chosen, views, found_s), found_s < shared["LAST_S"]
        ours, theirs = (each.reshape(-1, 40).mean(axis=1).round(1) for each in (views.lines[chosen], lines))
        for name, part in (("fitted", fitted & within), ("others", ~fitted & within)):
            print(f"{step_m} m, {len(poses)} poses, {name}: {hit[part].sum()} of {part.sum()} seen when found")
        print(f"lines a scan in each 40 s: {ours}, published: {theirs}", flush=True)
        poses = fine_poses(path)
    if asked.write:
        path[:, 3] = np.degrees(np.unwrap(path[:, 3]))
        with (shared["FOLDER"] / "report-segmentation-flight.csv").open("w", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            rows.writerow(["time_s", "x", "y", "z", "heading_deg"])
            rows.writerows(np.column_stack([second, gaussian_filter1d(path, SMOOTH_S, axis=0)]).round(3))


if __name__ == "__main__":
    main()
