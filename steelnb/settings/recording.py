"""What a recording or a cloud does not say itself: options of the commands, or keys of ``recording.toml`` beside it."""

import re
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator

from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.settings.base import Finite, NotNegative, Settings
from steelnb.settings.presets import read_toml
from steelnb.settings.world import CameraSettings

METRES = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
"""Units of length, metres."""


class RecordingOptions(Settings):
    """What the user states about a recording. Each field is an option of `steelnb run`, a keyword of `read_flight`, and
    a key of ``recording.toml``. None: as the data say."""

    lists_as: ClassVar[type] = tuple

    scans: str | None = None
    """Topic or sub-folder of the scans."""
    poses: str | None = None
    """Topic or file of the drone's poses, or frames of tf such as "odom>base_link"."""
    imu: str | None = None
    """Topic of the IMU."""
    truth: str | None = None
    """File of the true poses, for evaluation only."""
    mount: tuple[Finite, Finite, Finite, Finite, Finite, Finite] | None = None
    """Pose of the sensor on the drone: x, y, z in metres, roll, pitch, yaw in degrees."""
    mount_sigma: tuple[NotNegative, NotNegative] | None = None
    """Standard deviations of that pose, or of tf's: degrees about each axis, metres along it."""
    clock_sigma: NotNegative | None = None
    """Standard deviation of the delay of the scans' stamps, seconds."""
    optical: bool | None = None
    """Whether z is the optical axis of the sensor's frame (x right, y down, z ahead, REP 103), not x."""
    world: Literal["enu", "ned"] = "enu"
    """Axes of the poses' world: z up, or north, east, down, with the drone's axes forward, right, down."""
    scans_in: Literal["sensor", "world"] = "sensor"
    """The frame of the points of a folder's clouds."""
    clock: Literal["header", "bag"] = "header"
    """Stamps of the messages, or the times at which they were recorded."""
    time_offset: Finite = 0.0
    """Added to the stamps of the scans, seconds."""
    columns: tuple[str, ...] = ()
    """Names of the columns of a text file, in order; "_" for one to skip."""
    unit: str | None = None
    """Unit of the points of clouds and depth images, such as "mm", "0.25mm" or "ft"."""
    stamps: str | None = None
    """Stamps of a folder's clouds and of its poses: the unit of the numbers ("s", "ms", "us", "ns"), "in-order", or a
    file of stamps in seconds, one a cloud."""
    quaternion: Literal["xyzw", "wxyz"] = "xyzw"
    """Order of the quaternions in a trajectory without names."""
    calib: str | None = None
    """KITTI's calib.txt, whose ``Tr`` turns the poses of the camera to those of the scanner."""
    range: Annotated[Finite, Field(gt=0)] | None = None
    """Range of the sensor, metres."""

    @property
    def sigmas(self) -> dict[str, float]:
        """The settings of an odometry for ``mount_sigma`` and ``clock_sigma``."""
        rotation_deg, translation_m = self.mount_sigma or (None, None)
        names = "mount.rotation_sigma_deg", "mount.translation_sigma_m", "mount.time_sigma_s"
        found = zip(names, (rotation_deg, translation_m, self.clock_sigma), strict=True)
        return {name: sigma for name, sigma in found if sigma is not None}

    @field_validator("unit")
    @classmethod
    def _checked_unit(cls, unit: str | None) -> str | None:
        if unit is not None:
            metres_of(unit)
        return unit

    @property
    def unit_m(self) -> float | None:
        """The unit of the points in metres, None if the data say it."""
        return None if self.unit is None else metres_of(self.unit)

    @property
    def T_drone_sensor(self) -> Array | None:
        """The stated mount ``(4, 4)``."""
        if self.mount is None:
            return None
        return CameraSettings(mount_m=self.mount[:3], mount_rpy_deg=self.mount[3:]).T_drone_sensor


def read_options(folder: Path, **stated: Any) -> RecordingOptions:
    """What a user states about the data in a ``folder``: the keys of its ``recording.toml``, if there is one, and the
    ``stated`` options, which win unless they are None. Raises `InputError`, which names the file of a wrong key."""
    beside = {}
    if (path := folder / "recording.toml").is_file():
        beside = read_toml(path, "options of a recording")
        try:
            RecordingOptions(**beside)
        except InputError as fault:
            raise InputError(f"{path}: {fault}") from None
    return RecordingOptions(**beside | {name: value for name, value in stated.items() if value is not None})


def metres_of(unit: str) -> float:
    """Metres of a unit such as "mm" or "0.25mm". Raises ValueError."""
    found = re.fullmatch(r"(\d*\.?\d+)? ?([a-z]+)", unit)
    if not found or found[2] not in METRES or not float(found[1] or 1):
        raise ValueError(f"expected one of {', '.join(METRES)}, or a multiple such as 0.25mm")
    return float(found[1] or 1) * METRES[found[2]]
