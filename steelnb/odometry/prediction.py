"""Where a scan is expected: the drifting prior with the correction so far, and how fast that changes."""

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.datatypes import Array
from steelnb.errors import SettingsError


class Prediction:
    """The correction of the last scan and its rate: an alpha-beta filter with alpha = 1.

    ``gain`` 0–1 is how fast the rate follows; 0 predicts that the drift stands still. The correction turns the drone
    about itself and then moves it, both in the world frame.

    An iteration that starts behind stops behind, by the same little in every frame, and the map keeps it: under a
    constant drift that adds up. While nothing is seen, the rate says nothing either, and the correction stands.
    """

    def __init__(self, gain: float) -> None:
        self.gain = gain
        self.offset, self.turn = np.zeros(3), np.eye(3)
        self.offset_rate, self.turn_rate = np.zeros(3), np.zeros(3)
        self._followed = False

    def pose(self, T_world_drone_prior: Array) -> Array:
        """The pose ``(4, 4)`` to start from. Raises `SettingsError` for a prior that is not a finite ``(4, 4)``."""
        if np.shape(T_world_drone_prior) != (4, 4) or not np.isfinite(T_world_drone_prior).all():
            raise SettingsError(f"T_world_drone_prior = {T_world_drone_prior!r}: expected a finite (4, 4) array")
        turn, offset = self.turn, self.offset
        if self._followed:
            turn, offset = Rotation.from_rotvec(self.turn_rate).as_matrix() @ turn, offset + self.offset_rate
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turn @ T_world_drone_prior[:3, :3], T_world_drone_prior[:3, 3] + offset
        return T

    def correct(self, T_world_drone: Array, T_world_drone_prior: Array) -> None:
        """Take in the pose at which a scan was found."""
        turn = T_world_drone[:3, :3] @ T_world_drone_prior[:3, :3].T
        offset = T_world_drone[:3, 3] - T_world_drone_prior[:3, 3]
        if self._followed:  # a jump after a gap is no rate
            self.offset_rate = self.offset_rate + self.gain * (offset - self.offset - self.offset_rate)
            turned = Rotation.from_matrix(turn @ self.turn.T).as_rotvec()
            self.turn_rate = self.turn_rate + self.gain * (turned - self.turn_rate)
        self.turn, self.offset, self._followed = turn, offset, True

    def lose(self) -> None:
        """Take in that a scan was not found."""
        self._followed = False
