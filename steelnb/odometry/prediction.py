"""Prediction of the pose of each scan, and the cost of a pose's distance from it; shared by all odometries."""

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.fusion.poses import DRIFT_PERIOD_S, tilt_decay
from steelnb.odometry.inertial_prediction import NONE, InertialPrediction, information_at
from steelnb.registration import Term, prior_term
from steelnb.settings import ImuSettings
from steelnb.types import Array, Imu

DRIFT_GAIN = 0.05
"""Gain of the filter of the drift's rate. Chosen on the development seeds 11 and 12."""
PRIOR_SIGMA = 0.05, 0.02
"""Standard deviations of a correction by segments or by image features from its prediction, metres and radians. Chosen
on the development seeds 11 and 12."""


class Prediction:
    """Alpha-beta filter of the correction of a drifting prior, with alpha = 1 and beta = `DRIFT_GAIN`.

    The correction turns the drone about itself and then moves it, both in the world frame. With ``follow``, the filter
    estimates the rate of the drift and predicts with it; without, it predicts the last correction. A solver that starts
    behind the drift stops a little behind it in every frame. The map keeps these errors, and under a constant drift
    they add up. After a scan that was not registered, the rate is not used.

    If ``tilt_sigma_rad`` is above 0, the prior's roll and pitch have errors: a Gauss-Markov process with that standard
    deviation and the correlation time `fusion.poses.TILT_S`. Their correction decays and has no rate.
    """

    def __init__(self, follow: bool, tilt_sigma_rad: float = 0.0) -> None:
        self.gain, self.tilt_sigma_rad = DRIFT_GAIN if follow else 0.0, tilt_sigma_rad
        self.offset, self.turn = np.zeros(3), np.eye(3)
        self.offset_rate, self.turn_rate = np.zeros(3), np.zeros(3)
        self._followed = False

    def pose(self, T_world_drone_prior: Array, passed_s: float = DRIFT_PERIOD_S) -> Array:
        """The pose ``(4, 4)`` at which the registration of a scan starts, ``passed_s`` after the one before."""
        turn, offset = self.turn, self.offset
        if self._followed:
            turn, offset = Rotation.from_rotvec(self.turn_rate).as_matrix() @ turn, offset + self.offset_rate
        if self.tilt_sigma_rad:
            upright = np.cross(turn[:, 2], (0.0, 0.0, 1.0))  # the rotation that undoes the correction of the tilt
            turn = Rotation.from_rotvec((1.0 - tilt_decay(passed_s)) * upright).as_matrix() @ turn
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turn @ T_world_drone_prior[:3, :3], T_world_drone_prior[:3, 3] + offset
        return T

    def correct(self, T_world_drone: Array, T_world_drone_prior: Array, unobserved: Array = NONE) -> None:
        """Update with the pose of a registered scan. ``unobserved (u, 3)``: unit vectors along which the pose is the
        predicted one, so the rate of the drift is unknown."""
        turn = T_world_drone[:3, :3] @ T_world_drone_prior[:3, :3].T
        offset = T_world_drone[:3, 3] - T_world_drone_prior[:3, 3]
        if self._followed:  # a jump after a gap is no rate
            self.offset_rate = self.offset_rate + self.gain * (offset - self.offset - self.offset_rate)
            turned = Rotation.from_matrix(turn @ self.turn.T, assume_valid=True).as_rotvec()
            self.turn_rate = self.turn_rate + self.gain * (turned - self.turn_rate)
            if self.tilt_sigma_rad:
                self.turn_rate[:2] = 0.0
        self.offset_rate = self.offset_rate - unobserved.T @ (unobserved @ self.offset_rate)
        self.turn, self.offset, self._followed = turn, offset, True

    def lose(self) -> None:
        """Update with a scan that was not registered."""
        self._followed = False


class PosePredictor:
    """Predicts from an IMU if its ``noise`` is known, else from the drifting prior and the rate of its drift.

    `pose` may be called repeatedly; `correct` or `lose` ends the scan.

    Parameters
    ----------
    prior_sigma, tilt_sigma_rad, noise : the ``prior_sigma``, ``tilt_sigma_rad`` and ``inertial`` of the settings.
    imu : readings in the drone frame, up to the current scan.
    """

    def __init__(
        self, prior_sigma: tuple[float, float] | None, tilt_sigma_rad: float = 0.0, noise: ImuSettings | None = None,
        imu: Imu | None = None,
    ) -> None:  # fmt: skip
        self.drift = Prediction(prior_sigma is not None, tilt_sigma_rad)
        self.inertial = InertialPrediction(imu, noise) if noise is not None and imu is not None else None
        self.tilted = tilt_sigma_rad > 0 or self.inertial is not None  # roll and pitch are estimated, too
        self._information: Array | None = None  # of the prediction by the drift, (6, 6), rotation first
        if prior_sigma is not None:
            sigma_m, sigma_rad = prior_sigma
            self._information = np.diag([sigma_rad**-2.0] * 3 + [sigma_m**-2.0] * 3)
        self._last_s = self._current_s = np.nan  # stamps of the last scan and of the predicted one

    @property
    def known(self) -> bool:
        """Whether the prediction has a stated uncertainty."""
        return self.inertial is not None or self._information is not None

    def pose(self, stamp_s: float, prior: Array) -> Array:
        """The predicted pose ``(4, 4)`` of the drone at a scan with the drifting pose ``prior``. The information about
        roll and pitch follows from the time since the last scan."""
        self._current_s = stamp_s
        if self.inertial:
            return self.inertial.pose(prior, stamp_s)
        passed_s = stamp_s - self._last_s
        passed_s = passed_s if passed_s > 0 else DRIFT_PERIOD_S  # the first scan, and scans without stamps
        if self.drift.tilt_sigma_rad and self._information is not None:
            changed = 1.0 - tilt_decay(2.0 * passed_s)  # share of the variance of the prior's roll and pitch
            self._information[[0, 1], [0, 1]] = 1.0 / float(self.drift.tilt_sigma_rad**2 * changed)
        return self.drift.pose(prior, passed_s)

    def terms(self, T_predicted: Array, points: Array) -> list[Term]:
        """The cost of the distance from the predicted pose: of the rotation and of the shift of the mean of ``points
        (N, 3)``, drone frame. Empty if the prediction has no stated uncertainty."""
        if self.inertial:
            return [self.inertial.term()]
        return [] if self._information is None else [prior_term(self._information, T_predicted, points)]

    def correct(
        self, T_world_drone: Array, prior: Array, unobserved: Array = NONE, information: Array | None = None
    ) -> None:
        """Update with the pose of a registered scan. ``unobserved (u, 3)``: unit vectors along which it is the
        predicted one. ``information (6, 6)`` about rotation and position of the drone is that of scan and prediction
        together; only the prediction by the IMU uses it."""
        self._last_s = self._current_s
        if self.inertial:
            self.inertial.correct(T_world_drone, np.zeros((6, 6)) if information is None else information, unobserved)
        else:
            self.drift.correct(T_world_drone, prior, unobserved)

    def lose(self) -> None:
        """Update with a scan that was not registered."""
        self._last_s = self._current_s
        (self.inertial or self.drift).lose()

    def information_of(self, H: Array, T_world_drone: Array, centre: Array) -> Array:
        """Information ``(6, 6)`` about rotation and position of the drone from the normal matrix ``H (6, 6)`` of a
        solve, for twists about a ``centre (3,)``. Zero without an IMU, since only its prediction uses it."""
        return information_at(H, T_world_drone[:3, 3] - centre) if self.inertial else np.zeros((6, 6))
