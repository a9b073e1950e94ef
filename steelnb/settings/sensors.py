"""Settings of the faults of an IMU. Defaults are those of a faultless one; values for a real one, with their sources,
are in ``presets/sensors/starling2-honest.toml``."""

from steelnb.settings.base import NotNegative, Settings
from steelnb.settings.presets import sensor_preset


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
