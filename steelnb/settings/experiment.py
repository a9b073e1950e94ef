"""Settings of one experiment: the simulated world and the odometry."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import BeforeValidator, model_validator

from steelnb.core import rng
from steelnb.core.checks import checked_kind, shown
from steelnb.core.errors import InputError
from steelnb.settings.base import OrNone, SeedOrReport, Settings
from steelnb.settings.odometry import (
    Family,
    OdometrySettings,
    OrbSettings,
    ReportCloudSettings,
    SensorPreset,
    of_its_method,
)
from steelnb.settings.presets import NameOrPath
from steelnb.settings.report_plots import STEP_S, ReportPlot
from steelnb.settings.world import (
    REST_S,
    FlightSettings,
    ImuSettings,
    Noise,
    TofSettings,
    TowerSettings,
    TrajectoryName,
)

SCANS_MIN = 2
"""The first scan becomes the map, so only the second one can have an error."""


class ExperimentSettings(Settings):
    """Everything that one run depends on. ``seed`` determines drift, sensor noise and gusts, not the tower.

    With ``imu``, the readings have its errors, and a filter estimates the prior's roll and pitch from them.
    `Noise.parse` explains ``noise_name``.
    """

    of_preset = ("sensor",)

    sensor: NameOrPath
    noise_name: str
    seed: SeedOrReport
    tower: TowerSettings = TowerSettings()
    flight: FlightSettings
    tof: TofSettings
    imu: Annotated[ImuSettings | None, OrNone] = None
    odometry: Annotated[Family, BeforeValidator(of_its_method)]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.flight.trajectory == "planned" and isinstance(self.odometry, OrbSettings):
            raise ValueError(f"method {self.odometry.method!r}: a planned flight has no images during the flight; "
                             "expected an odometry by clouds or segments")  # fmt: skip
        noise = self.noise  # raises for an unknown name
        if self.seed == "report":
            noise.check_report()
        own = self.tof.samples if isinstance(self.tof.samples, tuple) else ()
        if own and own[-1] * STEP_S > self.flight.duration_s:
            raise ValueError(
                f"tof.samples ends at step {own[-1]}, {own[-1] * STEP_S:g} s: expected it within the flight's"
                f" {self.flight.duration_s:g} s"
            )
        if not self.tof.start_s < self.flight.duration_s:
            raise ValueError(
                f"tof.start_s = {self.tof.start_s:g}: expected less than the flight's {self.flight.duration_s:g} s"
            )
        self._check_scans()
        return self

    def _check_scans(self) -> None:
        """Raise ValueError if the flight ends before, or the sensor starts after, its first two scans."""
        start_s, duration_s, samples = self.tof.start_s, self.flight.duration_s, self.tof.samples
        first_s = start_s + np.arange(SCANS_MIN) / self.tof.rate_hz
        steps = self.tof.sample_steps() if samples else np.round(first_s / STEP_S)
        # No scan is taken at the last step.
        left = np.count_nonzero((steps * STEP_S >= start_s - STEP_S / 2) & (steps < round(duration_s / STEP_S)))
        if left < min(SCANS_MIN, len(steps)):
            time_s = steps * STEP_S
            if not samples:
                raise ValueError(
                    f"flight.duration_s = {duration_s:g}: expected two scans, so more than {time_s[-1]:g} s"
                )
            raise ValueError(
                f"flight.duration_s = {duration_s:g} and tof.start_s = {start_s:g} leave {left} scans of tof.samples ="
                f" {shown(samples, 40)}, which begins at {time_s[0]:g} s and ends at {time_s[-1]:g} s: expected"
                " two scans"
            )

    def check_draws(self) -> None:
        """Raise `InputError` if the sensor has faults or the flight is planned: there are no draws on one flight."""
        if self.tof.faults or self.flight.trajectory == "planned":
            raise InputError("draws of the noise: expected a sensor without faults and a flight that is not planned")

    @property
    def noise(self) -> Noise:
        """The drift that ``noise_name`` names."""
        return Noise.parse(self.noise_name)

    @classmethod
    def preset(
        cls,
        trajectory: TrajectoryName | None = None,
        noise: str | None = None,
        method: str = "least_squares",
        sensor: str | Path = "starling2",
        seed: rng.Seed | None = None,
        duration_s: float | None = None,
        overrides: dict[str, Any] | None = None,
        tower: str | None = None,
    ) -> "ExperimentSettings":
        """The settings of a flight, noise, method, sensor and tower, named as in the notebooks.

        By default, the flight is a ``zigzag`` with the noise ``random-walk`` and the seed 1, its preset determines the
        tower and the duration, and a drone with an IMU rests for `REST_S` first. ``overrides`` changes single settings,
        such as ``{"tof.rate_hz": 10.0, "hough.dx_m": 0.05}``. Raises `InputError`.

        >>> settings = ExperimentSettings.preset("loops", method="best", overrides={"tof.rate_hz": 10.0})
        >>> settings.tof.rate_hz, settings.odometry.dof
        (10.0, 'xyz_yaw')
        """
        own, odometry = SensorPreset.read(sensor), OdometrySettings.preset(method, sensor)
        overrides = {} if overrides is None else checked_kind(overrides, "overrides", dict)
        given = {"trajectory": trajectory, "noise": noise, "seed": seed, "duration_s": duration_s, "tower": tower}
        check_given_once(overrides, given)
        trajectory = "zigzag" if trajectory is None else trajectory
        of_flight = {"still_s": REST_S} if own.imu and trajectory in ("zigzag", "loops") else {}
        of_flight |= {name[7:]: value for name, value in overrides.items() if str(name).startswith("flight.")}
        settings = cls.model_construct(  # checked when they are changed
            sensor=sensor,
            noise_name="random-walk" if noise is None else noise,
            seed=1 if seed is None else seed,
            tower=TowerSettings.of_flight(trajectory) if tower is None else TowerSettings.preset(tower),
            flight=FlightSettings.preset(trajectory, duration_s, of_flight),
            tof=own.tof,
            imu=own.imu,
            odometry=odometry,
        )
        return settings.override(overrides)

    @classmethod
    def report(
        cls,
        figure: str,
        trajectory: str,
        method: str,
        odometry: str | None = None,
        overrides: dict[str, Any] | None = None,
        run: str = "",
        noise: str | None = None,
        sensor: str | Path = "report",
        seed: rng.Seed | None = None,
        duration_s: float | None = None,
        tower: str | None = None,
    ) -> "ExperimentSettings":
        """The experiment behind one of the report's plots, with its flight, tower, sensor, noise draws and scan times.

        ``odometry``: another method on the same scans; ``run``: ``"earlier"`` for that of a plot that shows two. By
        default, ``noise``, ``sensor``, ``seed``, ``duration_s`` and ``tower`` are the report's. Raises `InputError`.

        >>> settings = ExperimentSettings.report("3.5", "vertical", "gicp")
        >>> settings.seed, settings.noise_name, len(settings.tof.sample_steps())
        ('report', 'random-walk', 202)
        """
        plot = ReportPlot.find(figure, trajectory, method, run)
        overrides = {} if overrides is None else checked_kind(overrides, "overrides", dict)
        own = {"tof.samples": plot.name} | ({} if plot.still_s is None else {"flight.still_s": plot.still_s})
        own = {name: value for name, value in own.items() if name.partition(".")[0] not in overrides}
        if duration_s is None and not {"flight", "flight.duration_s"} & overrides.keys():
            duration_s = plot.duration_s
        settings = cls.preset(
            plot.flight or plot.trajectory,  # type: ignore[arg-type]
            plot.noise if noise is None and "noise_name" not in overrides else noise,
            method if odometry is None else odometry,
            sensor,
            "report" if seed is None and "seed" not in overrides else seed,
            duration_s,
            {**own, **overrides},
            tower,
        )
        if settings.tof.samples and "tof.rate_hz" in overrides:
            what = "the scans are those of the report's plot; leave it out, or give tof.samples = [], too"
            raise InputError(f"tof.rate_hz = {shown(overrides['tof.rate_hz'])}: {what}")
        if isinstance(settings.odometry, ReportCloudSettings) and "broken_off_s" not in overrides:
            settings = settings.override({"broken_off_s": plot.broken_off_s})
        return settings

    @classmethod
    def table_of(cls, name: str) -> str:
        """The table that a name in `override` belongs to; a setting of the whole run is a table of its own."""
        table = name.partition(".")[0]
        return table if table in cls.model_fields else "odometry"

    def override(self, overrides: dict[str, Any]) -> Self:
        """A copy with single settings changed, each named ``table.setting``. Raises `InputError`.

        The tables of the world are ``tower``, ``flight``, ``tof`` and ``imu``. All other names belong to the odometry.
        ``tower`` may be the name of a preset.
        """
        full = {}
        for path, value in checked_kind(overrides, "overrides", dict).items():
            if self.imu is None and "imu" not in overrides and str(path).startswith("imu."):
                raise InputError(
                    f"{path} = {shown(value)}: imu is None; expected all of it, as [imu] in a sensor's file, in a"
                    " simulation as imu = {...}, or in a recording as inertial = {...}"
                )
            table = self.table_of(checked_kind(path, "a name in overrides", str))
            named = path == "tower" and isinstance(value, str)
            name = path if path.partition(".")[0] == table else f"odometry.{path}"
            if name in full:
                raise InputError(f"overrides: {path} is given twice, also with odometry.; expected it once")
            full[name] = TowerSettings.preset(value) if named else value
        return super().override(full)


ARGUMENTS = {
    "trajectory": "flight.trajectory", "noise": "noise_name", "seed": "seed", "duration_s": "flight.duration_s",
    "tower": "tower",
}  # fmt: skip
"""Argument of `ExperimentSettings.preset` → its name in overrides. A method or sensor is chosen by its preset alone."""


def check_given_once(overrides: Mapping[str, Any], arguments: Mapping[str, Any]) -> None:
    """Raise `InputError` if one of the `ARGUMENTS` is given and in the overrides, too, also as part of a whole table.
    None: not given."""
    for name, value in arguments.items():
        full = ARGUMENTS[name]
        for again in {full, full.partition(".")[0]} & overrides.keys() if value is not None else ():
            told = f"{name} = {shown(value)}, and overrides with {again} = {shown(overrides[again])}"
            raise InputError(f"{told}: expected {name} once")
