"""Inertial factors of an adjustment (`fusion.problem`): velocities and biases of the IMU as states beside the poses.

The readings between two scans are integrated once, whatever the pose and the velocity before them. They tell what bars
and a drifting prior do not: where down is, and metres, by how long a speed lasts. Source: Forster, Carlone, Dellaert,
Scaramuzza, "On-manifold preintegration for real-time visual-inertial odometry" (T-RO 33, 2017); here with derivatives
by differences, and integrated anew at each step instead of corrected for a bias to first order.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steelnb.errors import InputError
from steelnb.fusion.poses import moved_poses
from steelnb.settings import ImuSettings
from steelnb.types import GRAVITY, Array, Imu, Trajectory

POSE, STATE = 6, 15
"""Degrees of freedom of a pose with roll and pitch; and with velocity and the biases of gyroscope and accelerometer."""
VELOCITY_SIGMA_M_S = 100.0
"""Standard deviation of each velocity beforehand: nothing is known of it."""
SIGMA_MIN = 1e-7
"""Least density of noise and least standard deviation of a bias, for an IMU without."""
GAP_MAX_S = 0.1
"""Longest time between two readings; an interval with a longer one says nothing."""
LEAN_MAX_RAD = 0.5
"""Readings whose vertical is farther from the prior's are in other axes."""
STEP = 1e-5
"""Step of the differences that stand for derivatives."""
UNITS = {"g": 1.0, "mg or cm/s²": 100 * GRAVITY}
"""Gravity in units that are not m/s²."""
RATE_MIN, UNIT_FACTOR = 0.5, 10.0
"""Rates above this and larger than the prior's by this factor are not in rad/s: a degree is a 57th."""


class InertialEquations(NamedTuple):
    """Normal equations of the readings: of the states ``matrix (K, 15, 15)``, ``vector (K, 15)``, between each and the
    next ``beside (K − 1, 15, 15)``."""

    matrix: Array
    beside: Array
    vector: Array


class Integrated(NamedTuple):
    """Readings between K scans in the frame of the earlier one: ``turn (K − 1, 3, 3)``, and without gravity the change
    of ``velocity (K − 1, 3)``, m/s, and of ``place (K − 1, 3)``, metres, beyond that by the velocity before."""

    turn: Array
    velocity: Array
    place: Array


@dataclass(frozen=True)
class Inertial:
    """Readings of an IMU and what they mean for the K scans of an adjustment.

    ``motion (K, 9)``: velocity in the world, m/s, and biases of gyroscope, rad/s, and accelerometer, m/s²;
    ``known (K, 9)``: the weights with which they are zero; ``weight (K − 1, 15, 15)`` of the `errors` between scans.
    ``T_drone_sensor`` is the mount, ``stamp_s (K,)`` the stamps of the scans.
    """

    imu: Imu
    T_drone_sensor: Array
    stamp_s: Array
    motion: Array
    known: Array
    weight: Array

    @classmethod
    def started(cls, imu: Imu, noise: ImuSettings, T_drone_sensor: Array, trajectory: Trajectory) -> "Inertial":
        """With the velocities of a trajectory at the scans and without biases; ``noise`` is that of the data sheet."""
        stamp_s, place = trajectory.stamp_s, trajectory.T_world_drone[:, :3, 3]
        gap_s, motion, known = np.diff(stamp_s), *np.zeros((2, len(stamp_s), 9))
        if len(stamp_s) > 1:
            motion[:, :3] = np.gradient(place, stamp_s, axis=0)
        known[:, :3] = VELOCITY_SIGMA_M_S**-2.0
        known[0, 3:] = np.repeat(np.maximum([noise.gyro_bias, noise.accelerometer_bias], SIGMA_MIN) ** -2.0, 3)
        walk = np.maximum([noise.gyro_walk, noise.accelerometer_walk], SIGMA_MIN) ** -2.0
        weight = np.zeros((len(gap_s), STATE, STATE))
        has_readings = ~gaps(imu.stamp_s, stamp_s)
        weight[has_readings, :9, :9] = np.linalg.inv(integration_covariances(noise, gap_s[has_readings]))
        weight[:, range(9, STATE), range(9, STATE)] = np.repeat(walk, 3) / gap_s[:, None]
        return cls(imu, T_drone_sensor, stamp_s, motion, known, weight)

    def moved(self, step: Array) -> "Inertial":
        """After steps ``(K, 15)`` of the states."""
        return replace(self, motion=self.motion + step[:, POSE:])

    def turned(self, rotation: Array) -> "Inertial":
        """In a world that is turned by a rotation ``(3, 3)``."""
        return replace(self, motion=np.hstack([self.motion[:, :3] @ rotation.T, self.motion[:, 3:]]))

    def errors(self, T_world_sensor: Array) -> Array:
        """Errors ``(K − 1, 15)`` between poses of the sensor ``(K, 4, 4)``: three each of rotation, rad, velocity, m/s,
        and place, m, in the axes of the world, and of how far the two biases walked."""
        return self._errors(T_world_sensor, np.zeros(STATE), np.zeros(STATE))

    def equations(self, T_world_sensor: Array) -> InertialEquations:
        """The normal equations at poses of the sensor ``(K, 4, 4)``."""
        none, error = np.zeros(STATE), self.errors(T_world_sensor)
        before = _slopes(lambda step: self._errors(T_world_sensor, step, none), STATE)
        after = _slopes(lambda step: self._errors(T_world_sensor, none, step), STATE)
        matrix, vector = np.zeros((len(T_world_sensor), STATE, STATE)), np.zeros((len(T_world_sensor), STATE))
        matrix[:, range(POSE, STATE), range(POSE, STATE)] = self.known
        vector[:, POSE:] = -self.known * self.motion
        earlier, later = before.transpose(0, 2, 1) @ self.weight, after.transpose(0, 2, 1) @ self.weight
        for at, weighed, by in ((slice(None, -1), earlier, before), (slice(1, None), later, after)):
            matrix[at] += weighed @ by
            vector[at] -= (weighed @ error[:, :, None])[:, :, 0]
        return InertialEquations(matrix, earlier @ after, vector)

    def _errors(self, T_world_sensor: Array, before: Array, after: Array) -> Array:
        """The errors where the earlier state of each interval has moved by ``before (15,)``, the later by ``after``."""
        from_sensor, gap_s = np.linalg.inv(self.T_drone_sensor), np.diff(self.stamp_s)[:, None]
        T0, T1 = (
            moved_poses(T, np.tile(step[:POSE], (len(T), 1))) @ from_sensor
            for T, step in ((T_world_sensor[:-1], before), (T_world_sensor[1:], after))
        )
        old, new = self.motion[:-1] + before[POSE:], self.motion[1:] + after[POSE:]
        R, read = T0[:, :3, :3], integrated(self.imu, self.stamp_s, old[:, 3:])
        by_gravity = np.array([0.0, 0.0, -GRAVITY]) * gap_s
        turned = T1[:, :3, :3] @ (R @ read.turn).transpose(0, 2, 1)
        by_force, shift = ((R @ each[:, :, None])[:, :, 0] for each in (read.velocity, read.place))
        return np.hstack(
            [
                Rotation.from_matrix(turned).as_rotvec(),
                new[:, :3] - old[:, :3] - by_gravity - by_force,
                T1[:, :3, 3] - T0[:, :3, 3] - gap_s * (old[:, :3] + 0.5 * by_gravity) - shift,
                new[:, 3:] - old[:, 3:],
            ]
        )


def _slopes(of: Callable[[Array], Array], count: int) -> Array:
    """Derivatives ``(…, count)`` at zero, by differences."""
    return np.stack([(of(step) - of(-step)) / (2 * STEP) for step in STEP * np.eye(count)], axis=-1)


def integration_covariances(noise: ImuSettings, gap_s: Array) -> Array:
    """Covariances ``(K, 9, 9)`` of rotation, velocity and place after times ``gap_s (K,)``, from the densities of white
    noise; for turns so small that all directions are the same."""
    gyro, force = (max(each, SIGMA_MIN) ** 2 for each in (noise.gyro_noise, noise.accelerometer_noise))
    one, gap_s = np.eye(3), gap_s[:, None, None]
    spread, none = force * gap_s**2 / 2 * one, 0 * gap_s * one
    return np.block(
        [
            [gyro * gap_s * one, none, none],
            [none, force * gap_s * one, spread],
            [none, spread, force * gap_s**3 / 3 * one],
        ]
    )


def gaps(at_s: Array, stamp_s: Array) -> NDArray[np.bool_]:
    """Between which of K scans ``(K − 1,)`` readings at ``at_s (N,)`` are missing for more than `GAP_MAX_S`."""
    edges = np.concatenate([[-np.inf], at_s, [np.inf]])
    wide = np.concatenate([[0], np.cumsum(np.diff(edges) > GAP_MAX_S)])
    first = np.searchsorted(at_s, stamp_s[:-1], side="right")  # edges[first] is the reading before
    last = np.searchsorted(at_s, stamp_s[1:], side="left") + 1
    return wide[last] > wide[first]


def integrated(imu: Imu, stamp_s: Array, bias: Array) -> Integrated:
    """The readings between stamps ``(K,)`` without the biases ``(K − 1, 6)`` of gyroscope and accelerometer. A reading
    is the mean since the one before it, in the axes that the drone has at its stamp."""
    return Integrated(*_integrate(imu.stamp_s, imu.specific_force, imu.angular_rate, stamp_s, bias))


@njit(cache=True)
def _integrate(at_s, force, rate, stamp_s, bias):  # type: ignore[no-untyped-def]
    count = len(stamp_s) - 1
    turn, velocity, place = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    step, before = np.empty((3, 3)), np.empty((3, 3))
    for k in range(count):
        R, v, p = turn[k], velocity[k], place[k]
        R[0, 0] = R[1, 1] = R[2, 2] = 1.0
        i = max(1, np.searchsorted(at_s, stamp_s[k], side="right"))
        while i < len(at_s) and at_s[i - 1] < stamp_s[k + 1]:
            h = min(at_s[i], stamp_s[k + 1]) - max(at_s[i - 1], stamp_s[k])
            x, y, z = h * (rate[i, 0] - bias[k, 0]), h * (rate[i, 1] - bias[k, 1]), h * (rate[i, 2] - bias[k, 2])
            square = x * x + y * y + z * z  # Rodrigues' formula; its two factors as series
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
    return turn, velocity, place


def check_imu(imu: Imu, prior: Trajectory) -> None:
    """Raise `InputError` for readings in other units, or whose axes are not the drone's: gravity's size and
    direction, and the turns of the ``prior``, tell."""
    inside = (imu.stamp_s >= prior.stamp_s[0]) & (imu.stamp_s <= prior.stamp_s[-1])
    if inside.sum() < 2 or len(prior) < 2:
        raise InputError(
            f"IMU: {int(inside.sum())} of {len(inside)} readings within the time of the poses; expected readings and "
            "poses with the same clock"
        )
    force, R = imu.specific_force[inside], prior.between(imu.stamp_s[inside])[:, :3, :3]
    mean = (R @ force[:, :, None]).mean(axis=0)[:, 0]
    size = float(np.linalg.norm(mean))
    if not 0.7 < size / GRAVITY < 1.3:
        unit = next((f", as of {name}" for name, g in UNITS.items() if 0.7 < size / g < 1.3), "")
        raise InputError(f"IMU: specific force of {size:.3g} on average{unit}; expected {GRAVITY} m/s², gravity's")
    lean = float(np.arccos(np.clip(mean[2] / size, -1, 1)))
    if lean > LEAN_MAX_RAD:
        says = "upside down" if lean > np.pi - LEAN_MAX_RAD else f"{np.degrees(lean):.0f}° off"
        raise InputError(f"IMU: its vertical is {says}; expected readings in the axes of the drone, by tf")
    gap_s, R = np.diff(prior.stamp_s), prior.T_world_drone[:, :3, :3]
    prior_rates = Rotation.from_matrix(R[:-1].transpose(0, 2, 1) @ R[1:]).as_rotvec() / gap_s[:, None]
    steps = imu.angular_rate * np.diff(imu.stamp_s, prepend=imu.stamp_s[0])[:, None]
    turned = [np.interp(prior.stamp_s, imu.stamp_s, column) for column in np.cumsum(steps, axis=0).T]
    rate, prior_rate = (
        float(np.sqrt((each**2).sum(axis=1).mean())) for each in (np.diff(turned).T / gap_s[:, None], prior_rates)
    )
    if rate > RATE_MIN and rate > UNIT_FACTOR * prior_rate:
        raise InputError(
            f"IMU: angular rate of {rate:.3g} beside {prior_rate:.3g} rad/s of the poses, as of degrees; expected rad/s"
        )
