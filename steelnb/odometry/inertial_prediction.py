"""Prediction of the pose of a scan from an IMU: an error-state Kalman filter that registrations correct.

From the pose, velocity and biases at the scan before, the readings since then are integrated (`fusion.inertial`); the
increment of the drifting prior, position and yaw, is a measurement of the same motion. The predicted pose comes with a
covariance, by which it counts beside the scan, and what the registration finds corrects velocity and biases, too. So
roll and pitch are those that gravity told over the whole flight, not the prior's, and a scan that says little follows
the readings. Sources: Solà, "Quaternion kinematics for the error-state Kalman filter" (arXiv 1711.02508, 2017), with
errors in the axes of the world; Roumeliotis and Burdick, "Stochastic cloning" (ICRA 2002), for the increments, which
two poses share.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.fusion.inertial import SIGMA_MIN, TILT_SIGMA_RAD, gaps, integrated, integration_covariances
from steelnb.fusion.poses import DRIFT_PERIOD_S, DRIFT_SIGMA, FIXED, yaw_of
from steelnb.registration import Term
from steelnb.settings import ImuSettings
from steelnb.types import GRAVITY, Array, Imu

NONE = np.zeros((0, 3))
"""No directions."""
TURN, PLACE, SPEED, GYRO, FORCE = (slice(k, k + 3) for k in range(0, 15, 3))
POSE, BIAS, SIZE = slice(0, 6), slice(9, 15), 15
"""Where the errors of a state are: turn, rad, place, m, and velocity, m/s, in the axes of the world, and the biases of
gyroscope, rad/s, and accelerometer, m/s², in those of the drone."""
SCAN_SHARE = 1 / 3
"""Share of a registration's information that counts: scan after scan is laid on the same map, whose errors it takes
over, so registrations are not independent. Chosen on the development seeds 11 to 13 of the honest sensor, both flights,
among 1, 1/3, 1/10 and 1/30."""
SPEED_SIGMA_M_S, TURN_SIGMA_RAD = 10.0, 0.01
"""Standard deviations where no reading tells them: of the velocity, and of the prior's turn between two scans."""


class State(NamedTuple):
    """Pose ``T_world_drone (4, 4)``, velocity ``speed (3,)`` in the world, ``bias (6,)`` of gyroscope and accelerometer
    and the ``covariance (15, 15)`` of their errors, at ``stamp_s``; the drifting pose ``prior (4, 4)`` then."""

    stamp_s: float
    prior: Array
    T_world_drone: Array
    speed: Array
    bias: Array
    covariance: Array


class InertialPrediction:
    """Predicts the pose of each scan from the readings of an ``imu``; ``noise`` is that of its data sheet.

    `pose` does not change the state, `correct` or `lose` does: a prediction may be asked for more than once.
    """

    def __init__(self, imu: Imu, noise: ImuSettings) -> None:
        self.imu, self.noise = imu, noise
        self.state: State | None = None  # at the last scan
        self.ahead: State | None = None  # predicted for the scan at hand

    def pose(self, prior: Array, stamp_s: float) -> Array:
        """The pose ``(4, 4)`` of the drone at a scan whose drifting pose is ``prior``: that one, at the first scan."""
        self.ahead = (
            self._started(prior, stamp_s) if self.state is None else self._propagated(self.state, prior, stamp_s)
        )
        return self.ahead.T_world_drone

    @property
    def information(self) -> Array:
        """That about turn and place of the drone in the pose predicted ``(6, 6)``, in the units of a registration's."""
        assert self.ahead is not None
        return np.asarray(np.linalg.inv(self.ahead.covariance[POSE, POSE]) / SCAN_SHARE)

    def term(self) -> Term:
        """½ ‖turn and shift of the drone from the pose predicted‖² in the metric of its information."""
        assert self.ahead is not None
        T_init, information = self.ahead.T_world_drone, self.information

        def cost(T: Array, centre: Array) -> tuple[Array, Array, float]:
            apart, by_twist = _apart(T_init, T), _by_twist(T[:3, 3] - centre)
            weighed = information @ apart
            return by_twist.T @ information @ by_twist, by_twist.T @ weighed, 0.5 * float(apart @ weighed)

        return cost

    def correct(self, T_world_drone: Array, information: Array, unobserved: Array = NONE) -> None:
        """Update with the most likely pose of a registered scan, about whose turn and place prediction and registration
        together had the ``information (6, 6)``. Along ``unobserved (u, 3)``, unit vectors, the pose is the
        prediction's."""
        seen = np.eye(6)
        seen[3:, 3:] -= unobserved.T @ unobserved
        registered = SCAN_SHARE * seen @ (information - self.information) @ seen
        self.lose()
        assert self.state is not None
        P = self.state.covariance
        before = P[POSE, POSE]
        gain = np.linalg.solve(before, P[POSE]).T  # of all errors, where those of the pose are found
        step = gain @ _apart(self.state.T_world_drone, T_world_drone)
        P = P + gain @ (np.linalg.inv(np.linalg.inv(before) + registered) - before) @ gain.T
        self.state = self.state._replace(
            T_world_drone=T_world_drone, speed=self.state.speed + step[SPEED], bias=self.state.bias + step[BIAS],
            covariance=0.5 * (P + P.T),
        )  # fmt: skip

    def lose(self) -> None:
        """Update with a scan that was not registered: go on from its prediction."""
        self.state = self.ahead

    def move(self, moved: Array, variance: Array) -> None:
        """Go on in a world that ``moved (4, 4)``, which adds a ``variance (6,)`` of turn and place of the drone."""
        assert self.state is not None
        P = self.state.covariance.copy()
        P[range(6), range(6)] += variance
        self.state = self.state._replace(
            T_world_drone=moved @ self.state.T_world_drone, speed=moved[:3, :3] @ self.state.speed, covariance=P
        )

    def _started(self, prior: Array, stamp_s: float) -> State:
        variance = np.zeros(SIZE)
        variance[POSE] = [TILT_SIGMA_RAD**2] * 2 + [1 / FIXED] * 4
        variance[SPEED] = SPEED_SIGMA_M_S**2
        variance[GYRO] = max(self.noise.gyro_bias, SIGMA_MIN) ** 2
        variance[FORCE] = max(self.noise.accelerometer_bias, SIGMA_MIN) ** 2
        return State(stamp_s, prior, prior, np.zeros(3), np.zeros(6), np.diag(variance))

    def _propagated(self, old: State, prior: Array, stamp_s: float) -> State:
        passed_s = stamp_s - old.stamp_s
        seen = passed_s > 0 and not gaps(self.imu.stamp_s, np.array([old.stamp_s, stamp_s]))[0]
        passed_s = passed_s if passed_s > 0 else DRIFT_PERIOD_S  # scans without stamps
        # The prior's increment, in the frame of the earlier pose.
        turned = old.T_world_drone[:3, :3] @ old.prior[:3, :3].T
        expected = turned @ (prior[:3, 3] - old.prior[:3, 3])
        T, speed, F, Q = self._integrated(old, stamp_s) if seen else self._followed(old, prior, expected, passed_s)
        ahead = F @ old.covariance
        both = np.block([[old.covariance, ahead.T], [ahead, ahead @ F.T + Q]])  # of the earlier and the later state
        error = np.append(
            T[:3, 3] - old.T_world_drone[:3, 3] - expected, yaw_of(T[:3, :3] @ (turned @ prior[:3, :3]).T)
        )
        by_old, by_new = np.zeros((2, 4, SIZE))
        by_new[:3, PLACE], by_old[:3, PLACE] = np.eye(3), -np.eye(3)
        by_new[3, 2], by_old[3, 2] = 1.0, -1.0
        by_old[:2, 2] = expected[1], -expected[0]
        by = np.hstack([by_old, by_new])
        drift = np.diag(DRIFT_SIGMA**2) * passed_s / DRIFT_PERIOD_S
        gain = np.linalg.solve(by @ both @ by.T + drift, by @ both).T
        step, P = -(gain @ error)[SIZE:], (both - gain @ by @ both)[SIZE:, SIZE:]
        moved = T.copy()
        moved[:3, :3] = Rotation.from_rotvec(step[TURN]).as_matrix() @ T[:3, :3]
        moved[:3, 3] += step[PLACE]
        return State(stamp_s, prior, moved, speed + step[SPEED], old.bias + step[BIAS], 0.5 * (P + P.T))

    def _integrated(self, old: State, stamp_s: float) -> tuple[Array, Array, Array, Array]:
        """Pose and velocity by the readings, the derivative ``(15, 15)`` of their errors by those of the old state, and
        the covariance that is added."""
        passed_s, R = stamp_s - old.stamp_s, old.T_world_drone[:3, :3]
        read = integrated(self.imu, np.array([old.stamp_s, stamp_s]), old.bias[None])
        gained, gone = R @ read.velocity[0], R @ read.place[0]
        fallen = np.array([0.0, 0.0, -GRAVITY]) * passed_s
        T = np.eye(4)
        T[:3, :3] = R @ read.turn[0]
        T[:3, 3] = old.T_world_drone[:3, 3] + passed_s * (old.speed + 0.5 * fallen) + gone
        F, Q = np.eye(SIZE), np.zeros((SIZE, SIZE))
        F[TURN, GYRO] = F[SPEED, FORCE] = -passed_s * R
        F[PLACE, SPEED], F[PLACE, FORCE] = passed_s * np.eye(3), -0.5 * passed_s**2 * R
        F[SPEED, TURN], F[PLACE, TURN] = -_cross(gained), -_cross(gone)
        F[SPEED, GYRO], F[PLACE, GYRO] = passed_s / 2 * _cross(gained) @ R, passed_s / 3 * _cross(gone) @ R
        order = [0, 1, 2, 6, 7, 8, 3, 4, 5]  # of rotation, velocity and place
        Q[:9, :9] = integration_covariances(self.noise, np.array([passed_s]))[0][np.ix_(order, order)]
        walk = np.maximum([self.noise.gyro_walk, self.noise.accelerometer_walk], SIGMA_MIN) ** 2 * passed_s
        Q[BIAS, BIAS] = np.diag(np.repeat(walk, 3))
        return T, old.speed + fallen + gained, F, Q

    def _followed(
        self, old: State, prior: Array, expected: Array, passed_s: float
    ) -> tuple[Array, Array, Array, Array]:
        """The same by the prior's increment, where readings are missing: its shift counts as a measurement."""
        F, Q = np.eye(SIZE), np.zeros((SIZE, SIZE))
        T = old.T_world_drone.copy()
        T[:3, :3] = T[:3, :3] @ old.prior[:3, :3].T @ prior[:3, :3]
        T[:3, 3] += expected
        F[SPEED, SPEED] = 0.0
        Q[TURN, TURN], Q[PLACE, PLACE] = TURN_SIGMA_RAD**2 * np.eye(3), np.eye(3)
        Q[SPEED, SPEED] = SPEED_SIGMA_M_S**2 * np.eye(3)
        return T, expected / passed_s, F, Q


def information_at(information: Array, arm: Array) -> Array:
    """Information ``(6, 6)`` about a turn and the shift of a point, as that about the shift of the point which lies
    ``arm (3,)`` from it."""
    back = _by_twist(-arm)
    return np.asarray(back.T @ information @ back)


def _by_twist(arm: Array) -> Array:
    """Derivative ``(6, 6)`` of turn and shift of a point that lies ``arm (3,)`` from the centre of a twist."""
    by_twist = np.eye(6)
    by_twist[3:, :3] = -_cross(arm)
    return by_twist


def _cross(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _apart(T_from: Array, T_to: Array) -> Array:
    """Turn in the axes of the world and shift ``(6,)`` from one pose to another."""
    turned = Rotation.from_matrix(T_to[:3, :3] @ T_from[:3, :3].T, assume_valid=True).as_rotvec()
    return np.append(turned, T_to[:3, 3] - T_from[:3, 3])
