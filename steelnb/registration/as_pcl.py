"""ICP and GICP as PCL's classes solve and stop them: what the report's programs called.

Facts from PCL 1.13 (`icp.hpp`, `gicp.hpp`, `default_convergence_criteria.hpp`). The report ran 1.10; versions of that
time compare the whole gradient of GICP with the bound for which 1.13 takes translation and angles apart. Source and
target are in the world frame, every step is a motion about the world's origin, and so the rules that look at a step's
translation grow stricter with the distance from the origin. An outlier threshold
(``setRANSACOutlierRejectionThreshold``) changes nothing, because neither class reads it.
"""

from typing import NamedTuple

import numpy as np

from steelnb.registration.bfgs import euler_pose, metrics, minimise
from steelnb.registration.target import Target
from steelnb.types import Array

PAIRS_MIN = {"point": 3, "gicp": 4}
"""With fewer pairs a registration ends without having converged."""
MSE_CHANGE_MIN_M2 = 1e-12
"""ICP also stops where the mean squared distance of the pairs changes by less than this."""
ROTATION_EPSILON = 2e-3
"""GICP stops where no entry of the rotation matrix changes by more than this, and none of the translation by more than
epsilon."""


class Aligned(NamedTuple):
    """The pose ``T_target_source (4, 4)``, whether PCL calls it converged, the steps made and the last step's pairs."""

    T_target_source: Array
    converged: bool
    iterations: int
    inliers: int


def icp_as_pcl(
    source: Array,
    target: Target,
    max_correspondence_m: float,
    iterations_max: int,
    epsilon: float,
    mse_change_min: float = 0.0,
) -> Aligned:
    """Point-to-point ICP of ``source (N, 3)`` from the identity, each step the least-squares motion of its pairs.

    It stops after a step with ‖translation‖² ≤ ``epsilon`` and cos(angle) ≥ 1 − ``epsilon``: with 1e-3, a step below
    3.2 cm and 2.6°. It also stops where the mean squared distance of the pairs changes by less than the share
    ``mse_change_min``. Running out of iterations counts as converged.
    """
    T, before_m2 = np.eye(4), 0.0
    pairs = target.pairs(source, max_correspondence_m)
    for iteration in range(1, iterations_max + 1):
        pairs.update(T)
        paired = pairs.match >= 0
        inliers = int(np.count_nonzero(paired))
        if inliers < PAIRS_MIN["point"]:
            return Aligned(T, False, iteration - 1, inliers)
        here, there = source[paired] @ T[:3, :3].T + T[:3, 3], target.point[pairs.match[paired]]
        step = least_squares_motion(here, there)
        T = step @ T
        now_m2 = float(((here - there) ** 2).sum() / inliers)
        still = step[:3, 3] @ step[:3, 3] <= epsilon and 0.5 * (np.trace(step[:3, :3]) - 1) >= 1 - epsilon
        settled = iteration > 1 and abs(now_m2 - before_m2) < max(MSE_CHANGE_MIN_M2, mse_change_min * before_m2)
        if still or settled:
            break
        before_m2 = now_m2
    return Aligned(T, True, iteration, inliers)


def gicp_as_pcl(
    source: Array,
    covariance: Array,
    target: Target,
    max_correspondence_m: float,
    iterations_max: int,
    epsilon: float,
) -> Aligned:
    """Generalized ICP of ``source (N, 3)`` with ``covariance (N, 6)`` from the identity.

    Each step pairs the points, fixes the metrics of the pairs and minimises the mean squared distance by `minimise`,
    which is content with a gradient of 1e-2: in the plane of a surface that leaves up to a centimetre. So the pose is
    pulled towards its start in directions that few normals constrain. It also ends where single precision hides the
    slope (`mean_cost`). Running out of iterations counts as converged.
    """
    T, x = np.eye(4), np.zeros(6)
    pairs = target.pairs(source, max_correspondence_m)
    for iteration in range(1, iterations_max + 1):
        pairs.update(T)
        chosen = np.flatnonzero(pairs.match >= 0)
        if len(chosen) < PAIRS_MIN["gicp"]:
            return Aligned(T, False, iteration - 1, len(chosen))
        match = pairs.match[chosen]
        metric = metrics(covariance[chosen], target.covariance[match], T[:3, :3])
        minimise(x, source[chosen].astype(np.float32), target.point[match].astype(np.float32), metric)
        before, T = T, euler_pose(x)
        change = np.abs(T - before)
        if change[:3, :3].max() < ROTATION_EPSILON and change[:3, 3].max() < epsilon:
            break
    return Aligned(T, True, iteration, len(chosen))


def least_squares_motion(here: Array, there: Array) -> Array:
    """The rigid motion ``(4, 4)`` that brings points ``(N, 3)`` nearest to others ``(N, 3)`` (Umeyama, PAMI 13, 1991,
    without scale)."""
    middle_here, middle_there = here.mean(axis=0), there.mean(axis=0)
    U, _, Vt = np.linalg.svd((there - middle_there).T @ (here - middle_here))
    U[:, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    motion = np.eye(4)
    motion[:3, :3] = U @ Vt
    motion[:3, 3] = middle_there - motion[:3, :3] @ middle_here
    return motion
