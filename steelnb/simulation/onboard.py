"""The sensors of a drone during its flight: what `steelnb.simulation.tof` and others simulate for a whole flight."""

from collections.abc import Callable, Iterator

import numpy as np

from steelnb.core.types import Array, Imu, Scan, Trajectory
from steelnb.settings import ExperimentSettings
from steelnb.settings.report_plots import STEP_S
from steelnb.simulation.drift import drift_errors, drifted
from steelnb.simulation.flight import Command, Pilot
from steelnb.simulation.imu import AttitudeFilter, ImuErrors
from steelnb.simulation.tof import TofCamera, scan_steps
from steelnb.simulation.tower import Tower

Steer = Callable[[float, Iterator[tuple[Scan, Array]], Array], tuple[Array, float] | None]
"""Called during a flight with the time, s, the scans that have become available, each with the drifting pose
``T_world_drone (4, 4)`` at its stamp, and the drifting pose now. It returns the next velocity ``(3,)``, m/s, along the
axes of the levelled drone and the rate of the heading, rad/s; or None to end the flight."""


class OnboardSensors:
    """Scans, IMU readings and drifting poses during a flight, bit-identical to those that `steelnb.experiment`
    simulates for a whole flight.

    ``imu``: all readings of the flight; its arrays are filled up to the present.
    """

    def __init__(self, settings: ExperimentSettings, tower: Tower) -> None:
        steps = round(settings.flight.duration_s / STEP_S)
        stamp_s = np.arange(steps + 1, dtype=np.float64) * STEP_S
        self.imu = Imu(stamp_s, np.zeros((steps + 1, 3)), np.zeros((steps + 1, 3)))
        self._drift = drift_errors(stamp_s, settings.noise, settings.seed)
        self._scan_step = scan_steps(settings.tof, float(stamp_s[-1]), STEP_S)
        self._camera = TofCamera(tower, settings.tof, settings.seed)
        self._true, self._prior = np.zeros((2, steps + 1, 4, 4))
        self._imu_errors = ImuErrors(stamp_s, settings.imu, settings.seed) if settings.imu else None
        self._filter: AttitudeFilter | None = None
        self._scans = 0

    def steered_by(self, steer: Steer) -> Pilot:
        """A pilot for `steelnb.simulation.fly` that sees no more than the sensors."""

        def pilot(truth: Trajectory, exact: Imu) -> Command | None:
            first = round(truth.stamp_s[0] / STEP_S)
            now = first + len(truth) - 1
            self._read(truth, exact, first)
            command = steer(now * STEP_S, self._new_scans(now), self._prior[now])
            if command is None:
                return None
            forward, left, up = command[0].tolist()
            return Command((forward, left, up), command[1])

        return pilot

    def _read(self, truth: Trajectory, exact: Imu, first: int) -> None:
        """Simulate IMU readings and drifting poses of a piece of the flight that begins with the step ``first``."""
        piece = slice(first, first + len(truth))
        self._true[piece] = truth.T_world_drone
        imu, filtered = exact, truth
        if self._imu_errors:
            imu = self._imu_errors.read(exact, first)
            self._filter = self._filter or AttitudeFilter(truth.T_world_drone[0], STEP_S)
            filtered = self._filter.update(truth, imu)
        self.imu.specific_force[piece], self.imu.angular_rate[piece] = imu.specific_force, imu.angular_rate
        self._prior[piece] = drifted(filtered, self._drift[piece]).T_world_drone

    def _new_scans(self, now: int) -> Iterator[tuple[Scan, Array]]:
        """The scans that have become available by step ``now``, each with the drifting pose at its stamp."""
        stamp_s = self.imu.stamp_s
        while self._scans < len(self._scan_step):
            step = int(self._scan_step[self._scans])
            if step * STEP_S + self._camera.latency_s > now * STEP_S + 1e-9:
                break
            begin = max(0, step - 25)
            trajectory = Trajectory(stamp_s[begin : now + 1], self._true[begin : now + 1])
            scan = self._camera.scan(self._scans, float(stamp_s[step]), trajectory)
            self._scans += 1
            yield scan, self._prior[step]
