"""Closed-loop flights: the planner steers by the odometry's estimate only."""

from collections.abc import Callable, Iterable

import numpy as np

from steelnb.core.estimates import OdometryStep
from steelnb.core.types import Array, Imu, Scan
from steelnb.odometry import make_odometry
from steelnb.planning.planner import Decision, Planner
from steelnb.points import preprocess_scan
from steelnb.points.ranges import calibrated_scan
from steelnb.settings import ExperimentSettings


class OnboardPilot:
    """Odometry and planner of a drone, which see its sensors only.

    ``imu``: the readings of the flight, read up to the last scan. ``steps``: the odometry's steps so far;
    ``decisions``: the planner's decisions so far, with their times. ``on_progress`` is called with the completed share
    of the flight.
    """

    def __init__(
        self, settings: ExperimentSettings, imu: Imu, on_progress: Callable[[float], None] | None = None
    ) -> None:
        self._on_progress = on_progress or (lambda share: None)
        self.settings = settings
        self.odometry = make_odometry(settings.odometry, settings.tof.T_drone_sensor, imu)
        reach_m = min(settings.tof.range_max_m, settings.odometry.preprocess.crop_m)
        self.planner = Planner(settings.flight, settings.tof.fov_horizontal_rad, reach_m)
        self.steps: list[OdometryStep] = []
        self.decisions: list[tuple[float, Decision]] = []
        self._last_prior: Array | None = None

    def __call__(
        self, now_s: float, scans: Iterable[tuple[Scan, Array]], T_world_drone_prior: Array
    ) -> tuple[Array, float] | None:
        """Update odometry and map with the new ``scans``, each with the drifting pose at its stamp, and decide.

        Returns the velocity ``(3,)``, m/s, along the axes of the levelled drone and the rate of the heading, rad/s;
        None to end the flight. ``T_world_drone_prior (4, 4)`` is the drifting pose now. Raises `InputError`.
        """
        for scan, prior in scans:
            self._see(scan, prior)
        T = T_world_drone_prior
        # Dead reckoning since the last scan.
        if self._last_prior is not None:
            T = self.steps[-1].T_world_drone @ np.linalg.inv(self._last_prior) @ T
        self._on_progress(min(now_s / self.settings.flight.duration_s, 1.0))
        decision = self.planner.decide(now_s, T)
        self.decisions.append((now_s, decision))
        return None if decision.state == "end" else (decision.velocity, decision.yaw_rate)

    def _see(self, scan: Scan, prior: Array) -> None:
        """Update the odometry with a scan, and pass the scan to the planner."""
        tof = self.settings.tof
        scan = calibrated_scan(scan, tof.range_scale, tof.range_offset_m)
        self.steps.append(self.odometry.update(scan, prior))
        self._last_prior = prior
        T = self.steps[-1].T_world_drone
        points = preprocess_scan(scan, T, self.settings.tof.T_drone_sensor, self.settings.odometry.preprocess)
        self.planner.see(points, T, self.odometry.map_segments())
