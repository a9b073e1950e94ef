"""The ICP family beside other programs: one process, one pinned core, the same points, distance and stopping rule.

    .venv/bin/python benchmarks/registration.py --pair FOLDER > benchmarks/registration.md

FOLDER holds source.ply, target.ply and T_target_source.txt, such as the folder data of
https://github.com/koide3/small_gicp. Without --pair, only the simulated flight is measured. Times depend on
the machine named in the table, ratios less so.
"""

from shared import command  # first, as it pins the core

# isort: split
import argparse
import importlib.metadata
import math
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import open3d as o3d
import small_gicp
from scipy.spatial.transform import Rotation

from steelnb import experiment
from steelnb.core import rng
from steelnb.core.determinism import machine
from steelnb.core.types import Array
from steelnb.points import VoxelMap, preprocess_scan, voxel_grid
from steelnb.points.covariances import NEIGHBOURS, neighbour_covariances, regularised
from steelnb.registration import AlignOptions, align, make_target
from steelnb.settings import ExperimentSettings, PreprocessSettings

ITERATIONS, TURN_RAD, MOVE_M = 50, np.radians(0.1), 1e-3
DURATION_S, EVERY = 200.0, 40
ERROR = {"icp": "point", "plane": "plane", "gicp": "gicp"}
OURS = "steelnb"
NOTES = """The programs take turns in one process on one core, with the same points, {} neighbours and at most {} steps,
and stop at a step under 0.1° and 1 mm. Open3D can only stop on fitness and RMSE (1e-6, its default). PCL has no Python
wheel and is not measured. Times are medians of CPU time, which is the elapsed time on an idle core. *Whole job*: index
both clouds, compute their normals or covariances, and align. *Ratio*: our time over the other's. *Error*: distance from
the known transform, at the middle of the source.

small_gicp's point-to-plane weights each axis of the difference by the normal's component instead of measuring the
distance to the plane, so it converges elsewhere. Open3D measures the distance to the plane, as we do.
"""


class Problem(NamedTuple):
    """Points to register, where to start, and where to end."""

    source: np.ndarray
    target: np.ndarray
    T_init: np.ndarray
    T_true: np.ndarray
    distance_m: float


Done = tuple[Array, int | None, float]
"""T_target_source ``(4, 4)``, the iterations if the program reports them, and when both clouds were ready (s)."""


def ours(method: str, p: Problem) -> Done:
    goal = make_target(p.target, ERROR[method])
    covariances = regularised(neighbour_covariances(p.source)) if method == "gicp" else None
    prepared = time.process_time()
    options = AlignOptions(ERROR[method], np.eye(6), p.distance_m, math.inf, ITERATIONS, TURN_RAD, MOVE_M)
    result = align(p.source, goal, p.T_init, options, covariances)
    return result.T_target_source, result.iterations, prepared


def by_small_gicp(method: str, p: Problem) -> Done:
    source, target = small_gicp.PointCloud(p.source), small_gicp.PointCloud(p.target)
    tree = small_gicp.KdTree(target)
    if method == "gicp":
        small_gicp.estimate_covariances(source, small_gicp.KdTree(source), NEIGHBOURS)
        small_gicp.estimate_covariances(target, tree, NEIGHBOURS)
    if method == "plane":
        small_gicp.estimate_normals(target, tree, NEIGHBOURS)
    prepared = time.process_time()
    result = small_gicp.align(
        target, source, tree, p.T_init, registration_type={"icp": "ICP", "plane": "PLANE_ICP", "gicp": "GICP"}[method],
        max_iterations=ITERATIONS, rotation_epsilon=TURN_RAD, translation_epsilon=MOVE_M,
        max_correspondence_distance=p.distance_m, num_threads=1,
    )  # fmt: skip
    return result.T_target_source, result.iterations + 1, prepared


def by_open3d(method: str, p: Problem) -> Done:
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (p.source, p.target)]
    for cloud in clouds if method == "gicp" else clouds[1:] if method == "plane" else []:
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    prepared, pipeline = time.process_time(), o3d.pipelines.registration
    estimation = {
        "icp": pipeline.TransformationEstimationPointToPoint, "plane": pipeline.TransformationEstimationPointToPlane,
        "gicp": pipeline.TransformationEstimationForGeneralizedICP,
    }[method]()  # fmt: skip
    call = pipeline.registration_generalized_icp if method == "gicp" else pipeline.registration_icp
    criteria = pipeline.ICPConvergenceCriteria(1e-6, 1e-6, ITERATIONS)
    return call(*clouds, p.distance_m, p.T_init, estimation, criteria).transformation, None, prepared


PROGRAMS = {OURS: ours, "small_gicp": by_small_gicp, "Open3D": by_open3d}


def apart(T_one: Array, T_two: Array, source: Array) -> tuple[float, float]:
    """Distance of the middle of the source (mm) and angle (degrees) between two poses."""
    middle = np.append(source.mean(axis=0), 1)
    turn = Rotation.from_matrix(T_one[:3, :3].T @ T_two[:3, :3]).magnitude()
    return 1e3 * float(np.linalg.norm(((T_one - T_two) @ middle)[:3])), float(np.degrees(turn))


def measure(problems: list[Problem], repeats: int) -> None:
    """Print one row per method and program. The programs take turns, so that load on the machine affects all alike."""
    print("| method | program | whole job (ms) | ratio | align alone (ms) | ratio | steps | error (mm, °) ", end="")
    print("| from ours (mm, °) |\n|---|---|---|---|---|---|---|---|---|")
    for method in ERROR:
        seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in PROGRAMS}
        found: dict[str, list[Done]] = {name: [] for name in PROGRAMS}
        for p in problems:
            for name, program in PROGRAMS.items():  # compile and warm up, and keep the answer
                found[name].append(program(method, p))
            for _ in range(repeats):
                for name, program in PROGRAMS.items():
                    began = time.process_time()
                    prepared = program(method, p)[2]
                    ended = time.process_time()
                    seconds[name].append((ended - began, ended - prepared))
        our_ms = 1e3 * np.median(seconds[OURS], axis=0)
        for name in PROGRAMS:
            ms = 1e3 * np.median(seconds[name], axis=0)
            ratio = [f"{mine / its:.2f}" if name != OURS else "" for mine, its in zip(our_ms, ms, strict=True)]
            error, other = (
                np.median(
                    [apart(T, goal, p.source) for (T, *_), goal, p in zip(found[name], goals, problems, strict=True)],
                    axis=0,
                )
                for goals in ([p.T_true for p in problems], [T for T, *_ in found[OURS]])
            )
            told = [steps for _, steps, _ in found[name] if steps is not None]
            print(
                f"| {method} | {name} | {ms[0]:.1f} | {ratio[0]} | {ms[1]:.1f} | {ratio[1]} "
                f"| {f'{np.median(told):.0f}' if told else ''} | {error[0]:.1f}, {error[1]:.3f} "
                f"| {'' if name == OURS else f'{other[0]:.2f}, {other[1]:.4f}'} |",
                flush=True,
            )
    print()


def pair(folder: Path) -> Problem:
    """The pair in a folder, thinned to 25 cm, from the identity."""
    source, target = (
        voxel_grid(np.asarray(o3d.io.read_point_cloud(folder / f"{name}.ply").points), 0.25)
        for name in ("source", "target")
    )
    return Problem(source, target, np.eye(4), np.loadtxt(folder / "T_target_source.txt"), 1.0)


def flight() -> list[Problem]:
    """Frames of a simulated flight, each with the map of all earlier ones at their true poses, and a start that is off
    by about 5 cm and 1°."""
    settings = ExperimentSettings.preset(duration_s=DURATION_S)
    recording, truth = experiment.simulate(settings)
    true = truth.trajectory.at(recording.prior.stamp_s).T_world_drone
    crop = PreprocessSettings(crop_m=6.0, voxel_leaf_m=0.033)
    voxels, problems = VoxelMap(0.1), []
    for k, (scan, T) in enumerate(zip(recording.scans, true, strict=True)):
        points = preprocess_scan(scan, T, recording.T_drone_sensor, crop)
        if k % EVERY == EVERY - 1 and len(points) > 500:
            off = rng.stream(1, "benchmark", k)
            start = T.copy()
            start[:3, :3] = Rotation.from_rotvec(0.01 * off.standard_normal(3)).as_matrix() @ T[:3, :3]
            start[:3, 3] += 0.03 * off.standard_normal(3)
            world = points @ T[:3, :3].T + T[:3, 3]
            low, high = world.min(axis=0), world.max(axis=0)
            near = voxels.near((low + high) / 2, float((high - low).max() / 2 + 0.6))
            problems.append(Problem(points, voxels.means(near), start, T, 0.3))
        voxels.insert(points @ T[:3, :3].T + T[:3, 3])
    return problems


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pair", type=Path, help="folder with source.ply, target.ply and T_target_source.txt")
    given = parser.parse_args()
    programs = f"small_gicp {importlib.metadata.version('small_gicp')}, Open3D {o3d.__version__}"
    print(f"# Registration on one core\n\n{machine()}. `{command(__doc__)}`\n\n{programs}.\n")
    print(NOTES.format(NEIGHBOURS, ITERATIONS))
    if given.pair:
        p = pair(given.pair)
        print(f"## The pair: {len(p.source)} to {len(p.target)} points, {p.distance_m} m\n")
        measure([p], 31)
    problems = flight()
    sizes = [int(np.median([len(getattr(p, name)) for p in problems])) for name in ("source", "target")]
    print(f"## {len(problems)} frames over a flight of {DURATION_S:.0f} s, each to the map so far\n")
    print(f"Zigzag, starling2; {sizes[0]} to {sizes[1]} points (medians), {problems[0].distance_m} m; ", end="")
    print("starts off by about 5 cm and 1°. Numbers are medians over the frames.\n")
    measure(problems, 5)


if __name__ == "__main__":
    main()
