"""Closed-loop flights: the planner steers by the odometry's estimate only.

The true drone flies in `steelnb.simulation`. Scans, IMU readings and drifting poses are simulated during the flight.
They are bit-identical to those that `steelnb.experiment` simulates for a whole flight.
"""

from collections.abc import Callable

import numpy as np

from steelnb.core.types import Imu, OdometryStep, Trajectory
from steelnb.odometry import make_odometry
from steelnb.planning import Decision, Planner
from steelnb.points import preprocess_scan
from steelnb.settings import ExperimentSettings
from steelnb.simulation.flight import STEP_S, Command
from steelnb.simulation.imu import AttitudeFilter, ImuErrors
from steelnb.simulation.noise import drift_errors, drifted
from steelnb.simulation.tof import TofCamera, scan_steps
from steelnb.simulation.tower import Tower


class OnboardPilot:
    """Sensors, odometry and planner of a drone: a pilot for `steelnb.simulation.fly`.

    ``steps``: the odometry's steps so far; ``decisions``: the planner's decisions so far, with their times.
    ``on_progress`` is called with the completed share of the flight.
    """

    def __init__(
        self, settings: ExperimentSettings, tower: Tower, on_progress: Callable[[float], None] | None = None
    ) -> None:
        self._on_progress = on_progress or (lambda share: None)
        self.settings, steps = settings, round(settings.flight.duration_s / STEP_S)
        stamp_s = np.arange(steps + 1, dtype=np.float64) * STEP_S
        self._drift = drift_errors(stamp_s, settings.noise, settings.seed)
        self._scan_step = scan_steps(settings.tof, float(stamp_s[-1]), STEP_S)
        self._camera = TofCamera(tower, settings.tof, settings.seed)
        # The odometry shares these arrays and reads them up to its last scan; they are filled during the flight.
        self._imu = Imu(stamp_s, np.zeros((steps + 1, 3)), np.zeros((steps + 1, 3)))
        self._true, self._prior = np.zeros((2, steps + 1, 4, 4))
        self._imu_errors = ImuErrors(stamp_s, settings.imu, settings.seed) if settings.imu else None
        self._filter: AttitudeFilter | None = None
        self.odometry = make_odometry(settings.odometry, settings.tof.T_drone_sensor, self._imu)
        reach_m = min(settings.tof.range_max_m, settings.odometry.preprocess.crop_m)
        self.planner = Planner(settings.flight, settings.tof.fov_horizontal_rad, reach_m)
        self.steps: list[OdometryStep] = []
        self.decisions: list[tuple[float, Decision]] = []

    def __call__(self, truth: Trajectory, exact: Imu) -> Command | None:
        """Update sensors and odometry for a piece of the flight; returns the next command, None to end the flight."""
        first = round(truth.stamp_s[0] / STEP_S)
        now = first + len(truth) - 1
        self._read(truth, exact, first)
        while len(self.steps) < len(self._scan_step):
            step = int(self._scan_step[len(self.steps)])
            if step * STEP_S + self._camera.latency_s > now * STEP_S + 1e-9:
                break
            self._scan(step, now)
        # Dead reckoning since the last scan.
        T = self._prior[now]
        if self.steps:
            last = self._prior[self._scan_step[len(self.steps) - 1]]
            T = self.steps[-1].T_world_drone @ np.linalg.inv(last) @ T
        self._on_progress(now / (len(self._prior) - 1))
        decision = self.planner.decide(now * STEP_S, T)
        self.decisions.append((now * STEP_S, decision))
        if decision.state == "end":
            return None
        forward, left, up = decision.velocity.tolist()
        return Command((forward, left, up), decision.yaw_rate)

    def _read(self, truth: Trajectory, exact: Imu, first: int) -> None:
        """Simulate IMU readings and drifting poses of a piece of the flight that begins with the step ``first``."""
        piece = slice(first, first + len(truth))
        self._true[piece] = truth.T_world_drone
        imu, filtered = exact, truth
        if self._imu_errors:
            imu = self._imu_errors.read(exact, first)
            self._filter = self._filter or AttitudeFilter(truth.T_world_drone[0], STEP_S)
            filtered = self._filter.update(truth, imu)
        self._imu.specific_force[piece], self._imu.angular_rate[piece] = imu.specific_force, imu.angular_rate
        self._prior[piece] = drifted(filtered, self._drift[piece]).T_world_drone

    def _scan(self, step: int, now: int) -> None:
        """Take a scan, update the odometry with it, and pass it to the planner."""
        begin = max(0, step - 25)
        stamp_s = self._imu.stamp_s
        trajectory = Trajectory(stamp_s[begin : now + 1], self._true[begin : now + 1])
        scan = self._camera.scan(len(self.steps), float(stamp_s[step]), trajectory)
        self.steps.append(self.odometry.update(scan, self._prior[step]))
        T = self.steps[-1].T_world_drone
        points = preprocess_scan(scan, T, self.settings.tof.T_drone_sensor, self.settings.odometry.preprocess)
        self.planner.see(points, T, self.odometry.map_segments())
