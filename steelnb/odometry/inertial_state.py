"""The state of the filter that predicts poses from an IMU (`steelnb.odometry.imu_filter`)."""

from typing import NamedTuple

import numpy as np

from steelnb.core.geometry import POSE_DOF, moved_poses, pose_difference
from steelnb.core.types import Array
from steelnb.fusion.adjustment.imu_factors import POSE, POSITION, STATE_DOF
from steelnb.odometry.prediction import LastingError

FILTER_DOF = STATE_DOF + POSE_DOF
ERROR = slice(STATE_DOF, FILTER_DOF)
"""The order of errors here: those of `imu_factors`, then the lasting error of registrations, rotation and position."""
TURN, SHIFT = slice(STATE_DOF, STATE_DOF + 3), slice(STATE_DOF + 3, FILTER_DOF)
"""The two parts of the lasting error."""


class State(NamedTuple):
    """Pose ``T_world_drone (4, 4)``, ``velocity (3,)`` in the world frame, ``bias (6,)`` of gyroscope and accelerometer
    and the lasting ``error (6,)`` of registrations, with the ``covariance (21, 21)`` of their errors, at ``stamp_s``;
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

    def on_another_map(self, lasting: LastingError) -> "State":
        """Before the first registration to another map. Its shift is unknown, and its rotation is that of the map that
        it was made from."""
        return self._with_new_shift(lasting, lasting.variance[3:])

    def on_a_moved_map(self, T_correction: Array, variance: Array) -> "State":
        """After the map and the registered pose have moved by ``T_correction (4, 4)``, world frame, whose errors have a
        ``variance (6,)`` of rotation and position.

        The new position is taken over. The new rotation is that of the map alone: it comes from the same readings as
        the rotation here, and would count twice.
        """
        state = self._with_new_shift(self.lasting, np.zeros(3))
        registered = T_correction @ self.T_registered
        error = pose_difference(self.T_world_drone, registered) * [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
        P = state.covariance
        P[TURN, TURN] += np.diag(variance[:3])
        P[POSITION, POSITION] += np.diag(variance[3:])
        return state._replace(T_world_drone=moved_poses(registered[None], -error[None])[0], error=error)

    def _with_new_shift(self, lasting: LastingError, variance: Array) -> "State":
        P = self.covariance.copy()
        P[SHIFT, :] = P[:, SHIFT] = 0.0
        P[SHIFT, SHIFT] = np.diag(variance)
        return self._replace(error=self.error * [1.0, 1.0, 1.0, 0.0, 0.0, 0.0], covariance=P, lasting=lasting)


def seen(rows: Array) -> Array:
    """Rows ``(6, M)`` of the registered pose from the rows ``(21, M)`` of a state."""
    return np.asarray(rows[POSE] + rows[ERROR])
