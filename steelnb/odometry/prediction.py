"""The interface of the predictions that odometries start their registrations from."""

from typing import NamedTuple, Protocol

import numpy as np

from steelnb.core.types import Array
from steelnb.registration import Term

NONE = np.zeros((0, 3))
"""No directions."""


class RegisteredPose(NamedTuple):
    """The pose ``(4, 4)`` of a registered scan, and what determines it.

    ``unobserved (u, 3)``: unit vectors along which the pose is the predicted one. ``H (6, 6)``: joint information of
    prediction and registration about rotation and shift of a point, and ``arm (3,)``, the vector from there to the
    drone, world frame.
    """

    T_world_drone: Array
    unobserved: Array = NONE
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


class Prediction(Protocol):
    """Predicts the pose of each scan. `pose` may be called repeatedly; `correct` or `lose` ends the scan."""

    @property
    def known(self) -> bool:
        """Whether the prediction has a stated uncertainty."""

    @property
    def tilted(self) -> bool:
        """Whether roll and pitch of the prior have errors, which a registration then corrects, too."""

    def pose(self, prior: Array, stamp_s: float, lasting: LastingError = NO_ERROR) -> Array:
        """The predicted pose ``(4, 4)`` of the drone at a scan with the drifting pose ``prior (4, 4)``, as a
        registration with a ``lasting`` error would find it."""

    def terms(self, T_predicted: Array, points: Array) -> list[Term]:
        """The cost of deviating from the predicted pose, of a registration of ``points (N, 3)``, drone frame."""

    def correct(self, registered: RegisteredPose) -> None:
        """Update with the registration of the scan."""

    def levelled(self, T_world_drone: Array) -> Array:
        """The pose ``(4, 4)`` to put out for a registered pose of the last scan."""

    def covariance(self, T_world_drone: Array) -> Array | None:
        """The ``covariance`` of an `OdometryStep` with this pose ``(4, 4)`` for the last scan; None if unknown."""

    def lose(self) -> None:
        """Update with a scan that was not registered."""

    def adjust(self, T_correction: Array, variance: Array) -> None:
        """Move the map and the registered pose of the last scan by ``T_correction (4, 4)``, world frame, whose errors
        have a ``variance (6,)`` of rotation and position."""
