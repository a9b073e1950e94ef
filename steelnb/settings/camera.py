"""Settings of a grey camera beside the Time-of-Flight sensor. Lengths in metres, angles in radians, times in s."""

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from steelnb.settings.base import Settings, mount
from steelnb.settings.presets import preset_table
from steelnb.types import Array


class CameraSettings(Settings):
    """A global-shutter pinhole camera with square pixels, optical axis along the camera's x axis, y left, z up.

    ``samples`` rays are cast through a pixel, spread over its area and over the time of the exposure, centred on the
    stamp: that smooths edges and blurs what moves. In the intervals ``blind_s`` (from, to) images are black.
    ``mount_m`` and ``mount_rpy_deg`` (roll, pitch, yaw about the drone's axes) place the camera on the drone.
    """

    columns: Annotated[int, Field(ge=8, le=4096)] = 422
    rows: Annotated[int, Field(ge=8, le=4096)] = 320
    fov_horizontal_rad: Annotated[float, Field(gt=0, lt=math.pi)] = 1.74
    rate_hz: Annotated[float, Field(gt=0, le=125)] = 10.0
    samples: Annotated[int, Field(ge=1, le=64)] = 4
    blind_s: tuple[tuple[float, float], ...] = ()
    mount_m: tuple[float, float, float] = (0.06, 0.0, 0.02)
    mount_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def focal_px(self) -> float:
        """Focal length in pixels, the same along both axes."""
        return self.columns / (2 * math.tan(self.fov_horizontal_rad / 2))

    @property
    def fov_vertical_rad(self) -> float:
        """Vertical field of view, which follows from square pixels."""
        return 2 * math.atan(self.rows / (2 * self.focal_px))

    @property
    def K(self) -> Array:
        """Intrinsics ``(3, 3)`` as `steelnb.images.CameraImages` has them."""
        f = self.focal_px
        return np.array([[f, 0, (self.columns - 1) / 2], [0, f, (self.rows - 1) / 2], [0, 0, 1]])

    @property
    def T_drone_camera(self) -> Array:
        """The mount of the camera, ``(4, 4)``."""
        return mount(self.mount_m, self.mount_rpy_deg)

    @classmethod
    def preset(cls, camera: str = "forward") -> "CameraSettings":
        """A camera of ``presets/cameras.toml`` by name: ``forward`` or ``tracking``. Raises `InputError`."""
        return cls(**preset_table("cameras", "camera", camera))
