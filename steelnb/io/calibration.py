"""Mount, errors and intrinsics of a sensor in settings files, and the pinhole model of depth cameras.

Cameras look along z, x right, y down (optical frame, REP 103); the sensor frame here is the drone's: x forward, y left,
z up.
"""

from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from scipy.spatial.transform import Rotation

from steelnb.errors import FileContentError, SettingsError
from steelnb.files import new_file
from steelnb.settings import read_toml
from steelnb.settings.base import describe_fault, mount
from steelnb.types import Array

T_OPTICAL_SENSOR = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
"""From x forward, y left, z up to z forward, x right, y down."""
T_SENSOR_OPTICAL = T_OPTICAL_SENSOR.T
Positive = Annotated[float, Field(gt=0, lt=1e9)]
Offset = Annotated[float, Field(gt=-1e6, lt=1e6)]


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Extrinsics(_Table):
    """Pose of the sensor in the drone frame; the rotation as roll, pitch and yaw."""

    translation_m: tuple[Offset, Offset, Offset] = (0.0, 0.0, 0.0)
    rotation_rpy_deg: tuple[Offset, Offset, Offset] = (0.0, 0.0, 0.0)


class Intrinsics(_Table):
    """A pinhole depth camera, in pixels. ``depth_scale``: metres a unit of its images; None: the files' convention."""

    fx: Positive
    fy: Positive
    cx: float
    cy: float
    width: Annotated[int, Field(gt=0)] | None = None
    height: Annotated[int, Field(gt=0)] | None = None
    depth_scale: Positive | None = None

    @property
    def K(self) -> Array:
        """The matrix ``(3, 3)`` of the intrinsics."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def checked(self, image: NDArray, name: str = "") -> NDArray:
        """The image ``(H, W)`` itself; `FileContentError`, which begins with ``name``, if it is of another size."""
        rows, columns = image.shape
        if (self.height or rows, self.width or columns) == (rows, columns):
            return image
        raise FileContentError(f"{name}{columns} × {rows} pixels; expected {self.width} × {self.height}")


class SensorCorrection(_Table):
    """Known errors of a sensor: a range is measured as 1 + ``range_scale`` times the true one, plus ``range_offset_m``;
    scans were taken ``time_offset_s`` after their stamps."""

    range_offset_m: Annotated[float, Field(gt=-10, lt=10)] = 0.0
    range_scale: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0
    time_offset_s: Annotated[float, Field(gt=-10, lt=10)] = 0.0

    def described(self) -> str:
        """The errors in words."""
        offset_mm, scale, late_ms = 1e3 * self.range_offset_m, 100 * self.range_scale, 1e3 * self.time_offset_s
        return f"ranges {offset_mm:+.1f} mm and {scale:+.2f} % too long, taken {late_ms:+.1f} ms after the stamps"


class _Settings(_Table):
    extrinsics: Extrinsics | None = None
    intrinsics: Intrinsics | None = None
    errors: SensorCorrection = SensorCorrection()


def read_settings(path: Path | str | None) -> tuple[Array | None, Intrinsics | None]:
    """``T_drone_sensor`` and intrinsics from the tables ``[extrinsics]`` and ``[intrinsics]`` of a TOML file.

    Each is None where it, or the file, is not there. Raises `FileMissingError`, `SettingsError`.
    """
    settings = _read(path)
    extrinsics = settings.extrinsics
    T_drone_sensor = mount(extrinsics.translation_m, extrinsics.rotation_rpy_deg) if extrinsics else None
    return T_drone_sensor, settings.intrinsics


def read_correction(path: Path | str | None) -> SensorCorrection:
    """The table ``[errors]`` of a TOML file; no errors where it, or the file, is not there. Raises as
    `read_settings`."""
    return _read(path).errors


def _read(path: Path | str | None) -> _Settings:
    if path is None:
        return _Settings()
    try:
        return _Settings(**read_toml(Path(path), "a settings file"))
    except ValidationError as fault:
        raise SettingsError(describe_fault(str(path), fault)) from None


def write_settings(
    path: Path, T_drone_sensor: Array, correction: SensorCorrection, intrinsics: Intrinsics | None, note: str
) -> None:
    """Write a settings file that `read_settings` and `read_correction` read, with a ``note`` above it. Raises
    `OutputError`."""
    rpy_deg = Rotation.from_matrix(T_drone_sensor[:3, :3]).as_euler("xyz", degrees=True)
    tables: dict[str, dict[str, object]] = {
        "extrinsics": {
            "translation_m": [round(float(x), 6) for x in T_drone_sensor[:3, 3]],
            "rotation_rpy_deg": [round(float(x), 7) for x in rpy_deg],
        },
        "errors": {name: round(value, 7) for name, value in correction.model_dump().items()},
    }
    if intrinsics is not None:
        tables["intrinsics"] = intrinsics.model_dump(exclude_none=True)
    lines = [f"# {line}" for line in note.splitlines()]
    for name, table in tables.items():
        lines += ["", f"[{name}]", *(f"{key} = {value!r}" for key, value in table.items())]
    with new_file(path) as file:
        file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def depth_points(depth_m: NDArray, camera: Intrinsics) -> Array:
    """Points ``(H, W, 3)`` in the sensor frame from depths ``(H, W)`` along the optical axis, in metres.

    NaN where a depth is not finite or not positive.
    """
    depth = np.asarray(depth_m, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        depth = np.where((depth > 0) & np.isfinite(depth), depth, np.nan)
    left, up = _rays(*depth.shape, camera.fx, camera.fy, camera.cx, camera.cy)
    return np.stack([depth, depth * left, depth * up[:, None]], axis=-1)


def from_optical(points: Array) -> Array:
    """Points ``(..., 3)`` of an optical frame in the sensor frame."""
    return np.stack([points[..., 2], -points[..., 0], -points[..., 1]], axis=-1)


@lru_cache(maxsize=4)
def _rays(rows: int, columns: int, fx: float, fy: float, cx: float, cy: float) -> tuple[Array, Array]:
    return np.asarray((cx - np.arange(columns)) / fx), np.asarray((cy - np.arange(rows)) / fy)
