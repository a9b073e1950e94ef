"""Prediction of the pose of a scan from an IMU: an error-state Kalman filter that registrations correct.

Readings since the last scan are integrated from its pose, velocity and biases (`fusion.adjustment.imu_factors`). The
increment of the drifting prior, in position and yaw, is a measurement of the same motion. The predicted pose enters the
registration with its covariance, and the registered pose corrects velocity and biases, too. Roll and pitch thus come
from gravity over the whole flight, not from the prior. A scan with little information follows the readings.

Registrations to one map share errors: those of the map, and those that depend on the view. If each counted as a
measurement of its own, the filter would claim 2 mm where it is off by 40. So a registered pose is the true one moved
by a `LastingError`, which is a state, too. A map never tells its own lean and heading, so this part of the error stays
from map to map: if it faded, each map would count as a new measurement of the vertical.

Sources: Solà, "Quaternion kinematics for the error-state Kalman filter" (arXiv 1711.02508, 2017), with errors in the
world frame; Roumeliotis and Burdick, "Stochastic cloning" (ICRA 2002), for increments, which depend on two poses.
"""

from typing import NamedTuple

import numpy as np

from steelnb.core.geometry import (
    POSE_DOF,
    cross_matrix,
    information_at,
    moved_poses,
    pose_difference,
    twist_jacobian,
    yaw_of,
)
from steelnb.core.types import GRAVITY, Array, Imu
from steelnb.fusion.adjustment.factors import DRIFT_PERIOD_S, FIXED, TILT_SIGMA_RAD, drift_variance
from steelnb.fusion.adjustment.imu_factors import (
    BIAS,
    FORCE,
    GYRO,
    INTEGRATED,
    POSE,
    POSITION,
    ROTATION,
    SIGMA_MIN,
    STATE_DOF,
    VELOCITY,
    gaps,
    integrated,
    integration_covariances,
)
from steelnb.odometry.prediction import NO_ERROR, DriftPrediction, LastingError, Prediction, RegisteredPose
from steelnb.odometry.standstill import REST_MIN_S, after_rest, find_rest, prior_rests
from steelnb.registration import Term
from steelnb.settings import ImuSettings

FILTER_DOF = STATE_DOF + POSE_DOF
ERROR = slice(STATE_DOF, FILTER_DOF)
"""The order of errors here: those of `imu_factors`, then the lasting error of registrations, rotation and position."""
TURN, SHIFT = (slice(STATE_DOF + part.start, STATE_DOF + part.stop) for part in (ROTATION, POSITION))
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


VELOCITY_SIGMA_M_S, ROTATION_SIGMA_RAD = 10.0, 0.01
"""Standard deviations without readings: of the velocity, and of the prior's rotation between two scans."""


LEAN_SIGMA_RAD = 3e-5
"""Standard deviation of the first map's roll and pitch about those of the prior, so that both stay invertible."""


class InertialPrediction:
    """Predicts the pose of each scan from the readings of an ``imu``; ``noise`` is that of its data sheet."""

    known = tilted = True

    def __init__(self, imu: Imu, noise: ImuSettings) -> None:
        self.imu, self.noise = imu, noise
        self.state: State | None = None  # at the last scan
        self.predicted: State | None = None  # for the current scan
        self.first: State | None = None  # at the first scan, as long as the drone may rest

    def pose(self, prior: Array, stamp_s: float, lasting: LastingError = NO_ERROR) -> Array:
        """The pose ``(4, 4)`` that a registration with a ``lasting`` error is expected to give at a scan with the
        drifting pose ``prior``; at the first scan, the prior itself."""
        if self.state is None:
            self.first = self.predicted = self._started(prior, stamp_s, lasting)
            return self.predicted.T_registered
        self.predicted = self._rested(prior, stamp_s, lasting)
        if self.predicted is None:
            old = self.state if self.state.lasting == lasting else self.state.on_another_map(lasting)
            self.predicted = self._propagated(old, prior, stamp_s)
        return self.predicted.T_registered

    @property
    def information(self) -> Array:
        """Information ``(6, 6)`` about rotation and position of the drone in the predicted pose."""
        assert self.predicted is not None
        return np.asarray(np.linalg.inv(self.predicted.registered_covariance))

    def terms(self, T_predicted: Array, points: Array) -> list[Term]:
        """½ ‖rotation and shift of the drone from the predicted pose‖² in the metric of its information."""
        information = self.information

        def cost(T: Array, centre: Array) -> tuple[Array, Array, float]:
            error, by_twist = pose_difference(T_predicted, T), twist_jacobian(T[:3, 3] - centre)
            weighted = information @ error
            return by_twist.T @ information @ by_twist, by_twist.T @ weighted, 0.5 * float(error @ weighted)

        return [cost]

    def correct(self, registered: RegisteredPose) -> None:
        """Update with the maximum a posteriori pose of a registered scan."""
        T_world_drone, unobserved, H, arm = registered
        observed, predicted = np.eye(6), self.information
        observed[3:, 3:] -= unobserved.T @ unobserved
        added = observed @ (information_at(H, arm) - predicted) @ observed
        self.lose()
        assert self.state is not None
        P, before = self.state.covariance, self.state.registered_covariance
        gain = np.linalg.solve(before, seen(P)).T  # of all errors, from those of the registered pose
        step = gain @ pose_difference(self.state.T_registered, T_world_drone)
        P = P + gain @ (np.linalg.inv(predicted + added) - before) @ gain.T
        error = self.state.error + step[ERROR]
        self.state = self.state._replace(
            T_world_drone=moved_poses(T_world_drone[None], -error[None])[0],
            velocity=self.state.velocity + step[VELOCITY], bias=self.state.bias + step[BIAS], error=error,
            covariance=0.5 * (P + P.T),
        )  # fmt: skip

    def levelled(self, T_world_drone: Array) -> Array:
        """The registered pose ``(4, 4)`` of the last scan with roll and pitch from gravity: a map may lean."""
        assert self.state is not None
        tilt = self.state.error * [1.0, 1.0, 0.0, 0.0, 0.0, 0.0]
        return moved_poses(T_world_drone[None], -tilt[None])[0]

    def covariance(self, T_world_drone: Array) -> Array:
        """The ``covariance`` of an `OdometryStep` with this pose ``(4, 4)`` for the last scan: that of the state's
        pose, and the square of the step from there, such as the lasting error."""
        assert self.state is not None
        step = pose_difference(self.state.T_world_drone, T_world_drone)
        return np.roll(self.state.covariance[POSE, POSE] + np.outer(step, step), 3, axis=(0, 1))

    def lose(self) -> None:
        """Update with a scan that was not registered: continue from its prediction."""
        self.state = self.predicted

    def adjust(self, T_correction: Array, variance: Array) -> None:
        """Move map and registered pose by ``T_correction (4, 4)``, world frame, whose errors have a ``variance (6,)``
        of rotation and position."""
        assert self.state is not None
        self.state = self.state.on_a_moved_map(T_correction, variance)

    def _started(self, prior: Array, stamp_s: float, lasting: LastingError) -> State:
        variance = np.zeros(FILTER_DOF)
        variance[POSE] = [TILT_SIGMA_RAD**2] * 2 + [1 / FIXED] * 4
        variance[VELOCITY] = VELOCITY_SIGMA_M_S**2
        variance[GYRO] = max(self.noise.gyro_bias, SIGMA_MIN) ** 2
        variance[FORCE] = max(self.noise.accelerometer_bias, SIGMA_MIN) ** 2
        P = np.diag(variance)
        if lasting != NO_ERROR:
            # The first map leans as the prior does: registrations to it do not tell the vertical.
            lean = np.array([0, 1])
            P[lean, ERROR.start + lean] = P[ERROR.start + lean, lean] = -(TILT_SIGMA_RAD**2)
            P[ERROR.start + lean, ERROR.start + lean] = TILT_SIGMA_RAD**2 + LEAN_SIGMA_RAD**2
        return State(stamp_s, prior, prior, np.zeros(3), np.zeros(6), np.zeros(6), P, lasting)

    def _rested(self, prior: Array, stamp_s: float, lasting: LastingError) -> State | None:
        """The state after a rest since the first scan; None if it is too short, or once the drone has moved."""
        first = self.first
        if first is None or stamp_s - first.stamp_s < REST_MIN_S - 1e-6:
            return None
        rest = find_rest(self.imu, self.noise, first.stamp_s, stamp_s)
        if rest is None or not prior_rests(first.prior, prior, stamp_s - first.stamp_s):
            self.first = None
            return None
        step, P = after_rest(rest, self.noise, first.T_world_drone[:3, :3], first.covariance)
        T_world_drone = moved_poses(first.T_world_drone[None], step[None, POSE])[0]
        state = State(stamp_s, prior, T_world_drone, np.zeros(3), step[BIAS], step[ERROR], P, first.lasting)
        return state if lasting == first.lasting else state.on_another_map(lasting)

    def _propagated(self, old: State, prior: Array, stamp_s: float) -> State:
        passed_s = stamp_s - old.stamp_s
        has_readings = passed_s > 0 and not gaps(self.imu.stamp_s, np.array([old.stamp_s, stamp_s]))[0]
        passed_s = passed_s if passed_s > 0 else DRIFT_PERIOD_S  # scans without stamps
        # The prior's increment, in the frame of the earlier pose.
        turned = old.T_world_drone[:3, :3] @ old.prior[:3, :3].T
        expected = turned @ (prior[:3, 3] - old.prior[:3, 3])
        T, velocity, F, Q = (
            self._integrated(old, stamp_s) if has_readings else self._followed(old, prior, expected, passed_s)
        )
        decay = np.exp(-passed_s / old.lasting.time_s)
        kept = np.array([1.0, 1.0, 1.0, decay, decay, decay])
        F[ERROR, ERROR] = np.diag(kept)
        Q[ERROR, ERROR] = (1.0 - decay**2) * np.diag(old.lasting.variance)
        cross = F @ old.covariance
        joint = np.block([[old.covariance, cross.T], [cross, cross @ F.T + Q]])  # of the earlier and the later state
        error = np.append(
            yaw_of(T[:3, :3] @ (turned @ prior[:3, :3]).T), T[:3, 3] - old.T_world_drone[:3, 3] - expected
        )
        H_old, H_new = np.zeros((2, 4, FILTER_DOF))
        H_new[0, 2], H_old[0, 2] = 1.0, -1.0
        H_new[1:, POSITION], H_old[1:, POSITION] = np.eye(3), -np.eye(3)
        H_old[1:3, 2] = expected[1], -expected[0]
        H = np.hstack([H_old, H_new])
        drift = np.diag(drift_variance(passed_s))
        gain = np.linalg.solve(H @ joint @ H.T + drift, H @ joint).T
        step = -(gain @ error)[FILTER_DOF:]
        P = (joint - gain @ H @ joint)[FILTER_DOF:, FILTER_DOF:]
        T_world_drone = moved_poses(T[None], step[None, POSE])[0]
        return State(
            stamp_s, prior, T_world_drone, velocity + step[VELOCITY], old.bias + step[BIAS],
            kept * old.error + step[ERROR], 0.5 * (P + P.T), old.lasting,
        )  # fmt: skip

    def _integrated(self, old: State, stamp_s: float) -> tuple[Array, Array, Array, Array]:
        """Pose and velocity by the readings, the Jacobian ``(N, N)`` of the errors with respect to those of the old
        state, and the covariance of the noise."""
        passed_s, R = stamp_s - old.stamp_s, old.T_world_drone[:3, :3]
        imu, stamps_s = self.imu, np.array([old.stamp_s, stamp_s])
        read = integrated(imu.stamp_s, imu.specific_force, imu.angular_rate, stamps_s, old.bias[None])
        by_force, shift = R @ read.velocity[0], R @ read.position[0]
        by_gravity = np.array([0.0, 0.0, -GRAVITY]) * passed_s
        T = np.eye(4)
        T[:3, :3] = R @ read.rotation[0]
        T[:3, 3] = old.T_world_drone[:3, 3] + passed_s * (old.velocity + 0.5 * by_gravity) + shift
        F, Q = np.eye(len(old.covariance)), np.zeros(old.covariance.shape)
        F[ROTATION, GYRO] = F[VELOCITY, FORCE] = -passed_s * R
        F[POSITION, VELOCITY], F[POSITION, FORCE] = passed_s * np.eye(3), -0.5 * passed_s**2 * R
        force_cross, shift_cross = cross_matrix(by_force), cross_matrix(shift)
        F[VELOCITY, ROTATION], F[POSITION, ROTATION] = -force_cross, -shift_cross
        F[VELOCITY, GYRO], F[POSITION, GYRO] = passed_s / 2 * force_cross @ R, passed_s / 3 * shift_cross @ R
        Q[np.ix_(INTEGRATED, INTEGRATED)] = integration_covariances(self.noise, np.array([passed_s]))[0]
        walk = np.maximum([self.noise.gyro_walk, self.noise.accelerometer_walk], SIGMA_MIN) ** 2 * passed_s
        Q[BIAS, BIAS] = np.diag(np.repeat(walk, 3))
        return T, old.velocity + by_gravity + by_force, F, Q

    def _followed(
        self, old: State, prior: Array, expected: Array, passed_s: float
    ) -> tuple[Array, Array, Array, Array]:
        """The same from the prior, if readings are missing. Its shift gets a sigma of 1 m, as it is also measured."""
        F, Q = np.eye(len(old.covariance)), np.zeros(old.covariance.shape)
        T = old.T_world_drone.copy()
        T[:3, :3] = T[:3, :3] @ old.prior[:3, :3].T @ prior[:3, :3]
        T[:3, 3] += expected
        F[VELOCITY, VELOCITY] = 0.0
        Q[ROTATION, ROTATION], Q[POSITION, POSITION] = ROTATION_SIGMA_RAD**2 * np.eye(3), np.eye(3)
        Q[VELOCITY, VELOCITY] = VELOCITY_SIGMA_M_S**2 * np.eye(3)
        return T, expected / passed_s, F, Q


def make_prediction(
    prior_sigma: tuple[float, float] | None, tilt_sigma_rad: float, noise: ImuSettings | None, imu: Imu | None
) -> Prediction:
    """Prediction from the readings of an ``imu`` if its ``noise`` is known, else from the drifting prior."""
    if noise is not None and imu is not None:
        return InertialPrediction(imu, noise)
    return DriftPrediction(prior_sigma, tilt_sigma_rad)
