"""Keyframes of a flight in progress: their poses and the bars they show, adjusted together from time to time."""

from typing import NamedTuple

import numpy as np

from steelnb.fusion import problem, solver
from steelnb.fusion.bar_voxels import Observations, world_points
from steelnb.fusion.inertial import Inertial
from steelnb.fusion.problem import Bars, Problem
from steelnb.fusion.proposals import VOXEL_M
from steelnb.fusion.reconstruct import MappedScans
from steelnb.points import VoxelMap, smooth_ranges
from steelnb.settings import ImuSettings, StructureSettings
from steelnb.types import Array, Imu, Scan, Trajectory

STEPS, REFINED = 2, 2
"""Steps of an adjustment, and how often the bars are fitted before it; chosen on the development seed 11."""
KEYFRAMES_MAX, RECENT = 400, 100
"""Above this number every second keyframe is dropped, except the first and the most recent ones, which bounds the time
of an adjustment."""
BARS_MIN = 4


class Readings(NamedTuple):
    """Readings of an IMU, the errors of its data sheet, and the sensor's mount ``T_drone_sensor (4, 4)``."""

    imu: Imu
    noise: ImuSettings
    T_drone_sensor: Array


class Keyframes:
    """Scans of a flight, accumulated in voxels at the poses that they had when they were added.

    ``T_world_sensor (K, 4, 4)`` are their poses after the last adjustment. ``settings`` say what a bar is,
    ``tilt_sigma_rad`` how well the prior knows roll and pitch (`problem.Problem`); ``readings`` of an IMU take part.
    """

    def __init__(self, settings: StructureSettings, tilt_sigma_rad: float = 0.0) -> None:
        self.settings, self.tilt_sigma_rad = settings, tilt_sigma_rad
        self.readings: Readings | None = None
        self.voxels = VoxelMap(VOXEL_M)
        self.scans: list[Scan] = []
        self.T_world_sensor, self._prior = np.zeros((2, 0, 4, 4))
        self._ratio: float | None = None  # range noise as a multiple of that in `points.ranges`

    def add(self, scan: Scan, points: Array, T_world_sensor: Array, prior: Array) -> None:
        """Add a scan, some ``points (N, 3)`` of it in the sensor frame to fit bars to, its pose, and the sensor's pose
        by the drifting prior, both ``(4, 4)``. The first one is where drift begins."""
        s = self.settings
        image = smooth_ranges(scan.points)
        flat = np.ascontiguousarray(image, dtype=np.float64).reshape(-1, 3)
        self.voxels.insert(*world_points(flat, T_world_sensor, s.range_max_m, s.floor_m))
        self.scans.append(Scan(scan.stamp_s, points))
        self.T_world_sensor = np.concatenate([self.T_world_sensor, T_world_sensor[None]])
        self._prior = np.concatenate([self._prior, prior[None]])
        if len(self.scans) > KEYFRAMES_MAX:
            kept = [0, *range(2, KEYFRAMES_MAX - RECENT, 2), *range(KEYFRAMES_MAX - RECENT, len(self.scans))]
            self.scans = [self.scans[k] for k in kept]
            self.T_world_sensor, self._prior = self.T_world_sensor[kept], self._prior[kept]

    def adjust(self) -> Problem | None:
        """Find bars, and adjust bars and poses together (`fusion.solver`); None if there are too few bars."""
        if not len(self.voxels):
            return None
        mapped = MappedScans(self.scans, self.T_world_sensor, self.voxels, self.settings)
        fitted, _ = mapped.find_and_fit(REFINED, every=1)
        if fitted is None or np.isfinite(fitted.width).sum() < BARS_MIN:
            return None
        found = Bars(fitted.bars, fitted.across, fitted.turn, fitted.width)
        stamp_s, inertial = np.array([scan.stamp_s for scan in self.scans]), None
        if self.readings:
            imu, noise, mount = self.readings
            inertial = Inertial.started(
                imu, noise, mount, Trajectory(stamp_s, self.T_world_sensor @ np.linalg.inv(mount))
            )
        state = problem.start(self.T_world_sensor, self._prior, found, self.tilt_sigma_rad, inertial=inertial)
        observations = Observations.gathered(mapped.face_points(mapped.around(fitted.bars), state.bars, self._ratio))
        state, _ = solver.adjusted(state, observations, self._prior, stamp_s, STEPS)
        self.T_world_sensor, self._ratio = state.T_world_sensor, state.sigma_ratio
        return state
