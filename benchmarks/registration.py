"""The ICP family beside other programs: one process, one pinned core, the same points, distance and stopping rule.

    .venv/bin/python benchmarks/registration.py --pair FOLDER > benchmarks/registration.md

FOLDER holds source.ply, target.ply and T_target_source.txt, such as the folder data of
https://github.com/koide3/small_gicp; without --pair only the simulated flight is measured. Needs small_gicp and Open3D;
a program that is not installed is left out. Seconds belong to the machine named in the table, ratios less so.
"""

# ruff: noqa: E402 - libraries count their threads when they are imported, so the core is pinned before
import argparse
import importlib.metadata
import importlib.util
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np
import open3d as o3d
from scipy.spatial.transform import Rotation

from shared import command, map_mb
from steelnb import experiment, rng
from steelnb.points import VoxelMap, preprocess_scan, voxel_grid
from steelnb.points.covariances import neighbour_covariances, regularised
from steelnb.points.kdtree import build_kdtree
from steelnb.registration import AnyTarget, Target, align, free_directions, make_target, voxel_target
from steelnb.report.results import machine
from steelnb.settings import ExperimentSettings, PreprocessSettings
from steelnb.types import Array

small_gicp: Any = importlib.import_module("small_gicp") if importlib.util.find_spec("small_gicp") else None
NEIGHBOURS, ITERATIONS, TURN_RAD, MOVE_M = 20, 50, np.radians(0.1), 1e-3
ERROR = {"icp": "point", "plane": "plane", "gicp": "gicp", "vgicp": "gicp"}
OURS, SMALL, OPEN3D = "steelnb", "small_gicp", "Open3D"
NOTES = """The programs take turns in one process on one core, with the same points, {} neighbours and at most {} steps,
and stop at a step under 0.1° and 1 mm; Open3D knows only a rule on fitness and RMSE (1e-6, its default). PCL has no
wheel for Python and is not measured. Times are medians of the process's own time on the core, which on an idle core is
the time that passes. *Whole job*: index both clouds, their normals or covariances, align. *Ratio*: our time over the
other's. *Error*: against the known transform, at the middle of the source.

- small_gicp's point-to-plane weighs each axis of the difference by the normal's component instead of measuring the
  distance to the plane, so it ends elsewhere; Open3D's is a plane distance, as ours.
- Its vgicp takes the voxel that a point is in; ours the nearest mean of the eight voxels around the point, with the raw
  covariance of 3×3×3 voxels. These are different estimators.
"""


class Problem(NamedTuple):
    """Points to register, where to start, and where to end."""

    source: np.ndarray
    target: np.ndarray
    T_init: np.ndarray
    T_true: np.ndarray
    distance_m: float
    voxel_m: float


Posed = tuple[Array, int | None]
"""T_target_source ``(4, 4)``, and the iterations where a program tells them."""


class Job(NamedTuple):
    """A registration in two parts: ``prepare()`` indexes both clouds, ``finish(prepared)`` solves."""

    prepare: Callable[[], Any]
    finish: Callable[[Any], Posed]


def jobs(method: str, p: Problem) -> dict[str, Job]:
    """The same job for each program that can do it."""
    found = {OURS: Job(lambda: _our_prepare(method, p), lambda ready: _our_finish(method, p, ready))}
    if small_gicp:
        found[SMALL] = Job(lambda: _small_prepare(method, p), lambda ready: _small_finish(method, p, ready))
    if method != "vgicp":
        found[OPEN3D] = Job(lambda: _open3d_prepare(method, p), lambda ready: _open3d_finish(method, p, ready))
    return found


def _our_prepare(method: str, p: Problem) -> tuple[AnyTarget, Array | None]:
    if method == "vgicp":
        voxels = VoxelMap(p.voxel_m)
        voxels.update_shapes(voxels.insert(p.target))
        spread = neighbour_covariances(p.source, NEIGHBOURS)
        return voxel_target(voxels), spread + (0.05 * p.voxel_m) ** 2 * np.array([1, 0, 0, 1, 0, 1])
    goal = make_target(p.target, ERROR[method], NEIGHBOURS)
    return goal, regularised(neighbour_covariances(p.source, NEIGHBOURS)) if method == "gicp" else None


def _our_finish(method: str, p: Problem, ready: tuple[AnyTarget, Array | None]) -> Posed:
    result = align(
        p.source, ready[0], ERROR[method], np.eye(6), p.T_init, p.distance_m, ready[1], "none", 1.0, ITERATIONS,
        TURN_RAD, MOVE_M,
    )  # fmt: skip
    return result.T_target_source, result.iterations


def _small_prepare(method: str, p: Problem) -> tuple[Any, Any, Any]:
    source, target = small_gicp.PointCloud(p.source), small_gicp.PointCloud(p.target)
    tree = small_gicp.KdTree(target)
    if method in ("gicp", "vgicp"):
        small_gicp.estimate_covariances(source, small_gicp.KdTree(source), NEIGHBOURS)
        small_gicp.estimate_covariances(target, tree, NEIGHBOURS)
    if method == "plane":
        small_gicp.estimate_normals(target, tree, NEIGHBOURS)
    if method == "vgicp":
        voxels = small_gicp.GaussianVoxelMap(p.voxel_m)
        voxels.insert(target)
        return source, voxels, None
    return source, target, tree


def _small_finish(method: str, p: Problem, ready: tuple[Any, Any, Any]) -> Posed:
    source, target, tree = ready
    rule = {"max_iterations": ITERATIONS, "rotation_epsilon": TURN_RAD, "translation_epsilon": MOVE_M}
    rule |= {"max_correspondence_distance": p.distance_m, "num_threads": 1}
    if method == "vgicp":
        result = small_gicp.align(target, source, p.T_init, **rule)
    else:
        kind = {"icp": "ICP", "plane": "PLANE_ICP", "gicp": "GICP"}[method]
        result = small_gicp.align(target, source, tree, p.T_init, registration_type=kind, **rule)
    return result.T_target_source, result.iterations + 1


def _open3d_prepare(method: str, p: Problem) -> list[o3d.geometry.PointCloud]:
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (p.source, p.target)]
    for cloud in clouds if method == "gicp" else clouds[1:] if method == "plane" else []:
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    return clouds


def _open3d_finish(method: str, p: Problem, ready: list[o3d.geometry.PointCloud]) -> Posed:
    pipeline = o3d.pipelines.registration
    estimation = {
        "icp": pipeline.TransformationEstimationPointToPoint, "plane": pipeline.TransformationEstimationPointToPlane,
        "gicp": pipeline.TransformationEstimationForGeneralizedICP,
    }[method]()  # fmt: skip
    call = pipeline.registration_generalized_icp if method == "gicp" else pipeline.registration_icp
    criteria = pipeline.ICPConvergenceCriteria(1e-6, 1e-6, ITERATIONS)
    return call(*ready, p.distance_m, p.T_init, estimation, criteria).transformation, None


def apart(T_one: Array, T_two: Array, source: Array) -> tuple[float, float]:
    """(millimetres between the middles of the source, degrees) of two poses."""
    middle = np.append(source.mean(axis=0), 1)
    turn = Rotation.from_matrix(T_one[:3, :3].T @ T_two[:3, :3]).magnitude()
    return 1e3 * float(np.linalg.norm(((T_one - T_two) @ middle)[:3])), float(np.degrees(turn))


def measure(problems: list[Problem], repeats: int) -> None:
    """Print one row for each method and program; the programs take turns, so that the machine's moods hit all."""
    print("| method | program | whole job (ms) | ratio | align alone (ms) | ratio | steps | error (mm, °) ", end="")
    print("| from ours (mm, °) |")
    print("|---|---|---|---|---|---|---|---|---|")
    for method in ERROR:
        seconds: dict[str, list[tuple[float, float]]] = {}
        poses: dict[str, list[Array]] = {}
        steps: dict[str, list[int | None]] = {}
        for p in problems:
            for name, job in jobs(method, p).items():  # compile and warm up, and keep the answer
                T, count = job.finish(job.prepare())
                poses.setdefault(name, []).append(T)
                steps.setdefault(name, []).append(count)
            for _ in range(repeats):
                for name, job in jobs(method, p).items():
                    began = time.process_time()
                    ready = job.prepare()
                    prepared = time.process_time()
                    job.finish(ready)
                    ended = time.process_time()
                    seconds.setdefault(name, []).append((ended - began, ended - prepared))
        ours = 1e3 * np.median(seconds[OURS], axis=0)
        for name in seconds:
            whole, alone = 1e3 * np.median(seconds[name], axis=0)
            error, other = (
                np.median(
                    [apart(T, goal, p.source) for T, goal, p in zip(poses[name], goals, problems, strict=True)], axis=0
                )
                for goals in ([p.T_true for p in problems], poses[OURS])
            )
            ratio = [
                f"{mine / its:.2f}" if name != OURS else "" for mine, its in zip(ours, (whole, alone), strict=True)
            ]
            told = [count for count in steps[name] if count is not None]
            median = f"{np.median(told):.0f}" if told else ""
            print(
                f"| {method} | {name} | {whole:.1f} | {ratio[0]} | {alone:.1f} | {ratio[1]} | {median} "
                f"| {error[0]:.1f}, {error[1]:.3f} | {'' if name == OURS else f'{other[0]:.2f}, {other[1]:.4f}'} |",
                flush=True,
            )
    print()


def pair(folder: Path) -> Problem:
    """The pair in a folder, thinned to 25 cm, from the identity."""
    source, target = (
        voxel_grid(np.asarray(o3d.io.read_point_cloud(folder / f"{name}.ply").points), 0.25)
        for name in ("source", "target")
    )
    return Problem(source, target, np.eye(4), np.loadtxt(folder / "T_target_source.txt"), 1.0, 1.0)


def flight(duration_s: float, every: int) -> tuple[list[Problem], VoxelMap]:
    """Frames of a simulated flight, each against the map of all before it at their true poses, from starts off by about
    5 cm and 1°; and the map of the whole flight."""
    settings = ExperimentSettings.preset(duration_s=duration_s)
    recording, truth = experiment.simulate(settings)
    true = truth.trajectory.at(recording.prior.stamp_s).T_world_drone
    crop = PreprocessSettings(crop_m=6.0, voxel_leaf_m=0.033)
    voxels, problems = VoxelMap(0.1), []
    for k, (scan, T) in enumerate(zip(recording.scans, true, strict=True)):
        points = preprocess_scan(scan, T, recording.T_drone_sensor, crop)
        if k % every == every - 1 and len(points) > 500:
            off = rng.stream(1, "benchmark", k)
            start = T.copy()
            start[:3, :3] = Rotation.from_rotvec(0.01 * off.standard_normal(3)).as_matrix() @ T[:3, :3]
            start[:3, 3] += 0.03 * off.standard_normal(3)
            world = points @ T[:3, :3].T + T[:3, 3]
            low, high = world.min(axis=0), world.max(axis=0)
            near = voxels.near((low + high) / 2, float((high - low).max() / 2 + 0.6))
            problems.append(Problem(points, voxels.means(near), start, T, 0.3, 0.3))
        voxels.update_shapes(voxels.insert(points @ T[:3, :3].T + T[:3, 3]))
    return problems, voxels


def against_map_size(p: Problem, voxels: VoxelMap) -> None:
    """Print the time of one odometry frame as towers are added beside the one in sight."""
    print(
        "| voxels in the map | in sight | memory (MB) | part in sight, k-d tree, GICP with the map's shapes (ms) ",
        end="",
    )
    print("| map as it is, VGICP (ms) | insert, update shapes (ms) | k-d tree of the whole map alone (ms) |")
    print("|---|---|---|---|---|---|---|")
    tower, free = voxels.means(), free_directions("xyz_yaw")
    floor = 0.02**2 * np.array([1, 0, 0, 1, 0, 1])
    noise = np.tile(floor, (len(p.source), 1))
    world = p.source @ p.T_true[:3, :3].T + p.T_true[:3, 3]
    low, high = world.min(axis=0), world.max(axis=0)
    for size in (1_000, 2_000, 5_000, 10_000, 20_000, 50_000):
        grown = VoxelMap(voxels.voxel_m)
        order = np.argsort(np.linalg.norm(tower - world.mean(axis=0), axis=1))
        part = 0
        while len(grown) < size:  # the nearest part of the tower first, then copies of it 20 m apart
            away = 20.0 * np.array([part // 5, part % 5, 0.0])
            left = size - len(grown)
            grown.update_shapes(grown.insert(tower[order][:left] + away))
            part += 1
        seconds = []
        for _ in range(31):
            clock = [time.process_time()]
            near = grown.near((low + high) / 2, float((high - low).max() / 2 + 0.6))
            tree = build_kdtree(grown.means(near))
            goal = Target(tree, np.zeros((0, 3)), grown.shapes(near)[tree.order])
            align(p.source, goal, "gicp", free, p.T_init, 0.3, noise, "geman_mcclure", 3.0, 20, 1e-4, 2e-4)
            clock.append(time.process_time())
            align(
                p.source, voxel_target(grown), "gicp", free, p.T_init, 0.3, noise, "geman_mcclure", 3.0, 20, 1e-4, 2e-4
            )
            clock.append(time.process_time())
            grown.update_shapes(grown.insert(world))
            clock.append(time.process_time())
            build_kdtree(grown.means())
            clock.append(time.process_time())
            seconds.append(np.diff(clock))
        seen, as_is, insert, whole = 1e3 * np.median(seconds, axis=0)
        print(f"| {size} | {len(near)} | {map_mb(grown):.0f} | {seen:.1f} | {as_is:.1f} ", end="")
        print(f"| {insert:.2f} | {whole:.1f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pair", type=Path, help="folder with source.ply, target.ply and T_target_source.txt")
    parser.add_argument("--duration", type=float, default=200.0, help="seconds of flight")
    given = parser.parse_args()
    versions = {SMALL: small_gicp and importlib.metadata.version("small_gicp"), OPEN3D: o3d.__version__}
    programs = ", ".join(f"{name} {version or 'is not installed'}" for name, version in versions.items())
    print(f"# Registration on one core\n\n{machine()}. `{command(__doc__)}`\n\n{programs}.\n")
    print(NOTES.format(NEIGHBOURS, ITERATIONS))
    if given.pair:
        p = pair(given.pair)
        print(f"## The pair: {len(p.source)} to {len(p.target)} points, {p.distance_m} m\n")
        measure([p], 31)
    problems, voxels = flight(given.duration, max(1, int(given.duration / 5)))
    sizes = [int(np.median([len(getattr(p, name)) for p in problems])) for name in ("source", "target")]
    print(f"## {len(problems)} frames over a flight of {given.duration:.0f} s, each to the map so far\n")
    print(f"Zigzag, starling2; {sizes[0]} to {sizes[1]} points (medians), {problems[0].distance_m} m; ", end="")
    print("starts off by about 5 cm and 1°. Numbers are medians over the frames.\n")
    measure(problems, 5)
    print("## One frame against the size of the map\n")
    against_map_size(problems[len(problems) // 2], voxels)


if __name__ == "__main__":
    main()
