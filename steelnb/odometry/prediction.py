"""What the predictions of `drift_filter` and `imu_filter` learn from a scan: its pose, and errors that scans share."""

from typing import NamedTuple

import numpy as np

from steelnb.core.types import Array


class RegisteredPose(NamedTuple):
    """The pose ``(4, 4)`` of a registered scan, and what determines it.

    ``unobserved (u, 3)``: unit vectors along which the pose is the predicted one. ``H (6, 6)``: joint information of
    prediction and registration about rotation and shift of a point, and ``arm (3,)``, the vector from there to the
    drone, world frame.
    """

    T_world_drone: Array
    unobserved: Array = np.zeros((0, 3))
    H: Array = np.zeros((6, 6))
    arm: Array = np.zeros(3)


class LastingError(NamedTuple):
    """An error that the registrations to one map share.

    The shift of the map is a first-order Gauss-Markov process with the standard deviation ``sigma_m`` along each axis
    and the correlation time ``time_s``. Its rotation is a random walk, which begins like such a process with
    ``sigma_rad`` about each axis.
    """

    sigma_rad: float
    sigma_m: float
    time_s: float

    @property
    def variance(self) -> Array:
        """Variances ``(6,)`` of rotation and shift."""
        return np.repeat([self.sigma_rad**2, self.sigma_m**2], 3)


NO_ERROR = LastingError(0.0, 0.0, 1.0)
