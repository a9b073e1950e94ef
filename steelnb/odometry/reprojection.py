"""Pose of a camera from its landmarks: robust Gauss-Newton on reprojection errors."""

from typing import NamedTuple

import numpy as np
from numba import njit

from steelnb.registration import Term
from steelnb.registration.solve import exp_about
from steelnb.types import Array

ITERATIONS_MAX = 15
ROTATION_EPSILON_RAD, TRANSLATION_EPSILON_M = 1e-4, 1e-4
FRONT_M = 0.05
"""Landmarks with a smaller depth than this are ignored."""


class Sighting(NamedTuple):
    """N observations: ``landmark (N, 3)``, world frame; ``pixel (N, 2)`` with standard deviation ``sigma_px (N,)``;
    ``depth (N,)`` along the optical axis, metres, NaN if not measured, with standard deviation ``sigma_m (N,)``."""

    landmark: Array
    pixel: Array
    sigma_px: Array
    depth: Array
    sigma_m: Array


class Solved(NamedTuple):
    """``T_world_drone (4, 4)``; the robust ``weight (N,)`` of each observation, 0 to 1; ``determined``, False for
    singular equations; and the normal matrix ``H (6, 6)`` of the last step, for twists about the ``centre (3,)``."""

    T_world_drone: Array
    weight: Array
    determined: bool
    H: Array
    centre: Array


def solve_pose(
    sighting: Sighting,
    K: Array,
    T_drone_camera: Array,
    T_init: Array,
    free: Array,
    terms: list[Term],
    middle: Array,
    scale: float,
) -> Solved:
    """The pose of the drone that minimises Σ ρ(‖(Δu, Δv)/σ_px, Δ(1/x)/σ_1/x‖) + the costs of ``terms``.

    ρ is the Geman-McClure loss with a ``scale`` in standard deviations. The third residual, of the inverse depth,
    applies where a depth was measured. Up to a factor, it is ORB-SLAM2's coordinate in a virtual right camera
    (Mur-Artal, Tardós, IEEE Transactions on Robotics 33, 2017, section III.B). Steps are twists in the columns of
    ``free (6, k)``, about the world position of ``middle (3,)``, a point in the drone frame.
    """
    T, weight = T_init, np.ones(len(sighting.landmark))
    for _ in range(ITERATIONS_MAX):
        centre = T[:3, :3] @ middle + T[:3, 3]
        H, b = np.zeros((6, 6)), np.zeros(6)
        for term in terms:
            H_term, b_term, _ = term(T, centre)
            H, b = H + H_term, b + b_term
        linearise(*sighting, K, T @ T_drone_camera, centre, scale, H, b, weight)
        try:
            step = -free @ np.linalg.solve(free.T @ H @ free, free.T @ b)
        except np.linalg.LinAlgError:
            return Solved(T_init, weight, False, H, centre)
        T = exp_about(centre, step) @ T
        if np.linalg.norm(step[:3]) < ROTATION_EPSILON_RAD and np.linalg.norm(step[3:]) < TRANSLATION_EPSILON_M:
            break
    return Solved(T, weight, bool(np.isfinite(T).all()), H, centre)


@njit(cache=True)
def linearise(landmark, pixel, sigma_px, depth, sigma_m, K, T_world_camera, centre, scale, H, b, weight):
    """Add the normal equations of the observations to ``H (6, 6)`` and ``b (6,)``, for a twist (ω, v) of the pose about
    ``centre (3,)``, world frame. Fill ``weight (N,)`` with the robust weights."""
    R, point, arm = T_world_camera[:3, :3], np.empty(3), np.empty(3)
    error, gradient, J = np.empty(3), np.zeros((3, 3)), np.empty(6)
    for n in range(len(landmark)):
        for i in range(3):
            point[i], arm[i] = 0.0, landmark[n, i] - centre[i]
            for j in range(3):
                point[i] += R[j, i] * (landmark[n, j] - T_world_camera[j, 3])
        weight[n] = 0.0
        if point[0] < FRONT_M:
            continue
        # Residuals in standard deviations, and their derivatives by the point: u = c − f·y/x, v = c − f·z/x, 1/x.
        x, rows = point[0], 2
        for k in range(2):
            f = K[k, k] / (x * sigma_px[n])
            error[k] = (K[k, 2] - pixel[n, k]) / sigma_px[n] - f * point[k + 1]
            gradient[k, 0], gradient[k, 1], gradient[k, 2] = f * point[k + 1] / x, 0.0, 0.0
            gradient[k, k + 1] = -f
        if np.isfinite(depth[n]):
            sigma = sigma_m[n] / depth[n] ** 2
            error[2], gradient[2, 0], rows = (1 / x - 1 / depth[n]) / sigma, -1 / (x * x * sigma), 3
        square = 0.0
        for k in range(rows):
            square += error[k] * error[k]
        weight[n] = 1.0 / (1.0 + square / scale**2) ** 2
        for k in range(rows):
            # A twist of the pose translates the point in the camera frame by −Rᵀ(ω × arm + v).
            for i in range(3):
                J[3 + i] = -(gradient[k, 0] * R[i, 0] + gradient[k, 1] * R[i, 1] + gradient[k, 2] * R[i, 2])
            for i in range(3):
                j, m = (i + 1) % 3, (i + 2) % 3
                J[i] = arm[j] * J[3 + m] - arm[m] * J[3 + j]
            for i in range(6):
                b[i] += weight[n] * J[i] * error[k]
                for j in range(6):
                    H[i, j] += weight[n] * J[i] * J[j]
