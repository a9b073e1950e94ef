"""Prediction of the pose of a scan: the drifting prior, the correction so far, and the rate of that correction."""

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.types import Array

NONE = np.zeros((0, 3))
"""No directions."""


class Prediction:
    """Alpha-beta filter of the correction, with alpha = 1.

    ``gain`` (0 to 1) is the share of a new rate that is taken over; 0 predicts that the drift stands still. The
    correction turns the drone about itself and then moves it, both in the world frame.

    A solver that starts behind the drift stops a little behind it in every frame, and the map keeps that error: under
    a constant drift it adds up. After a scan that was not registered the rate is not used, and the correction stays.
    """

    def __init__(self, gain: float) -> None:
        self.gain = gain
        self.offset, self.turn = np.zeros(3), np.eye(3)
        self.offset_rate, self.turn_rate = np.zeros(3), np.zeros(3)
        self._followed = False

    def pose(self, T_world_drone_prior: Array) -> Array:
        """The pose ``(4, 4)`` at which the registration of a scan starts."""
        turn, offset = self.turn, self.offset
        if self._followed:
            turn, offset = Rotation.from_rotvec(self.turn_rate).as_matrix() @ turn, offset + self.offset_rate
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
        self.offset_rate = self.offset_rate - unobserved.T @ (unobserved @ self.offset_rate)
        self.turn, self.offset, self._followed = turn, offset, True

    def lose(self) -> None:
        """Update with a scan that was not registered."""
        self._followed = False
