"""Settings of the faults of real sensors: a Time-of-Flight camera's and an IMU's.

Defaults are those of a faultless sensor; values for a real one, with their sources, are in
``presets/sensors/starling2-honest.toml``.
"""

from typing import Annotated

from pydantic import Field

from steelnb.settings.base import NotNegative, Positive, Probability, Settings
from steelnb.settings.presets import sensor_preset


class TofFaultSettings(Settings):
    """What a real Time-of-Flight camera adds to the range noise of `TofSettings` (`steelnb.simulation.exposure`).

    ``footprint_px``: width of the patch that a pixel sees, in pixels, which makes mixed pixels at depth edges;
    ``lateral_px``: standard deviation of its place across the ray; ``exposure_s``: time over which a scan is taken,
    centred on its stamp; ``multipath``: share of the light that goes on from one surface to the next, where 1 is a
    matt surface; ``reflectivity``: that of all surfaces by that of the data sheet's target; ``sigma_max_m``: a pixel is
    dropped where the noise that its amplitude promises is higher. ``wiggle_m``: amplitude of the error that is periodic
    in the range. ``offset_sigma_m`` and ``scale_sigma``: standard deviations, over the cameras of a kind, of a constant
    error of the range and of one in proportion to it; each seed has a camera of its own.
    """

    footprint_px: Annotated[float, Field(ge=0, le=10)] = 0.0
    lateral_px: Annotated[float, Field(ge=0, le=10)] = 0.0
    exposure_s: Annotated[float, Field(ge=0, le=1)] = 0.0
    multipath: Probability = 0.0
    reflectivity: Positive = 1.0
    sigma_max_m: Positive = 1.0
    wiggle_m: NotNegative = 0.0
    offset_sigma_m: NotNegative = 0.0
    scale_sigma: Annotated[float, Field(ge=0, le=0.1)] = 0.0


class ImuSettings(Settings):
    """Errors of an IMU (`steelnb.simulation.imu`), each the same on its three axes.

    ``..._noise``: density of the white noise, rad/s/√Hz and m/s²/√Hz; ``..._walk``: density of the random walk of the
    bias, rad/s²/√Hz and m/s³/√Hz; ``..._bias``: standard deviation of the bias that calibration left at the start,
    rad/s and m/s².
    """

    gyro_noise: NotNegative = 0.0
    gyro_walk: NotNegative = 0.0
    gyro_bias: NotNegative = 0.0
    accelerometer_noise: NotNegative = 0.0
    accelerometer_walk: NotNegative = 0.0
    accelerometer_bias: NotNegative = 0.0

    @classmethod
    def preset(cls, sensor: str) -> "ImuSettings | None":
        """The IMU beside a sensor, or None where its preset has none. Raises `InputError`."""
        table = sensor_preset(sensor).get("imu")
        return None if table is None else cls(**table)
