"""Errors against the covariances that an estimate states: normalised estimation error squared (NEES), and coverage.

Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001, section 5.4.
"""

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from steelnb.errors import InputError
from steelnb.fusion.sections import frames
from steelnb.fusion.uncertainty import check_covariances
from steelnb.types import Array, Segments, Trajectory


def pose_errors(estimate: Trajectory, truth: Trajectory) -> Array:
    """Errors ``(K, 6)`` in x, y, z, roll, pitch, yaw, metres and radians, at the stamps of the estimate.

    The perturbation of `Estimate.pose_covariance`: true minus estimated position, and the rotation vector, in the axes
    of the world, that turns the estimated attitude into the true one.
    """
    T, true = estimate.T_world_drone, truth.at(estimate.stamp_s).T_world_drone
    turned = Rotation.from_matrix(true[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
    return np.column_stack([(true - T)[:, :3, 3], turned])


def axis_errors(segments: Segments, axes: Array) -> Array:
    """Errors ``(B, 4)`` of axes against the true lines ``axes (B, 2, 3)``, as in `Estimate.axis_covariance`: two of
    place, metres, where the true line goes through the plane across the segment's middle, and two of slope."""
    u, across = segments.direction, frames(segments.direction)
    true = axes[:, 1] - axes[:, 0]
    true = true / (true * u).sum(axis=1)[:, None]  # a metre along the segment
    off = axes[:, 0] - segments.middle
    off = off - (off * u).sum(axis=1)[:, None] * true
    return np.concatenate([(across @ each[:, :, None])[:, :, 0] for each in (off, true)], axis=1)


def nees(error: Array, covariance: Array) -> Array:
    """Normalised estimation error squared ``(N,)`` of errors ``(N, D)`` with covariances ``(N, D, D)``.

    Its mean is D where the covariances are right; above that they are optimistic. Raises `InputError` for shapes
    that do not fit, and for a covariance that is not finite and positive definite, such as that of a first
    pose, which is held: leave it out.
    """
    if error.ndim != 2 or covariance.shape != (*error.shape, error.shape[1]):
        raise InputError(f"covariance of shape {covariance.shape}: expected (N, D, D) for errors {error.shape}")
    check_covariances(covariance, "error", tuple(f"component {k}" for k in range(error.shape[1])))
    return np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])


def coverage(squared: Array, dof: int, share: float = 0.95) -> float:
    """Share, 0 to 1, of NEES ``(N,)`` within the ellipsoid that should hold ``share`` of the truths."""
    return float(np.mean(squared <= 2.0 * gammaincinv(0.5 * dof, share)))
