"""The state of the filter that predicts poses from an IMU (`steelnb.odometry.imu_filter`)."""

from typing import NamedTuple

import numpy as np

from steelnb.core.geometry import POSE_DOF, moved_poses
from steelnb.core.types import Array
from steelnb.fusion.adjustment.imu_factors import POSE, STATE_DOF
from steelnb.odometry.prediction import NO_ERROR, LastingError

FILTER_DOF = STATE_DOF + POSE_DOF
ERROR = slice(STATE_DOF, FILTER_DOF)
"""The order of errors here: those of `imu_factors`, then the lasting error of registrations, rotation and position."""


class State(NamedTuple):
    """Pose ``T_world_drone (4, 4)``, ``velocity (3,)`` in the world frame, ``bias (6,)`` of gyroscope and accelerometer
    and the lasting ``error (6,)`` of registrations, with the ``covariance (N, N)`` of their errors, at ``stamp_s``;
    ``prior (4, 4)``: the drifting pose then; ``lasting``: the process that ``error`` follows."""

    stamp_s: float
    prior: Array
    T_world_drone: Array
    velocity: Array
    bias: Array
    error: Array
    covariance: Array
    lasting: LastingError

    @property
    def T_registered(self) -> Array:
        """The pose ``(4, 4)`` that a registration is expected to give: with its error."""
        return moved_poses(self.T_world_drone[None], self.error[None])[0]

    @property
    def registered_covariance(self) -> Array:
        """Covariance ``(6, 6)`` of that pose."""
        return seen(seen(self.covariance).T)

    def with_new_error(self, lasting: LastingError) -> "State":
        """Before the first registration with another ``lasting`` error, of which nothing is known yet."""
        size = state_size(lasting)
        P = np.zeros((size, size))
        P[:STATE_DOF, :STATE_DOF] = self.covariance[:STATE_DOF, :STATE_DOF]
        if size == FILTER_DOF:
            P[ERROR, ERROR] = np.diag(lasting.variance)
        return self._replace(error=np.zeros(POSE_DOF), covariance=P, lasting=lasting)


def seen(rows: Array) -> Array:
    """Rows ``(6, M)`` of the registered pose from the rows ``(N, M)`` of a state."""
    return np.asarray(rows[POSE] + rows[ERROR]) if len(rows) == FILTER_DOF else rows[POSE]


def moved_error(error: Array, step: Array) -> Array:
    """The lasting ``error (6,)`` of registrations after the step ``(N,)`` of a state."""
    return error + step[ERROR] if len(step) == FILTER_DOF else error


def state_size(lasting: LastingError) -> int:
    """The degrees of freedom N of a state: 21, or 15 if registrations have no lasting error."""
    return STATE_DOF if lasting == NO_ERROR else FILTER_DOF
