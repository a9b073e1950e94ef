"""The mount of the sensor on the drone, and the delay of its stamps, as unknowns of an adjustment.

All scans share them: the rotation of the sensor about its own position and its translation, in the frame of the drone,
and the time by which stamps are later than the measurement. Poses are then those of the drone at the stamps. A scan
was taken at another one, which the motion of the prior leads to, and from there by the mount:

    T_world_sensor = T_world_drone · T_prior(stamp)⁻¹ · T_prior(stamp − late) · T_drone_sensor

So points depend on the mount, and the factors of the prior and of an IMU do not. The equations of points about the
poses of the sensor are converted to those of the drone (`Mount.of_drone`), by the chain rule. Sources: Kelly, Sukhatme,
"Visual-inertial sensor fusion: localization, mapping and sensor-to-sensor self-calibration" (IJRR 30, 2011); for the
delay Li, Mourikis, "Online temporal calibration for camera-IMU systems" (IJRR 33, 2014).
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.geometry import inverse_poses, rotation_between
from steelnb.core.types import Array, Flight, IntArray, Trajectory, interpolated_poses

if TYPE_CHECKING:  # which imports this module
    from steelnb.fusion.adjustment.factors import PointEquations

MOUNT_DOF = 7
"""Rotation (rad) and translation (m) of the sensor, axes of the drone, and the delay (s) of its stamps."""
WORLD_DOF = 6
"""Rotation (rad) about zero and translation (m) of all bars together. An unknown mount turns the whole map, and the
priors of the bars, which limit their own steps, must not hold it."""
WORLD_SIGMA = 1e3
STEP_S = 0.02
"""Step of the numerical derivative by the delay. A drifting path is rough over shorter times."""


class SharedEquations(NamedTuple):
    """Normal equations of S unknowns that all scans share: ``matrix (S, S)`` and ``vector (S,)``, and the blocks
    between them and the poses ``by_pose (K, D, S)`` and the bars ``by_bar (B, 7, S)``."""

    matrix: Array
    vector: Array
    by_pose: Array
    by_bar: Array


class DroneEquations(NamedTuple):
    """Normal equations of points about K poses of the drone, ``matrix (K, D, D)`` and ``vector (K, D)``, with the
    blocks ``cross (P, D, 7)`` of pairs with bars, and the ``shared`` ones of the mount."""

    matrix: Array
    vector: Array
    cross: Array
    shared: SharedEquations


@dataclass(frozen=True)
class Mount:
    """The mount of the sensor in an adjustment of K scans.

    ``stated (4, 4)``: the mount that was stated, with the standard deviations ``sigma (7,)`` of its error in the order
    of `MOUNT_DOF`; what has 0 is known. ``T_drone_sensor (4, 4)`` and ``late_s``: the present estimate. ``prior``:
    the drifting poses of the drone at the K scans, and ``path`` those at their own rate.
    """

    stated: Array
    sigma: Array
    prior: Trajectory
    path: Trajectory
    T_drone_sensor: Array
    late_s: float = 0.0

    @classmethod
    def started(cls, flight: Flight, sigma: Array, T_drone_sensor: Array | None = None) -> "Mount":
        """Start without a delay at the mount ``T_drone_sensor (4, 4)``, by default the stated one of the flight."""
        stated, path = flight.T_drone_sensor, flight.prior if flight.path is None else flight.path
        start = stated if T_drone_sensor is None else T_drone_sensor
        return cls(stated, np.asarray(sigma, dtype=float), flight.prior, path, start)

    @classmethod
    def known_as(cls, stated: Array, sigma: Array) -> "Mount":
        """A mount before any scan, for `at`."""
        nowhere = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
        return cls(stated, sigma, nowhere, nowhere, stated)

    def at(self, prior: Trajectory) -> "Mount":
        """The same mount and delay for the scans with the drifting poses ``prior``, and no others in between."""
        return replace(self, prior=prior, path=prior)

    @property
    def free(self) -> IntArray:
        """Numbers of the unknowns that have a standard deviation."""
        return np.flatnonzero(self.sigma)

    @property
    def error(self) -> Array:
        """The step ``(7,)`` from the stated mount to the present one."""
        turn = rotation_between(self.stated[:3, :3], self.T_drone_sensor[:3, :3])
        return np.concatenate([turn, (self.T_drone_sensor - self.stated)[:3, 3], [self.late_s]])

    def moved(self, step: Array) -> "Mount":
        """After a step of the `free` unknowns."""
        full, T = np.zeros(MOUNT_DOF), self.T_drone_sensor.copy()
        full[self.free] = step
        T[:3, :3] = Rotation.from_rotvec(full[:3]).as_matrix() @ T[:3, :3]
        T[:3, 3] += full[3:6]
        return replace(self, T_drone_sensor=T, late_s=self.late_s + float(full[6]))

    def at_scans(self, later_s: float = 0.0) -> Array:
        """Poses ``(K, 4, 4)`` of the sensor at each scan in the frame of the drone at its stamp, for a delay that is
        longer by ``later_s``."""
        if not self.sigma[6]:
            return np.tile(self.T_drone_sensor, (len(self.prior), 1, 1))
        measured = self.path.between(self.prior.stamp_s - self.late_s - later_s)
        return inverse_poses(self.prior.T_world_drone) @ measured @ self.T_drone_sensor

    def drones(self, T_world_sensor: Array) -> Array:
        """Poses ``(K, 4, 4)`` of the drone at the stamps, from those of the sensor."""
        return T_world_sensor @ inverse_poses(self.at_scans())

    def at_stamps(self, T_world_sensor: Array) -> tuple[Array, Array]:
        """Poses ``(K, 4, 4)`` of the drone at the stamps from those of the sensor at the measurements, and the times
        ``(K,)`` over which the drift is not measured.

        The correction of the prior, a turn of the drone about itself and a shift, is interpolated between scans. The
        first pose is the prior's, since drift begins there.
        """
        poses, stamp_s = self.drones(T_world_sensor), self.prior.stamp_s
        if not self.late_s or len(stamp_s) < 2:
            return poses, np.zeros(len(stamp_s))
        measured_s = stamp_s - self.late_s
        then, now = self.path.between(measured_s), self.prior.T_world_drone
        correction = np.tile(np.eye(4), (len(poses), 1, 1))
        measured = T_world_sensor @ np.linalg.inv(self.T_drone_sensor)
        correction[:, :3, :3] = measured[:, :3, :3] @ then[:, :3, :3].transpose(0, 2, 1)
        correction[:, :3, 3] = measured[:, :3, 3] - then[:, :3, 3]
        correction = interpolated_poses(measured_s, correction, stamp_s)
        poses[1:, :3, :3] = correction[1:, :3, :3] @ now[1:, :3, :3]
        poses[1:, :3, 3] = correction[1:, :3, 3] + now[1:, :3, 3]
        after = np.clip(np.searchsorted(measured_s, stamp_s), 1, len(stamp_s) - 1)
        before_s, after_s = np.abs(stamp_s - measured_s[after - 1]), np.abs(measured_s[after] - stamp_s)
        inside = (stamp_s >= measured_s[0]) & (stamp_s <= measured_s[-1])
        bridged_s = before_s * after_s / (before_s + after_s)
        unmeasured_s = np.where(inside, bridged_s, np.minimum(before_s, after_s))
        unmeasured_s[0] = 0.0
        return poses, unmeasured_s

    def of_drone(self, equations: "PointEquations", T_world_sensor: Array, size: int) -> DroneEquations:
        """Convert equations about the six degrees of freedom of the sensor's poses to those about the ``size`` of the
        drone's and S shared unknowns: the `free` ones of the mount, and `WORLD_DOF`, with their priors."""
        matrix, vector, cross, scan = equations.matrix, equations.vector, equations.cross, equations.pair_scan
        by_drone, by_mount = self._jacobians(T_world_sensor)
        by_mount = np.concatenate([by_mount[:, :, self.free], _by_world(T_world_sensor)], axis=2)
        by_drone = by_drone[:, :, 6 - size :]
        turned, shared = by_drone.transpose(0, 2, 1), by_mount.transpose(0, 2, 1)
        by_bar = np.zeros((len(equations.block), cross.shape[2], by_mount.shape[2]))
        np.add.at(by_bar, equations.pair_bar, cross.transpose(0, 2, 1) @ by_mount[scan])
        error = np.append(self.error[self.free], np.zeros(WORLD_DOF))
        information = np.append(self.sigma[self.free], np.full(WORLD_DOF, WORLD_SIGMA)) ** -2.0
        return DroneEquations(
            matrix=turned @ matrix @ by_drone,
            vector=(turned @ vector[:, :, None])[:, :, 0],
            cross=turned[scan] @ cross,
            shared=SharedEquations(
                matrix=(shared @ matrix @ by_mount).sum(axis=0) + np.diag(information),
                vector=(shared @ vector[:, :, None])[:, :, 0].sum(axis=0) - information * error,
                by_pose=turned @ matrix @ by_mount,
                by_bar=by_bar,
            ),
        )

    def _jacobians(self, T_world_sensor: Array) -> tuple[Array, Array]:
        """Derivatives of the steps of the sensor's poses by those of the drone's ``(K, 6, 6)`` and of the mount
        ``(K, 6, 7)``."""
        mounts = self.at_scans()
        T_world_drone = T_world_sensor @ inverse_poses(mounts)
        arm = T_world_sensor[:, :3, 3] - T_world_drone[:, :3, 3]
        by_drone = np.tile(np.eye(6), (len(arm), 1, 1))
        for axis in range(3):
            by_drone[:, 3:, axis] = np.cross(np.eye(3)[axis], arm)
        # Rotation of the drone when the scan was taken.
        R = T_world_sensor[:, :3, :3] @ self.T_drone_sensor[:3, :3].T
        by_mount = np.zeros((len(arm), 6, MOUNT_DOF))
        by_mount[:, :3, :3] = by_mount[:, 3:, 3:6] = R
        if self.sigma[6]:
            earlier, later = (T_world_drone @ self.at_scans(step_s) for step_s in (-STEP_S, STEP_S))
            turn = Rotation.from_matrix(later[:, :3, :3] @ earlier[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
            by_mount[:, :, 6] = np.hstack([turn, later[:, :3, 3] - earlier[:, :3, 3]]) / (2 * STEP_S)
        return by_drone, by_mount


def _by_world(T_world_sensor: Array) -> Array:
    """Derivatives ``(K, 6, 6)`` of the apparent steps of the sensor's poses by the motion of all bars: the opposite."""
    result = np.tile(-np.eye(6), (len(T_world_sensor), 1, 1))
    for axis in range(3):
        result[:, 3:, axis] = -np.cross(np.eye(3)[axis], T_world_sensor[:, :3, 3])
    return result
