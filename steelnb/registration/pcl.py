"""ICP and GICP with the solver and stopping rules of PCL, which the programs of the report called.

Source: PCL 1.13 (`icp.hpp`, `gicp.hpp`, `default_convergence_criteria.hpp`). The report ran 1.10. At that time,
GICP compared the norm of the whole gradient with the bound; 1.13 compares translation and angles separately. Source
and target are in the world frame, and every step is a motion about its origin. So the bounds on the translation of a
step are stricter far from the origin. ``setRANSACOutlierRejectionThreshold`` has no effect: neither class reads it.
"""

from typing import NamedTuple

import numpy as np

from steelnb.core.arguments import checks_arguments
from steelnb.core.checks import checked_array, checked_integer, checked_kind, checked_number
from steelnb.core.errors import InputError
from steelnb.core.geometry import transform_points
from steelnb.core.types import Array
from steelnb.registration.pcl_bfgs import euler_pose, minimise, pair_metrics
from steelnb.registration.target import AnyTarget, Target, VoxelTarget

PAIRS_MIN = {"point": 3, "gicp": 4}
"""With fewer pairs a registration fails."""
MSE_CHANGE_MIN_M2 = 1e-12
"""ICP also stops when the mean squared error of the correspondences changes by less than this."""
ROTATION_EPSILON = 2e-3
"""GICP stops when every entry of the rotation matrix changes by less than this, and every entry of the translation by
less than ``epsilon``."""


class Aligned(NamedTuple):
    """``T_target_source (4, 4)``, ``converged`` in the sense of PCL, and the inliers of the last iteration."""

    T_target_source: Array
    converged: bool
    iterations: int
    inliers: int


@checks_arguments
def icp_as_pcl(
    source: Array,
    target: AnyTarget,
    max_correspondence_m: float,
    iterations_max: int,
    epsilon: float,
    mse_change_min: float = 0.0,
) -> Aligned:
    """Point-to-point ICP of ``source (N, 3)`` from the identity. Each step is the least-squares motion of the pairs.

    It stops after a step with ‖translation‖² ≤ ``epsilon`` and cos(angle) ≥ 1 − ``epsilon``; for 1e-3 that is a step
    below 3.2 cm and 2.6°. It also stops when the mean squared error of the pairs changes by less than the fraction
    ``mse_change_min``. Reaching ``iterations_max`` counts as converged. Raises `InputError`.
    """
    source, T, previous_mse_m2 = _checked(source, target, max_correspondence_m, iterations_max, epsilon), np.eye(4), 0.0
    search = target.search(source, max_correspondence_m)
    for iteration in range(1, iterations_max + 1):
        match = search(T)
        paired = match >= 0
        inliers = int(np.count_nonzero(paired))
        if inliers < PAIRS_MIN["point"]:
            return Aligned(T, False, iteration - 1, inliers)
        source_points, target_points = transform_points(T, source[paired]), target.point[match[paired]]
        step = least_squares_motion(source_points, target_points)
        T = step @ T
        mse_m2 = float(((source_points - target_points) ** 2).sum() / inliers)
        is_small_step = step[:3, 3] @ step[:3, 3] <= epsilon and 0.5 * (np.trace(step[:3, :3]) - 1) >= 1 - epsilon
        change_min_m2 = max(MSE_CHANGE_MIN_M2, mse_change_min * previous_mse_m2)
        if is_small_step or (iteration > 1 and abs(mse_m2 - previous_mse_m2) < change_min_m2):
            break
        previous_mse_m2 = mse_m2
    return Aligned(T, True, iteration, inliers)


@checks_arguments
def gicp_as_pcl(
    source: Array,
    covariance: Array,
    target: AnyTarget,
    max_correspondence_m: float,
    iterations_max: int,
    epsilon: float,
) -> Aligned:
    """Generalized ICP of ``source (N, 3)`` with ``covariance (N, 6)`` from the identity.

    Each step finds correspondences, fixes their metrics and calls `minimise`, which stops at a gradient of 1e-2. This
    leaves an error of up to a centimetre in the plane of a surface. The pose is therefore biased towards its
    start in directions with few normals. `minimise` also stops when single precision hides the slope (`mean_cost`).
    Reaching ``iterations_max`` counts as converged. Raises `InputError`.
    """
    source, T, x = _checked(source, target, max_correspondence_m, iterations_max, epsilon), np.eye(4), np.zeros(6)
    covariance = checked_array(covariance, "covariance", (len(source), 6))
    if len(target.covariance) != len(target.point):
        raise InputError("target: without covariances; expected make_target(cloud, 'gicp')")
    search = target.search(source, max_correspondence_m)
    for iteration in range(1, iterations_max + 1):
        match = search(T)
        chosen = np.flatnonzero(match >= 0)
        if len(chosen) < PAIRS_MIN["gicp"]:
            return Aligned(T, False, iteration - 1, len(chosen))
        match = match[chosen]
        metric = pair_metrics(covariance[chosen], target.covariance[match], T[:3, :3])
        minimise(x, source[chosen].astype(np.float32), target.point[match].astype(np.float32), metric)
        T_previous, T = T, euler_pose(x)
        change = np.abs(T - T_previous)
        if change[:3, :3].max() < ROTATION_EPSILON and change[:3, 3].max() < epsilon:
            break
    return Aligned(T, True, iteration, len(chosen))


def _checked(
    source: Array, target: AnyTarget, max_correspondence_m: float, iterations_max: int, epsilon: float
) -> Array:
    """The source, if all arguments are in range, else an `InputError`."""
    checked_kind(target, "target", Target | VoxelTarget, "make_target")
    checked_number(max_correspondence_m, "max_correspondence_m", above=0)
    checked_integer(iterations_max, "iterations_max", 1)
    checked_number(epsilon, "epsilon", 0)
    return checked_array(source, "source", ("N", 3))


def least_squares_motion(source_points: Array, target_points: Array) -> Array:
    """Rigid motion ``(4, 4)`` that aligns source points ``(N, 3)`` with target points ``(N, 3)`` by least squares.

    Source: Umeyama, PAMI 13 (1991), without scale.
    """
    source_mean, target_mean = source_points.mean(axis=0), target_points.mean(axis=0)
    U, _, Vt = np.linalg.svd((target_points - target_mean).T @ (source_points - source_mean))
    U[:, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    motion = np.eye(4)
    motion[:3, :3] = U @ Vt
    motion[:3, 3] = target_mean - motion[:3, :3] @ source_mean
    return motion
