"""Inertial factors of an adjustment (`adjustment.problem`): velocities and IMU biases as states beside the poses.

The readings between two scans are preintegrated: the result does not depend on the pose and velocity before them. They
determine the vertical and the scale, which bars and a drifting prior do not. Source: Forster, Carlone, Dellaert,
Scaramuzza, "On-manifold preintegration for real-time visual-inertial odometry" (T-RO 33, 2017). Here, Jacobians are
numerical, and each step integrates again; the source instead corrects for the bias to first order.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.core.geometry import POSE_DOF, moved_poses
from steelnb.core.kernels import njit
from steelnb.core.types import GRAVITY, Array, Imu, Trajectory
from steelnb.settings import ImuSettings

STATE_DOF = 15
ROTATION, POSITION, VELOCITY, GYRO, FORCE = (slice(k, k + 3) for k in range(0, STATE_DOF, 3))
POSE, BIAS = slice(0, POSE_DOF), slice(9, STATE_DOF)
"""The order of a state, here and in `odometry.inertial`: rotation (rad), position (m) and velocity (m/s) in the world
frame, biases of the gyroscope (rad/s) and the accelerometer (m/s²) in the drone frame."""
INTEGRATED = np.r_[ROTATION, VELOCITY, POSITION]
"""The order in which readings are integrated, as in the source: that of `Inertial.errors` and their covariances."""
NO_STEP = np.zeros(STATE_DOF)
VELOCITY_SIGMA_M_S = 100.0
"""Prior standard deviation of each velocity, so large that it has no effect."""
SIGMA_MIN = 1e-7
"""Minimum noise density and minimum standard deviation of a bias, for a noise-free IMU."""
GAP_MAX_S = 0.1
"""Maximum time between two readings. An interval with a longer gap has no factor."""
STEP = 1e-5
"""Step of the numerical Jacobians."""


class ChainEquations(NamedTuple):
    """Normal equations of a chain of K states with D degrees of freedom: information ``matrix (K, D, D)`` and
    ``vector (K, D)`` of each state, and the block ``beside (K − 1, D, D)`` between each state and the next."""

    matrix: Array
    beside: Array
    vector: Array


def chain_equations(
    state_error: Array, state_weight: Array, error: Array, weight: Array, before: Array, after: Array
) -> ChainEquations:
    """Normal equations of factors on single states and between neighbours.

    Each state has errors ``(K, D)`` with information ``(K, D)``. Between each state and the next, there are errors
    ``(K − 1, D)`` with information ``weight (K − 1, D, D)``; ``before`` and ``after (K − 1, D, D)`` are their Jacobians
    with respect to the earlier and the later state.
    """
    matrix, vector = state_weight[:, :, None] * np.eye(state_error.shape[1]), -state_weight * state_error
    earlier, later = before.transpose(0, 2, 1) @ weight, after.transpose(0, 2, 1) @ weight
    for at, weighted, jacobian in ((slice(None, -1), earlier, before), (slice(1, None), later, after)):
        matrix[at] += weighted @ jacobian
        vector[at] -= (weighted @ error[:, :, None])[:, :, 0]
    return ChainEquations(matrix, earlier @ after, vector)


class Integrated(NamedTuple):
    """Readings integrated between K scans, in the frame of the earlier one: ``rotation (K − 1, 3, 3)``, and the changes
    of ``velocity (K − 1, 3)``, m/s, and ``position (K − 1, 3)``, metres. Gravity is left out, and so is the motion with
    the initial velocity."""

    rotation: Array
    velocity: Array
    position: Array


@dataclass(frozen=True)
class Inertial:
    """The IMU factors of an adjustment of K scans at ``stamp_s (K,)``.

    ``motion (K, 9)``: velocity in the world, m/s, and biases of gyroscope, rad/s, and accelerometer, m/s²;
    ``information (K, 9)``: of their zero-mean prior; ``weight (K − 1, 15, 15)``: information of the `errors`
    between scans; ``T_drone_sensor (4, 4)``: the sensor's mount.
    """

    imu: Imu
    T_drone_sensor: Array
    stamp_s: Array
    motion: Array
    information: Array
    weight: Array

    @classmethod
    def started(cls, imu: Imu, noise: ImuSettings, T_drone_sensor: Array, trajectory: Trajectory) -> "Inertial":
        """Start with the velocities of a trajectory at the scans and zero biases; ``noise``: from the data sheet."""
        stamp_s, gap_s = trajectory.stamp_s, np.diff(trajectory.stamp_s)
        motion, information = np.zeros((2, len(stamp_s), 9))
        if len(stamp_s) > 1:
            motion[:, :3] = np.gradient(trajectory.position, stamp_s, axis=0)
        information[:, :3] = VELOCITY_SIGMA_M_S**-2.0
        information[0, 3:] = np.repeat(np.maximum([noise.gyro_bias, noise.accelerometer_bias], SIGMA_MIN) ** -2.0, 3)
        walk = np.maximum([noise.gyro_walk, noise.accelerometer_walk], SIGMA_MIN) ** -2.0
        weight = np.zeros((len(gap_s), STATE_DOF, STATE_DOF))
        has_readings = ~gaps(imu.stamp_s, stamp_s)
        weight[has_readings, :9, :9] = np.linalg.inv(integration_covariances(noise, gap_s[has_readings]))
        weight[:, range(9, STATE_DOF), range(9, STATE_DOF)] = np.repeat(walk, 3) / gap_s[:, None]
        return cls(imu, T_drone_sensor, stamp_s, motion, information, weight)

    def moved(self, step: Array) -> "Inertial":
        """After steps ``(K, 15)`` of the states."""
        return replace(self, motion=self.motion + step[:, POSE_DOF:])

    def rotated(self, rotation: Array) -> "Inertial":
        """In a world frame that is rotated by ``(3, 3)``."""
        return replace(self, motion=np.hstack([self.motion[:, :3] @ rotation.T, self.motion[:, 3:]]))

    def equations(self, T_world_sensor: Array) -> ChainEquations:
        """The normal equations of the states, D = 15, at poses of the sensor ``(K, 4, 4)``."""
        before = _jacobian(lambda step: self.errors(T_world_sensor, before=step))
        after = _jacobian(lambda step: self.errors(T_world_sensor, after=step))
        state_error, state_weight = (np.pad(each, ((0, 0), (POSE_DOF, 0))) for each in (self.motion, self.information))
        return chain_equations(state_error, state_weight, self.errors(T_world_sensor), self.weight, before, after)

    def errors(self, T_world_sensor: Array, before: Array = NO_STEP, after: Array = NO_STEP) -> Array:
        """Errors ``(K − 1, 15)`` between poses of the sensor ``(K, 4, 4)``: three each of rotation, rad, velocity, m/s,
        and position, m, in the world frame, and the change of the two biases.

        Before that, the earlier state of each interval is moved by the step ``before (15,)``, the later by ``after``.
        """
        from_sensor, gap_s = np.linalg.inv(self.T_drone_sensor), np.diff(self.stamp_s)[:, None]
        T0, T1 = (
            moved_poses(T, np.tile(step[:POSE_DOF], (len(T), 1))) @ from_sensor
            for T, step in ((T_world_sensor[:-1], before), (T_world_sensor[1:], after))
        )
        old, new = self.motion[:-1] + before[POSE_DOF:], self.motion[1:] + after[POSE_DOF:]
        R, imu, bias = T0[:, :3, :3], self.imu, np.ascontiguousarray(old[:, 3:])
        read = integrated(imu.stamp_s, imu.specific_force, imu.angular_rate, self.stamp_s, bias)
        by_gravity = np.array([0.0, 0.0, -GRAVITY]) * gap_s
        rotation = T1[:, :3, :3] @ (R @ read.rotation).transpose(0, 2, 1)
        by_force, shift = ((R @ each[:, :, None])[:, :, 0] for each in (read.velocity, read.position))
        return np.hstack(
            [
                Rotation.from_matrix(rotation).as_rotvec(),
                new[:, :3] - old[:, :3] - by_gravity - by_force,
                T1[:, :3, 3] - T0[:, :3, 3] - gap_s * (old[:, :3] + 0.5 * by_gravity) - shift,
                new[:, 3:] - old[:, 3:],
            ]
        )


def _jacobian(errors: Callable[[Array], Array]) -> Array:
    """Numerical Jacobian ``(…, 15)`` of errors with respect to the step of a state, at zero."""
    return np.stack([(errors(step) - errors(-step)) / (2 * STEP) for step in STEP * np.eye(STATE_DOF)], axis=-1)


def integration_covariances(noise: ImuSettings, gap_s: Array) -> Array:
    """Covariances ``(K, 9, 9)`` of rotation, velocity and position after the times ``gap_s (K,)`` due to white noise.
    Their order is `INTEGRATED`. The effect of rotation errors on velocity and position is neglected."""
    gyro, force = (max(each, SIGMA_MIN) ** 2 for each in (noise.gyro_noise, noise.accelerometer_noise))
    one, gap_s = np.eye(3), gap_s[:, None, None]
    by_gyro, spread, none = gyro * gap_s * one, force * gap_s**2 / 2 * one, 0 * gap_s * one
    by_force, shift = force * gap_s * one, force * gap_s**3 / 3 * one
    return np.block([[by_gyro, none, none], [none, by_force, spread], [none, spread, shift]])


def gaps(at_s: Array, stamp_s: Array) -> NDArray[np.bool_]:
    """Mask ``(K − 1,)`` of the intervals between K scans in which readings at ``at_s (N,)`` are missing for more than
    `GAP_MAX_S`."""
    edges = np.concatenate([[-np.inf], at_s, [np.inf]])
    wide = np.concatenate([[0], np.cumsum(np.diff(edges) > GAP_MAX_S)])
    first = np.searchsorted(at_s, stamp_s[:-1], side="right")  # edges[first] is the reading before
    last = np.searchsorted(at_s, stamp_s[1:], side="left") + 1
    return wide[last] > wide[first]


@njit(cache=True)
def integrated(at_s, force, rate, stamp_s, bias):  # type: ignore[no-untyped-def]
    """The readings of an `Imu` `Integrated` between the stamps ``(K,)``, without the biases ``(K − 1, 6)`` of gyroscope
    and accelerometer. A reading is the mean since the previous one, in the drone frame at its stamp."""
    count = len(stamp_s) - 1
    rotation, velocity, position = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    step, before = np.empty((3, 3)), np.empty((3, 3))
    for k in range(count):
        R, v, p = rotation[k], velocity[k], position[k]
        R[0, 0] = R[1, 1] = R[2, 2] = 1.0
        i = max(1, np.searchsorted(at_s, stamp_s[k], side="right"))
        while i < len(at_s) and at_s[i - 1] < stamp_s[k + 1]:
            h = min(at_s[i], stamp_s[k + 1]) - max(at_s[i - 1], stamp_s[k])
            x, y, z = h * (rate[i, 0] - bias[k, 0]), h * (rate[i, 1] - bias[k, 1]), h * (rate[i, 2] - bias[k, 2])
            square = x * x + y * y + z * z  # Rodrigues' formula, its two factors as series
            a, b = 1 - square / 6 + square * square / 120, 0.5 - square / 24 + square * square / 720
            step[0, 0], step[0, 1], step[0, 2] = 1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
            step[1, 0], step[1, 1], step[1, 2] = b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x
            step[2, 0], step[2, 1], step[2, 2] = b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)
            before[:] = R
            for n in range(3):
                for m in range(3):
                    R[n, m] = before[n, 0] * step[0, m] + before[n, 1] * step[1, m] + before[n, 2] * step[2, m]
                f = 0.0
                for m in range(3):
                    f += R[n, m] * (force[i, m] - bias[k, 3 + m])
                p[n] += h * v[n] + 0.5 * h * h * f
                v[n] += h * f
            i += 1
    return Integrated(rotation, velocity, position)


def check_overlap(imu: Imu, prior: Trajectory) -> None:
    """Raise `InputError` if fewer than two readings are within the time of the poses."""
    inside = (imu.stamp_s >= prior.stamp_s[0]) & (imu.stamp_s <= prior.stamp_s[-1])
    if inside.sum() < 2 or len(prior) < 2:
        raise InputError(
            f"IMU: {int(inside.sum())} of {len(inside)} readings within the time of the poses; expected readings and "
            "poses with the same clock"
        )
