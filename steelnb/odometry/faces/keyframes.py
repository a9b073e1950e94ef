"""Keyframes of a flight in progress: their poses and bars, adjusted together from time to time."""

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array, Imu, Scan, Trajectory
from steelnb.fusion.adjustment.adjust import adjust
from steelnb.fusion.adjustment.imu_factors import Inertial
from steelnb.fusion.adjustment.problem import Problem
from steelnb.fusion.mapped_scans import MappedScans, insert_scan
from steelnb.fusion.ridges import VOXEL_M
from steelnb.points import VoxelMap
from steelnb.settings import ImuSettings, StructureSettings

FITS, STAGES = 2, ((1, 2),)
"""Number of times that bars are fitted before an adjustment, and its stages (`adjust.Stages`)."""
KEYFRAMES_MAX, RECENT = 400, 100
"""Above this number every second keyframe is dropped, except the first and the most recent ones. This bounds the time
of an adjustment."""
BARS_MIN = 4
"""Minimum number of bars with a section."""


class Keyframes:
    """K scans of a flight, accumulated in voxels at the poses at which they were added.

    ``T_world_sensor (K, 4, 4)``: their poses after the last adjustment; ``settings``: of the bars; ``tilt_sigma_rad``:
    standard deviation of the prior's roll and pitch (`Problem`); ``readings``: of an IMU, with its data sheet and the
    sensor's mount ``T_drone_sensor (4, 4)``.
    """

    def __init__(self, settings: StructureSettings, tilt_sigma_rad: float = 0.0) -> None:
        self.settings, self.tilt_sigma_rad = settings, tilt_sigma_rad
        self.readings: tuple[Imu, ImuSettings, Array] | None = None
        self.voxels = VoxelMap(VOXEL_M)
        self.scans: list[Scan] = []
        self.T_world_sensor, self._prior = np.zeros((2, 0, 4, 4))
        self._before: Problem | None = None

    def add(self, scan: Scan, points: Array, T_world_sensor: Array, prior: Array) -> None:
        """Add a scan with its pose ``(4, 4)``. Bars are fitted to its ``points (N, 3)``, sensor frame. ``prior (4, 4)``
        is the sensor's drifting pose; drift begins at the first one."""
        insert_scan(self.voxels, scan, T_world_sensor, self.settings)
        self.scans.append(Scan(scan.stamp_s, points))
        self.T_world_sensor = np.concatenate([self.T_world_sensor, T_world_sensor[None]])
        self._prior = np.concatenate([self._prior, prior[None]])
        if len(self.scans) > KEYFRAMES_MAX:
            kept = [0, *range(2, KEYFRAMES_MAX - RECENT, 2), *range(KEYFRAMES_MAX - RECENT, len(self.scans))]
            self.scans = [self.scans[k] for k in kept]
            self.T_world_sensor, self._prior = self.T_world_sensor[kept], self._prior[kept]

    def adjust(self) -> Problem | None:
        """Find bars, and adjust bars and poses together (`adjust`); None if there are too few bars."""
        if not len(self.voxels):
            return None
        mapped = MappedScans(self.scans, self.T_world_sensor, self.voxels, self.settings)
        stamp_s, inertial = np.array([scan.stamp_s for scan in self.scans]), None
        if self.readings:
            imu, noise, mount = self.readings
            inertial = Inertial.started(
                imu, noise, mount, Trajectory(stamp_s, self.T_world_sensor @ np.linalg.inv(mount))
            )
        try:
            state, _ = adjust(
                mapped, self._prior, stamp_s, STAGES, FITS, every=1, bars_min=BARS_MIN,
                tilt_sigma_rad=self.tilt_sigma_rad, inertial=inertial, before=self._before,
            )  # fmt: skip
        except InputError:
            return None
        self.T_world_sensor, self._before = state.T_world_sensor, state
        return state
