"""The Cramér–Rao bound of the poses of a flight, beside what the methods reach with and without range noise.

    .venv/bin/python benchmarks/limit.py

Computed from true poses and surfaces. No unbiased estimator has smaller standard deviations (Van Trees, "Detection,
Estimation, and Modulation Theory", 1968; for range finders Censi, "On achievable accuracy for range-finder
localization", ICRA 2007). limit.md has the equations and their assumptions. Prints the table of that page.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.linalg import cholesky, lapack, solve_triangular
from scipy.spatial.transform import Rotation

from steelnb import experiment
from steelnb.core.determinism import machine
from steelnb.core.types import Array, IntArray
from steelnb.fusion.adjustment.factors import DRIFT_PERIOD_S, DRIFT_SIGMA
from steelnb.settings import ExperimentSettings, TofSettings, TrajectoryName
from steelnb.simulation import Truth
from steelnb.simulation.raycasting import cast_bundle, make_scene, rays
from steelnb.simulation.tof import RANGE_MIN_M
from steelnb.simulation.tower import Tower

POSE = 4
"""x, y, z in the world, and yaw about the vertical through the drone."""
MOUNT, WORLD = 7, 3
"""Rotation and translation of the sensor in the frame of the drone, and the delay of its stamps; and a rotation of all
surfaces, whose directions are otherwise known: with an unknown mount, no scan tells it."""
WORLD_SIGMA_RAD = 1.0
PATCH_M, INCIDENCE_MAX_RAD = 0.1, np.radians(80.0)
"""Edge of the cubes that cut the faces of the tower into patches, each with its own shift. Returns at a larger angle of
incidence are dropped, since the spot of a pixel is not a point there."""
EXACT = {"tof.sigma_floor_m": 0.0, "tof.sigma_relative": 0.0}
NOISE, SENSOR, SEED, DURATION_S = "random-walk+yaw-random-walk", "starling2", 1, 200.0
FLIGHTS: tuple[TrajectoryName, ...] = ("zigzag", "loops")

METHODS = ("icp", "gicp", "best", "faces", "smoothed")


class Information(NamedTuple):
    """See `gather`."""

    poses: Array
    first: IntArray
    scan: IntArray
    cross: Array
    shift: Array
    shared: Array


def seen(tower: Tower, T_world_drone: Array, tof: TofSettings, twist: Array) -> Iterator[tuple[Array, IntArray]]:
    """For each scan of a tower without ground from true poses ``(K, 4, 4)``: derivatives ``(N, 15)`` of the ranges by
    x, y, z and yaw of the drone, by `MOUNT`, by `WORLD` and by the shift of the face, divided by the range noise; and
    patch numbers ``(N,)``. ``twist (K, 6)``: angular rate and velocity of the drone, world frame.
    """
    scene, ray = make_scene(tower), rays(tof).reshape(-1, 3)
    corner = tower.vertices[tower.triangles]
    normal = np.cross(*np.diff(corner, axis=1).swapaxes(0, 1))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    level = np.round(np.column_stack([tower.triangle_member, normal, (normal * corner[:, 0]).sum(axis=1)]), 5)
    face = np.unique(level, axis=0, return_inverse=True)[1].ravel()
    low, high = tower.vertices.min(axis=0) - PATCH_M, tower.vertices.max(axis=0)
    shape = (len(tower.triangles), *(np.ceil((high - low) / PATCH_M).astype(int) + 1))
    bundle = np.empty((len(ray), 6), dtype=np.float32)
    for drone, moving in zip(T_world_drone, twist, strict=True):
        T = drone @ tof.T_drone_sensor
        along = ray @ T[:3, :3].T
        bundle[:, :3], bundle[:, 3:] = T[:3, 3], along
        hit = cast_bundle(scene, bundle)
        range_m, triangle = hit.range_m.astype(np.float64), hit.triangle
        kept = np.flatnonzero((triangle < len(normal)) & (range_m >= RANGE_MIN_M) & (range_m <= tof.range_max_m))
        slope = (normal[triangle[kept]] * along[kept]).sum(axis=1)
        kept, slope = (each[np.abs(slope) > np.cos(INCIDENCE_MAX_RAD)] for each in (kept, slope))
        n, distance = normal[triangle[kept]], range_m[kept]
        points = T[:3, 3] + distance[:, None] * along[kept]
        turn = np.cross(points - drone[:3, 3], n)  # by rotations of the drone about the world's axes
        at_sensor = np.cross(points - T[:3, 3], n) @ drone[:3, :3]
        late = turn @ moving[:3] + n @ moving[3:]
        world = np.cross(points, n)
        sigma_m = np.maximum(tof.sigma_floor_m, tof.sigma_relative * distance)
        by_mount = np.column_stack([-at_sensor, -n @ drone[:3, :3], late])
        gradient = np.column_stack([-n, -turn[:, 2], by_mount, world, np.ones(len(n))]) / (slope * sigma_m)[:, None]
        cell = ((points - low) / PATCH_M).astype(int)
        yield gradient, np.ravel_multi_index((face[triangle[kept]], *cell.T), shape)


def gather(scans: Iterator[tuple[Array, IntArray]]) -> Information:
    """Fisher information of the returns of K scans about their ``poses (K, 4, 4)`` and the patches of the surface.

    Pairs of a patch and a scan that sees it are sorted by patch, from ``first[p]`` to ``first[p + 1] - 1``, then by
    ``scan (N,)``. ``cross (N, 14)`` couples pose, `MOUNT` and `WORLD` and the shift of the patch; ``shift (N,)`` is of
    the shift alone. ``shared (K, 14, 10)`` is about pose, mount and world, and the last two.
    """
    both, patches, numbers, sums = [], [], [], []
    for k, (g, patch_of) in enumerate(scans):
        both.append(g[:, :-1].T @ g[:, :-1])
        patch, place = np.unique(patch_of, return_inverse=True)
        weighed = g * g[:, -1:]
        sums.append(np.column_stack([np.bincount(place, column, len(patch)) for column in weighed.T]))
        patches.append(patch)
        numbers.append(np.full(len(patch), k))
    patch, scan, total = (np.concatenate(parts) for parts in (patches, numbers, sums))
    order = np.argsort(patch, kind="stable")
    first = np.append(0, np.cumsum(np.unique(patch, return_counts=True)[1]))
    poses = np.array(both)
    total = total[order]
    return Information(
        poses[:, :POSE, :POSE], first, scan[order], total[:, :-1].copy(), total[:, -1].copy(), poses[:, :, POSE:]
    )


def chain(information: Information, stamp_s: Array, drift_sigma: Array = DRIFT_SIGMA) -> Array:
    """The information about all poses, from as many scans as there are stamps and the prior's increments. Patches are
    eliminated (Schur complement); only the lower triangle is valid. ``drift_sigma (4,)``: of yaw, x, y and z."""
    step, poses = np.diff(np.eye(len(stamp_s)), axis=0), len(stamp_s)
    weight = drift_sigma[[1, 2, 3, 0]] ** -2.0
    matrix = np.kron((step.T * DRIFT_PERIOD_S / np.diff(stamp_s)) @ step, np.diag(weight))
    matrix.reshape(poses, POSE, poses, POSE)[range(poses), :, range(poses)] += information.poses[:poses]
    eliminate(matrix, poses, information.first, information.scan, information.cross, information.shift)
    return np.asarray(matrix)


def factor(information: Information, stamp_s: Array) -> Array:
    """Lower triangular Cholesky factor of the information about all poses but the first, which is known (`chain`)."""
    matrix = chain(information, stamp_s)
    return np.asarray(cholesky(matrix[POSE:, POSE:], lower=True, overwrite_a=True, check_finite=False))


@njit(cache=True, error_model="numpy")
def eliminate(matrix, poses, first, scan, cross, shift):  # type: ignore[no-untyped-def]
    """Eliminate the shift of each patch: subtract its Schur complement term from the lower triangle of ``matrix``."""
    for patch in range(len(first) - 1):
        begin, end, total = first[patch], first[patch], 0.0
        while end < first[patch + 1] and scan[end] < poses:
            total += shift[end]
            end += 1
        for a in range(begin, end):
            for b in range(begin, a + 1):
                row, column = POSE * scan[a], POSE * scan[b]
                for i in range(POSE):
                    for j in range(POSE):
                        matrix[row + i, column + j] -= cross[a, i] * cross[b, j] / total


def mount_equations(information: Information) -> tuple[Array, Array]:
    """Information ``(4 K, 10)`` about poses, `MOUNT` and `WORLD` and ``(10, 10)`` about the last two, of all scans,
    after the shifts of the patches are eliminated."""
    first, scan, cross = information.first, information.scan, information.cross
    total, by_patch = (np.add.reduceat(each, first[:-1]) for each in (information.shift, cross[:, POSE:]))
    patch = np.repeat(np.arange(len(first) - 1), np.diff(first))
    by_pose = information.shared[:, :POSE].copy()
    np.subtract.at(by_pose, scan, cross[:, :POSE, None] * (by_patch / total[:, None])[patch][:, None])
    alone = information.shared[:, POSE:].sum(axis=0) - by_patch.T @ (by_patch / total[:, None])
    return by_pose.reshape(-1, MOUNT + WORLD), alone


def mount_bound(
    information: Information, stamp_s: Array, mount_sigma: Array, drift_sigma: Array = DRIFT_SIGMA
) -> tuple[float, Array]:
    """The batch bound with an unknown mount: root mean square of the standard deviation of the position, mm, and those
    of the mount ``(7,)``, rad, m and s. ``mount_sigma (7,)``: of its prior, 0 for what is known."""
    matrix = chain(information, stamp_s, drift_sigma)[POSE:, POSE:]
    inverse = lapack.dpotri(cholesky(matrix, lower=True, check_finite=False), lower=1)[0]
    inverse = np.tril(inverse) + np.tril(inverse, -1).T
    by_pose, alone = mount_equations(information)
    prior = np.append(mount_sigma, np.full(WORLD, WORLD_SIGMA_RAD if mount_sigma.any() else 0.0))
    free = np.flatnonzero(prior)
    gain = inverse @ by_pose[POSE:, free]
    schur = alone[np.ix_(free, free)] + np.diag(prior[free] ** -2.0) - by_pose[POSE:, free].T @ gain
    covariance = np.linalg.inv(schur)
    variance = np.diag(inverse) + ((gain @ covariance) * gain).sum(axis=1)
    sigma = np.zeros(MOUNT + WORLD)
    sigma[free] = np.sqrt(np.diag(covariance))
    position = np.append(0.0, variance.reshape(-1, POSE)[:, :3].sum(axis=1))
    return float(1e3 * np.sqrt(position.mean())), sigma[:MOUNT]


def flight_information(truth: Truth, settings: ExperimentSettings, stamp_s: Array) -> Information:
    """`gather` of the scans of a flight."""
    T, path = truth.trajectory.at(stamp_s).T_world_drone, truth.trajectory
    velocity = np.gradient(path.position, path.stamp_s, axis=0)
    turn = Rotation.from_matrix(path.T_world_drone[1:, :3, :3] @ path.T_world_drone[:-1, :3, :3].transpose(0, 2, 1))
    rate = turn.as_rotvec() / np.diff(path.stamp_s)[:, None]
    at = np.minimum(np.searchsorted(path.stamp_s, stamp_s - 1e-6), len(rate) - 1)
    return gather(seen(truth.tower, T, settings.tof, np.hstack([rate[at], velocity[at]])))


def bounds_mm(truth: Truth, settings: ExperimentSettings, stamp_s: Array) -> dict[str, float]:
    """Root mean square over the poses of the standard deviation of the position, for each bound by its name.

    The covariance of the last pose follows from the last block of a factor alone, since it is eliminated last. The
    causal variance is interpolated linearly between the poses where it is computed, and is at least the batch variance.
    """
    information = flight_information(truth, settings, stamp_s)
    steps = [1, 2, 4, 8, 16, 32, *np.linspace(0, len(stamp_s) - 1, 15).astype(int)]
    some = np.unique(np.minimum(steps, len(stamp_s) - 1))
    ends = [0.0]
    for k in some[1:]:
        block = factor(information, stamp_s[: k + 1])[-POSE:, -POSE:]
        ends.append((solve_triangular(block, np.eye(POSE), lower=True)[:, :3] ** 2).sum())
    inverse = lapack.dpotri(factor(information, stamp_s), lower=1)[0]
    batch = np.append(0.0, np.diag(inverse).reshape(-1, POSE)[:, :3].sum(axis=1))
    one = np.linalg.inv(information.poses)[:, range(3), range(3)].sum(axis=1)
    squares = {"causal": np.maximum(np.interp(stamp_s, stamp_s[some], ends), batch), "batch": batch, "one scan": one}
    return {name: float(1e3 * np.sqrt(square.mean())) for name, square in squares.items()}


def main() -> None:
    print(f"{machine()}\n\n| flight | bound or method | ATE (mm) | without range noise |\n|---|---|---|---|")
    for trajectory in FLIGHTS:
        for method in METHODS:
            settings = ExperimentSettings.preset(trajectory, NOISE, method, SENSOR, SEED, DURATION_S)
            result = experiment.run(settings)
            if method == METHODS[0]:
                for name, ate_mm in bounds_mm(result.truth, settings, result.corrected.stamp_s).items():
                    print(f"| {trajectory} | {name} | {ate_mm:.2f} | |", flush=True)
            error_m, exact_m = (r.metrics["ate_rmse_m"] for r in (result, experiment.run(settings.override(EXACT))))
            print(f"| {trajectory} | `{method}` | {1e3 * error_m:.1f} | {1e3 * exact_m:.1f} |", flush=True)


if __name__ == "__main__":
    main()
