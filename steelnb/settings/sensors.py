"""Settings of an IMU's errors. The defaults are those of a faultless IMU; ``presets/sensors/starling2-honest.toml`` has
values of a real one, with their sources."""

from steelnb.settings.base import NotNegative, Settings
from steelnb.settings.presets import sensor_preset


class ImuSettings(Settings):
    """Errors of an IMU (`steelnb.simulation.imu`), each the same on its three axes.

    ``..._noise``: white noise density, rad/s/√Hz and m/s²/√Hz; ``..._walk``: density of the bias random walk,
    rad/s²/√Hz and m/s³/√Hz; ``..._bias``: standard deviation of the bias at the start, rad/s and m/s².
    """

    gyro_noise: NotNegative = 0.0
    gyro_walk: NotNegative = 0.0
    gyro_bias: NotNegative = 0.0
    accelerometer_noise: NotNegative = 0.0
    accelerometer_walk: NotNegative = 0.0
    accelerometer_bias: NotNegative = 0.0

    @classmethod
    def preset(cls, sensor: str) -> "ImuSettings | None":
        """The IMU of a sensor's preset; None without one. Raises `InputError`."""
        table = sensor_preset(sensor).get("imu")
        return None if table is None else cls(**table)
