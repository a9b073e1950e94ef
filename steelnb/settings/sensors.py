"""Settings of the simulated sensors: camera, Time-of-Flight camera, IMU. Estimators know only the IMU's.

Lengths in metres, angles in radians, times in seconds.
"""

import math
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from steelnb.core.errors import InputError
from steelnb.core.types import Array, IntArray
from steelnb.settings.base import Finite, NotNegative, Positive, Settings
from steelnb.settings.presets import sensor_preset
from steelnb.settings.report_plots import ReportPlot, checked_steps

TofFault = Literal["footprint", "exposure", "multipath", "amplitude", "wiggle", "calibration"]
"""Faults of a real camera beside range noise: mixed pixels at edges; motion during the exposure; multipath by a second
surface; noise and dropout that depend on the amplitude; an error periodic in the range; errors of offset and scale."""
STEPS_MAX = 2**31
"""Steps of the simulation are fewer, half a year."""
SCALE_MIN, SCALE_MAX = 0.8, 1.25
"""Bounds of the measured scale of ranges: other lengths are not in metres."""


class CameraSettings(Settings):
    """A pinhole camera on the drone. In the camera frame, x is the optical axis, y left, z up.

    ``mount_m`` and ``mount_rpy_deg``: its position, and its roll, pitch and yaw about the drone's axes.
    """

    lists_as = tuple

    columns: Annotated[int, Field(ge=1, le=4096)] = 64
    rows: Annotated[int, Field(ge=1, le=4096)] = 64
    fov_horizontal_rad: Annotated[float, Field(gt=0, lt=math.pi)] = 2.04
    fov_vertical_rad: Annotated[float, Field(gt=0, lt=math.pi)] = 2.04
    mount_m: tuple[Finite, Finite, Finite] = (0.06, 0.0, 0.0)
    mount_rpy_deg: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)

    @property
    def T_drone_sensor(self) -> Array:
        """The mount ``(4, 4)``; roll, pitch and yaw are about fixed axes (REP 103)."""
        from scipy.spatial.transform import Rotation  # half of the time to import the settings

        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xyz", self.mount_rpy_deg, degrees=True).as_matrix()
        T[:3, 3] = self.mount_m
        return T


class TofSettings(CameraSettings):
    """A Time-of-Flight camera, with ranges along the ray.

    The standard deviation of a range is ``max(sigma_floor_m, sigma_relative * range)``. With ``noise_on = "depth"``,
    noise and limit ``range_max_m`` apply to the depth along the optical axis; the output is still the range along the
    ray. Scans are taken at ``start_s + k / rate_hz``, k = 0, 1, …, rounded to the simulator's step; with ``samples``,
    instead at these steps of 8 ms from ``start_s`` on, or at those of the report's plot that it names, such as ``"3.5
    orbit gicp"``. In the intervals ``blind_s`` (from, to) there are no returns.

    ``pixel_origin``: where in its pixel the driver places a depth. The report's driver omits the half pixel to the
    ``centre``, so its points lie half a pixel too far left and up, towards the ``corner``. With ``faults``, the sensor
    has the errors of a real one (`steelnb.simulation.tof_faults`); the noise of a range then depends on the amplitude
    of its return. ``draw``: number of the draw of the range noise; draws of one seed differ in nothing else.

    Estimators are told what was measured before the flight: the camera reports ``range_scale`` times the distance plus
    ``range_offset_m``, and ``range_scale_sigma`` and ``range_offset_sigma_m`` are the standard deviations of these two.
    """

    range_max_m: Positive = 4.0
    sigma_floor_m: NotNegative = 0.04
    sigma_relative: NotNegative = 0.0
    noise_on: Literal["range", "depth"] = "range"
    pixel_origin: Literal["centre", "corner"] = "centre"
    rate_hz: Annotated[float, Field(gt=0, le=125)] = 5.0
    start_s: NotNegative = 0.0
    samples: str | tuple[int, ...] = ()
    draw: Annotated[int, Field(ge=0, lt=2**31)] = 0
    blind_s: tuple[tuple[Finite, Finite], ...] = ()
    faults: tuple[TofFault, ...] = ()
    range_scale: Annotated[float, Field(ge=SCALE_MIN, le=SCALE_MAX)] = 1.0
    range_offset_m: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    range_scale_sigma: NotNegative = 0.0
    range_offset_sigma_m: NotNegative = 0.0

    @model_validator(mode="after")
    def _has_pixels_and_steps(self) -> Self:
        if self.pixel_origin == "corner" and min(self.columns, self.rows) < 2:
            raise ValueError(
                f"pixel_origin = 'corner' with {self.columns} x {self.rows} pixels: expected an image, for half a pixel"
            )
        for gap in self.blind_s:
            if not gap[0] < gap[1]:
                raise ValueError(f"blind_s: {gap}: expected the first and last second of a gap, such as (60.0, 75.0)")
        self.sample_steps()  # raises for an unknown plot and for steps that do not increase
        return self

    def uncalibrated(self) -> Self:
        """The same camera without a measured calibration."""
        return self.replace(range_scale=1.0, range_offset_m=0.0, range_scale_sigma=0.0, range_offset_sigma_m=0.0)

    def sample_steps(self) -> IntArray:
        """The steps of ``samples (N,)``; empty if scans are evenly spaced. Raises `InputError`."""
        if isinstance(self.samples, str):
            return ReportPlot.named(self.samples).scans
        if max(self.samples, default=0) >= STEPS_MAX:
            raise InputError(f"step {max(self.samples)}; expected steps below {STEPS_MAX}")
        return checked_steps(np.array(self.samples, dtype=np.int64))

    @classmethod
    def preset(cls, sensor: str | Path) -> "TofSettings":
        """The sensor of ``presets/sensors/NAME.toml`` or of a file ``FILE.toml``. Raises `InputError`."""
        return cls(**sensor_preset(sensor).get("tof", {}))


class ImuSettings(Settings):
    """Errors of an IMU (`steelnb.simulation.imu`), equal on all three axes, zero by default.
    ``presets/sensors/starling2-honest.toml`` has the values of a real IMU, with their sources.

    ``..._noise``: white noise density, rad/s/√Hz and m/s²/√Hz; ``..._walk``: density of the bias random walk,
    rad/s²/√Hz and m/s³/√Hz; ``..._bias``: standard deviation of the initial bias, rad/s and m/s².
    """

    gyro_noise: NotNegative = 0.0
    gyro_walk: NotNegative = 0.0
    gyro_bias: NotNegative = 0.0
    accelerometer_noise: NotNegative = 0.0
    accelerometer_walk: NotNegative = 0.0
    accelerometer_bias: NotNegative = 0.0

    @classmethod
    def preset(cls, sensor: str | Path) -> "ImuSettings | None":
        """The IMU of a sensor's preset; None without one. Raises `InputError`."""
        table = sensor_preset(sensor).get("imu")
        return None if table is None else cls(**table)
