"""Poses as variables of an adjustment (`fusion.adjustment.problem`), and the factors of the drifting prior on them.

The step of a pose is that of `core.geometry`, in the world frame, with six numbers or the last four.

The prior drifts in position and yaw as a random walk. Its roll and pitch are exact by default. With a standard
deviation ``tilt_sigma_rad``, their errors are a first-order Gauss-Markov process, like those of an attitude filter.
"""

from typing import NamedTuple

import numpy as np

from steelnb.core.geometry import POSE_DOF, UPRIGHT_DOF, pose_step, tilt_of, yaw_of
from steelnb.core.types import Array

DRIFT_SIGMA = np.array([0.002, 0.01, 0.01, 0.01])
"""Standard deviation of the drift of yaw, x, y and z in `DRIFT_PERIOD_S`, radians and metres."""
DRIFT_PERIOD_S = 0.2
TILT_S = 10.0
"""Correlation time of the errors of the prior's roll and pitch: that of attitude filters is seconds to a minute."""
TILT_SIGMA_RAD = 0.0175
"""Default standard deviation (1°) of the prior's roll and pitch if there is an IMU."""
FIXED = 1e12
"""Information that fixes a pose."""


class ChainEquations(NamedTuple):
    """Normal equations of a chain of K states with D degrees of freedom: information ``matrix (K, D, D)`` and
    ``vector (K, D)`` of each state, and the block ``beside (K − 1, D, D)`` between each state and the next."""

    matrix: Array
    beside: Array
    vector: Array


def pose_size(tilt_sigma_rad: float) -> int:
    """The degrees of freedom of a pose: six if the prior's roll and pitch have a standard deviation, else four."""
    return POSE_DOF if tilt_sigma_rad > 0 else UPRIGHT_DOF


def drift_variance(passed_s: Array | float) -> Array:
    """Variance ``(…, 4)`` of the drift of yaw, x, y and z in the times ``passed_s (…)``, proportional to them."""
    return np.asarray(passed_s)[..., None] / DRIFT_PERIOD_S * DRIFT_SIGMA**2


def tilt_decay(passed_s: Array | float) -> Array:
    """The factor ``(…)`` by which errors of the prior's roll and pitch decay in the times ``passed_s (…)``."""
    return np.exp(-np.asarray(passed_s) / TILT_S)


def chain_equations(
    state_error: Array, state_weight: Array, error: Array, weight: Array, before: Array, after: Array
) -> ChainEquations:
    """Normal equations of factors on single states and between neighbours.

    Each state has errors ``(K, D)`` with information ``(K, D)``. Between each state and the next, there are errors
    ``(K − 1, D)`` with information ``weight (K − 1, D, D)``; ``before`` and ``after (K − 1, D, D)`` are their Jacobians
    with respect to the earlier and the later state.
    """
    matrix, vector = state_weight[:, :, None] * np.eye(state_error.shape[1]), -state_weight * state_error
    earlier, later = before.transpose(0, 2, 1) @ weight, after.transpose(0, 2, 1) @ weight
    for at, weighted, jacobian in ((slice(None, -1), earlier, before), (slice(1, None), later, after)):
        matrix[at] += weighted @ jacobian
        vector[at] -= (weighted @ error[:, :, None])[:, :, 0]
    return ChainEquations(matrix, earlier @ after, vector)


def prior_equations(
    T: Array, prior: Array, stamp_s: Array, tilt_sigma_rad: float = 0.0, upright: bool = True
) -> ChainEquations:
    """Normal equations of the prior's factors on the poses ``T (K, 4, 4)`` at ``stamp_s (K,)``.

    The increments of position and yaw are those of the ``prior (K, 4, 4)``, in the frame of the earlier pose. Errors of
    roll and pitch, if free, follow their Gauss-Markov process. The first pose is fixed to the prior's. Its roll and
    pitch are fixed only if the prior is ``upright`` there; otherwise they have the sigma ``tilt_sigma_rad``.
    """
    size = pose_size(tilt_sigma_rad)
    tilt, yaw, shift = slice(0, size - UPRIGHT_DOF), size - UPRIGHT_DOF, slice(size - 3, size)
    first_error, first_weight = np.zeros((2, len(T), size))
    first_error[0], first_weight[0] = pose_step(prior[0], T[0], size), FIXED
    if not upright:
        first_weight[0, tilt] = tilt_sigma_rad**-2.0
    gap_s = np.maximum(np.diff(stamp_s), 1e-6)
    error, weight = np.zeros((2, len(gap_s), size))
    turned = T[:-1, :3, :3] @ prior[:-1, :3, :3].transpose(0, 2, 1)
    expected = (turned @ np.diff(prior[:, :3, 3], axis=0)[:, :, None])[:, :, 0]
    rotation = T[1:, :3, :3] @ (turned @ prior[1:, :3, :3]).transpose(0, 2, 1)
    error[:, yaw], error[:, shift] = yaw_of(rotation), np.diff(T[:, :3, 3], axis=0) - expected
    weight[:, yaw:] = 1.0 / drift_variance(gap_s)
    after = np.tile(np.eye(size), (len(gap_s), 1, 1))
    before = -after
    before[:, yaw + 1, yaw], before[:, yaw + 2, yaw] = expected[:, 1], -expected[:, 0]
    if tilt_sigma_rad:
        off, decay = tilt_of(prior[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1)), tilt_decay(gap_s)[:, None]
        error[:, tilt] = decay * off[:-1] - off[1:]
        weight[:, tilt] = tilt_sigma_rad**-2.0 / (1.0 - decay**2)
        before[:, tilt, tilt] = -decay[:, :, None] * np.eye(2)
    return chain_equations(first_error, first_weight, error, weight[:, :, None] * np.eye(size), before, after)
