"""What a user may say about a recording that its files do not: which topics or files, extrinsics and intrinsics."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from scipy.spatial.transform import Rotation

from steelnb.datatypes import Array
from steelnb.errors import ExtrinsicsError, SettingsError
from steelnb.toml_file import read_toml

Numbers3 = tuple[float, float, float]
Numbers4 = tuple[float, float, float, float]


@dataclass(frozen=True)
class Choice:
    """What a user may name of a recording; None is found by type or by convention.

    ``scans`` is a topic or a sub-folder; ``poses``, and ``truth`` (which no estimator gets), a topic or a trajectory
    file; ``pictures`` a topic; ``settings`` a TOML file with tables ``[extrinsics]`` (``translation_m`` and
    ``rotation_xyzw`` or ``rotation_rpy_deg``, of the sensor in the drone's frame) and ``[intrinsics]``
    (``fx fy cx cy width height depth_scale``).
    """

    scans: str | None = None
    poses: str | None = None
    truth: str | None = None
    pictures: str | None = None
    settings: Path | None = None


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Extrinsics(_Table):
    """Where the sensor is on the drone: a translation and one of two forms of rotation, none for no rotation."""

    translation_m: Numbers3 = (0.0, 0.0, 0.0)
    rotation_xyzw: Numbers4 | None = None
    rotation_rpy_deg: Numbers3 | None = None

    def T_drone_sensor(self, where: str) -> Array:
        """The transform ``(4, 4)``. Raises `ExtrinsicsError`."""
        if self.rotation_xyzw and self.rotation_rpy_deg:
            raise ExtrinsicsError(f"{where}: rotation_xyzw and rotation_rpy_deg; expected one of them")
        result = np.eye(4)
        result[:3, 3] = self.translation_m
        if self.rotation_rpy_deg:
            # roll, pitch and yaw about the drone's axes (ROS and REP 103)
            result[:3, :3] = Rotation.from_euler("xyz", self.rotation_rpy_deg, degrees=True).as_matrix()
        elif self.rotation_xyzw:
            if np.linalg.norm(self.rotation_xyzw) < 1e-6:
                raise ExtrinsicsError(f"{where}: rotation_xyzw {self.rotation_xyzw}; expected a quaternion not zero")
            result[:3, :3] = Rotation.from_quat(self.rotation_xyzw).as_matrix()
        return result


class Intrinsics(_Table):
    """A depth camera: pinhole, in pixels; a depth image's number times ``depth_scale`` is metres.

    ``width`` and ``height`` are checked against the images where they are given; ``depth_scale`` None is the
    convention of the files.
    """

    fx: Annotated[float, Field(gt=0)]
    fy: Annotated[float, Field(gt=0)]
    cx: float
    cy: float
    width: Annotated[int, Field(gt=0)] | None = None
    height: Annotated[int, Field(gt=0)] | None = None
    depth_scale: Annotated[float, Field(gt=0)] | None = None


class _Settings(_Table):
    extrinsics: Extrinsics | None = None
    intrinsics: Intrinsics | None = None


def read_settings(path: Path | None) -> tuple[Array | None, Intrinsics | None]:
    """``T_drone_sensor`` and intrinsics of a settings file, each None where it, or the file, is not there.

    Raises `FileMissingError`, `SettingsError` and `ExtrinsicsError`.
    """
    if path is None:
        return None, None
    try:
        settings = _Settings(**read_toml(path, "a settings file"))
    except (ValidationError, TypeError) as fault:
        raise SettingsError(f"{path}: {_complaint(fault)}") from None
    extrinsics = settings.extrinsics
    return extrinsics.T_drone_sensor(f"{path}, [extrinsics]") if extrinsics else None, settings.intrinsics


def _complaint(fault: Any) -> str:
    if not isinstance(fault, ValidationError):
        return str(fault)
    first = fault.errors()[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}, got {str(first['input'])[:60]}"
