"""The predictions that odometries start their registrations from: their interface, and that from the drifting prior."""

from typing import NamedTuple, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.geometry import rotation_between
from steelnb.core.types import Array
from steelnb.fusion.adjustment.factors import DRIFT_PERIOD_S, tilt_decay
from steelnb.registration import Term, prior_term


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


DRIFT_GAIN = 0.05
"""Gain of the filter of the drift rate. Chosen on the development seeds 11 and 12."""
PRIOR_SIGMA = 0.05, 0.02
"""Standard deviations of the prediction for corrections by segments or image features, metres and radians. Chosen on
the development seeds 11 and 12."""


class DriftPrediction:
    """Alpha-beta filter of the correction of a drifting prior, with alpha = 1 and beta = `DRIFT_GAIN`.

    The correction turns the drone about itself and then moves it, both in the world frame. With a ``prior_sigma``
    (metres and radians), the filter estimates the drift rate and predicts with it; otherwise it predicts the last
    correction. A solver that starts behind the drift also stops slightly behind it, in every scan. The map retains
    these errors, so they accumulate under a constant drift. After a scan that was not registered, the rate is not used.
    Along unobserved directions, the rate is unknown.

    If ``tilt_sigma_rad`` is above 0, the prior's roll and pitch have errors: a Gauss-Markov process with that standard
    deviation and the correlation time `factors.TILT_S`. Their correction decays and has no rate.
    """

    def __init__(self, prior_sigma: tuple[float, float] | None, tilt_sigma_rad: float = 0.0) -> None:
        self.known, self.tilt_sigma_rad = prior_sigma is not None, tilt_sigma_rad
        self.tilted = tilt_sigma_rad > 0
        self.gain, self.information = 0.0, np.zeros((6, 6))  # of the prediction, rotation first
        if prior_sigma is not None:
            sigma_m, sigma_rad = prior_sigma
            self.gain, self.information = DRIFT_GAIN, np.diag([sigma_rad**-2.0] * 3 + [sigma_m**-2.0] * 3)
        self.offset, self.turn = np.zeros(3), np.eye(3)
        self.offset_rate, self.turn_rate = np.zeros(3), np.zeros(3)
        self._followed = False
        self._last_s = self._current_s = np.nan  # stamps of the last scan and of the predicted one
        self._prior = self._pose = np.eye(4)  # at the last scan

    def pose(self, prior: Array, stamp_s: float, lasting: LastingError = NO_ERROR) -> Array:
        """The predicted pose ``(4, 4)`` of the drone at a scan with the drifting pose ``prior``. The information about
        roll and pitch follows from the time since the last scan. This filter knows of no ``lasting`` error."""
        self._current_s, passed_s = stamp_s, stamp_s - self._last_s
        passed_s = passed_s if passed_s > 0 else DRIFT_PERIOD_S  # the first scan, and scans without stamps
        turn, offset = self.turn, self.offset
        if self._followed:
            turn, offset = Rotation.from_rotvec(self.turn_rate).as_matrix() @ turn, offset + self.offset_rate
        if self.tilted:
            upright = np.cross(turn[:, 2], (0.0, 0.0, 1.0))  # the rotation that undoes the correction of the tilt
            turn = Rotation.from_rotvec((1.0 - tilt_decay(passed_s)) * upright).as_matrix() @ turn
            changed = 1.0 - tilt_decay(2.0 * passed_s)  # share of the variance of the prior's roll and pitch
            self.information[[0, 1], [0, 1]] = 1.0 / float(self.tilt_sigma_rad**2 * changed)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turn @ prior[:3, :3], prior[:3, 3] + offset
        self._prior, self._pose = prior, T.copy()
        return T

    def terms(self, T_predicted: Array, points: Array) -> list[Term]:
        """The cost of deviating from the predicted pose: rotation, and shift of the mean of ``points (N, 3)``, drone
        frame. Empty if the prediction has no stated uncertainty."""
        return [prior_term(self.information, T_predicted, points)] if self.known else []

    def correct(self, registered: RegisteredPose) -> None:
        """Update with the pose of a registered scan."""
        T_world_drone, prior, unobserved = registered.T_world_drone, self._prior, registered.unobserved
        turn, offset = T_world_drone[:3, :3] @ prior[:3, :3].T, T_world_drone[:3, 3] - prior[:3, 3]
        if self._followed:  # a jump after a gap is not a rate
            self.offset_rate = self.offset_rate + self.gain * (offset - self.offset - self.offset_rate)
            turned = rotation_between(self.turn, turn)
            self.turn_rate = self.turn_rate + self.gain * (turned - self.turn_rate)
            if self.tilted:
                self.turn_rate[:2] = 0.0
        self.offset_rate = self.offset_rate - unobserved.T @ (unobserved @ self.offset_rate)
        self.turn, self.offset, self._followed, self._last_s = turn, offset, True, self._current_s
        self._pose = T_world_drone

    def levelled(self, T_world_drone: Array) -> Array:
        """The same pose ``(4, 4)``."""
        return T_world_drone

    def covariance(self, T_world_drone: Array) -> None:
        """Unknown: this filter has that of a step, not that of a pose."""

    def lose(self) -> None:
        """Update with a scan that was not registered."""
        self._followed, self._last_s = False, self._current_s

    def adjust(self, T_correction: Array, variance: Array) -> None:
        """Continue from an adjusted pose, without a change of the drift rate; this filter has no variance."""
        self.lose()
        self.correct(RegisteredPose(T_correction @ self._pose))
