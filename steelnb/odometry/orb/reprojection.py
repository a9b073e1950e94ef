"""Pose of a camera from landmarks: robust Gauss-Newton on reprojection errors."""

from typing import NamedTuple

import numpy as np

from steelnb.core.geometry import exp_about
from steelnb.core.robust import geman_mcclure
from steelnb.core.types import Array
from steelnb.odometry.orb.features import SCALE, Features
from steelnb.points.ranges import range_sigma_m
from steelnb.registration import Term

ITERATIONS_MAX = 15
ROTATION_EPSILON_RAD, TRANSLATION_EPSILON_M = 1e-4, 1e-4
PIXEL_SIGMA = 1.0
"""Standard deviation of a feature's pixel on the finest level, as in ORB-SLAM."""
FRONT_M = 0.05
"""Landmarks with a smaller depth than this are ignored."""


class Solved(NamedTuple):
    """``T_world_drone (4, 4)``; the robust ``weight (N,)`` of each observation, 0 to 1; and the normal matrix ``H (6,
    6)`` of the last step, for twists about the ``centre (3,)``."""

    T_world_drone: Array
    weight: Array
    H: Array
    centre: Array


def solve_pose(
    landmark: Array,
    features: Features,
    K: Array,
    T_drone_camera: Array,
    T_init: Array,
    free: Array,
    terms: list[Term],
    middle: Array,
    scale: float,
) -> Solved | None:
    """The pose of the drone that minimises Σ ρ(‖(Δu, Δv)/σ_px, Δ(1/x)/σ_1/x‖) + the costs of ``terms``.

    ``landmark (N, 3)``, world frame, were observed as ``features``. ρ is the Geman-McClure loss with a ``scale`` in
    standard deviations. The third residual, of the inverse depth, applies where a depth was measured. Up to a factor,
    it is ORB-SLAM2's coordinate in a virtual right camera (Mur-Artal, Tardós, IEEE Transactions on Robotics 33, 2017,
    section III.B). Steps are twists in the span of ``free (6, k)`` about the world position of ``middle (3,)``, a
    point in the drone frame. Returns None if the equations are singular.
    """
    T = T_init
    for _ in range(ITERATIONS_MAX):
        centre = T[:3, :3] @ middle + T[:3, 3]
        H, b = np.zeros((6, 6)), np.zeros(6)
        for term in terms:
            H_term, b_term, _ = term(T, centre)
            H, b = H + H_term, b + b_term
        error, J, weight = linearised_reprojections(landmark, features, K, T @ T_drone_camera, centre, scale)
        weighted = weight[:, None, None] * J
        H = np.vstack([H[None], (weighted[..., None] * J[:, :, None]).reshape(-1, 6, 6)]).sum(axis=0)
        b = np.vstack([b, (weighted * error[..., None]).reshape(-1, 6)]).sum(axis=0)
        try:
            step = -free @ np.linalg.solve(free.T @ H @ free, free.T @ b)
        except np.linalg.LinAlgError:
            return None
        T = exp_about(centre, step) @ T
        if np.linalg.norm(step[:3]) < ROTATION_EPSILON_RAD and np.linalg.norm(step[3:]) < TRANSLATION_EPSILON_M:
            break
    return Solved(T, weight, H, centre) if np.isfinite(T).all() else None


def linearised_reprojections(
    landmark: Array, features: Features, K: Array, T_world_camera: Array, centre: Array, scale: float
) -> tuple[Array, Array, Array]:
    """Residuals ``(N, 3)`` in standard deviations, their derivatives ``(N, 3, 6)`` with respect to a twist (ω, v) of
    the pose about ``centre (3,)``, world frame, and the robust weights ``(N,)``."""
    R, depth = T_world_camera[:3, :3], features.depth
    sigma_px = PIXEL_SIGMA * SCALE ** features.octave.astype(np.float64)
    point = ((landmark - T_world_camera[:3, 3])[:, :, None] * R).sum(axis=1)
    x = np.where(point[:, 0] < FRONT_M, np.nan, point[:, 0])
    # Residuals u = c − f·y/x, v = c − f·z/x and 1/x, and their derivatives with respect to the point.
    error, gradient = np.zeros((len(x), 3)), np.zeros((len(x), 3, 3))
    for k in range(2):
        f = K[k, k] / (x * sigma_px)
        error[:, k] = (K[k, 2] - features.pixel[:, k]) / sigma_px - f * point[:, k + 1]
        gradient[:, k, 0], gradient[:, k, k + 1] = f * point[:, k + 1] / x, -f
    sigma = range_sigma_m(depth) / depth**2
    error[:, 2], gradient[:, 2, 0] = (1 / x - 1 / depth) / sigma, -1 / (x * x * sigma)
    error, gradient = np.nan_to_num(error), np.nan_to_num(gradient)
    weight = np.where(np.isnan(x), 0.0, geman_mcclure((error**2).sum(axis=1), scale)[0])
    # A twist of the pose translates the point in the camera frame by −Rᵀ(ω × arm + v).
    by_shift = -(gradient[:, :, None] * R).sum(axis=3)
    by_turn = np.cross((landmark - centre)[:, None], by_shift)
    return error, np.concatenate([by_turn, by_shift], axis=2), weight
