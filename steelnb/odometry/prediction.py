"""Prediction of the pose of a scan: the drifting prior, the correction so far, and the rate of that correction."""

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.fusion.poses import DRIFT_PERIOD_S, TILT_S, tilt_stays
from steelnb.types import Array

NONE = np.zeros((0, 3))
"""No directions."""


class Prediction:
    """Alpha-beta filter of the correction, with alpha = 1.

    ``gain`` (0 to 1) is the share of a new rate that is taken over; 0 predicts that the drift stands still. The
    correction turns the drone about itself and then moves it, both in the world frame.

    A solver that starts behind the drift stops a little behind it in every frame, and the map keeps that error: under
    a constant drift it adds up. After a scan that was not registered the rate is not used, and the correction stays.

    With ``tilt_sigma_rad`` above 0 the prior's roll and pitch have errors, a Gauss-Markov process with that standard
    deviation and the correlation time `TILT_S`: their correction fades, and has no rate.
    """

    def __init__(self, gain: float, tilt_sigma_rad: float = 0.0) -> None:
        self.gain, self.tilt_sigma_rad = gain, tilt_sigma_rad
        self.offset, self.turn = np.zeros(3), np.eye(3)
        self.offset_rate, self.turn_rate = np.zeros(3), np.zeros(3)
        self._followed = False

    def pose(self, T_world_drone_prior: Array, passed_s: float = DRIFT_PERIOD_S) -> Array:
        """The pose ``(4, 4)`` at which the registration of a scan starts, ``passed_s`` after the one before."""
        turn, offset = self.turn, self.offset
        if self._followed:
            turn, offset = Rotation.from_rotvec(self.turn_rate).as_matrix() @ turn, offset + self.offset_rate
        if self.tilt_sigma_rad:
            upright = np.cross(turn[:, 2], (0.0, 0.0, 1.0))  # the turn that takes the correction of the tilt back
            turn = Rotation.from_rotvec((1.0 - tilt_stays(passed_s)) * upright).as_matrix() @ turn
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turn @ T_world_drone_prior[:3, :3], T_world_drone_prior[:3, 3] + offset
        return T

    def correct(self, T_world_drone: Array, T_world_drone_prior: Array, unobserved: Array = NONE) -> None:
        """Update with the pose of a registered scan. Along ``unobserved (u, 3)``, unit vectors, the pose is the
        prediction's, and the rate of the drift is not known."""
        turn = T_world_drone[:3, :3] @ T_world_drone_prior[:3, :3].T
        offset = T_world_drone[:3, 3] - T_world_drone_prior[:3, 3]
        if self._followed:  # a jump after a gap is no rate
            self.offset_rate = self.offset_rate + self.gain * (offset - self.offset - self.offset_rate)
            turned = Rotation.from_matrix(turn @ self.turn.T).as_rotvec()
            self.turn_rate = self.turn_rate + self.gain * (turned - self.turn_rate)
            if self.tilt_sigma_rad:
                self.turn_rate[:2] = 0.0
        self.offset_rate = self.offset_rate - unobserved.T @ (unobserved @ self.offset_rate)
        self.turn, self.offset, self._followed = turn, offset, True

    def tilt_step_sigma_rad(self, passed_s: float) -> float:
        """Standard deviation of the change of the prior's roll and pitch within ``passed_s``."""
        return float(self.tilt_sigma_rad * np.sqrt(-np.expm1(-2.0 * passed_s / TILT_S)))

    def lose(self) -> None:
        """Update with a scan that was not registered."""
        self._followed = False
