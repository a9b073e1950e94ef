"""The cameras of depth images, from files or from the points themselves, and points → depths."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from steelnb.datatypes import Array
from steelnb.errors import FileContentError, FileMissingError, RecordingError, SettingsError
from steelnb.recordings.choice import Choice, Intrinsics, read_settings
from steelnb.recordings.cloud_folders import settings_file
from steelnb.recordings.images import size_of
from steelnb.recordings.recording import ScanSource
from steelnb.recordings.stamps import text_lines

CAMERA_FILES = ("camera.txt", "intrinsics.txt", "camera-intrinsics.txt")
LARGEST = 65535
OFF_PIXELS = 0.05
"""A camera's points lie nearer than this to the middles of their pixels."""
FEWEST = 50
"""Points that tell a camera."""


def camera_of(
    path: Path, choice: Choice, images: Sequence[Path], default: Intrinsics | None, said: str, facts: dict[str, str]
) -> tuple[Array, Intrinsics]:
    """``T_drone_sensor`` and the camera of a folder of depth images, the first that there is.

    Settings that a user names, settings in the folder, a file of numbers (`CAMERA_FILES`), and the ``default`` of a
    data set, as ``said``, where images have its size. Raises `SettingsError` without any, or where sizes do not fit.
    """
    settings = settings_file(path, choice)
    T_drone_sensor, camera = read_settings(settings)
    source = str(settings.name) if settings and camera else ""
    numbers = next((path / name for name in CAMERA_FILES if (path / name).is_file()), None)
    size = _first_size(images)
    if camera is None and numbers is not None:
        camera, source = read_camera(numbers), numbers.name
    if camera is None and default is not None and size in (None, (default.height, default.width)):
        camera, source = default, said
    if camera is None:
        raise SettingsError(
            f"{path}: no intrinsics for images of {size[1]} × {size[0]} pixels; expected [intrinsics] with fx, fy, cx "
            f"and cy in a settings file, or {CAMERA_FILES[0]}"
            if size
            else f"{path}: no intrinsics, and no image that could be read"
        )
    if size and (camera.height or size[0], camera.width or size[1]) != size:
        raise SettingsError(
            f"{path}: intrinsics for {camera.width} × {camera.height} pixels; expected the images' "
            f"{size[1]} × {size[0]}"
        )
    facts["intrinsics"] = f"fx {camera.fx:.6g}, fy {camera.fy:.6g}, cx {camera.cx:.6g}, cy {camera.cy:.6g}: {source}"
    if size:
        facts["images"] = f"{size[1]} × {size[0]}"
    return np.eye(4) if T_drone_sensor is None else T_drone_sensor, camera


def read_camera(path: Path) -> Intrinsics:
    """A file of ``fx fy cx cy``, maybe followed by ``width height`` and a depth scale, or of a 3 × 3 camera matrix."""
    values: list[float] = []
    for number, line in text_lines(path):
        try:
            values += [float(word) for word in line.replace(",", " ").split()]
        except ValueError:
            raise SettingsError(f"{path}, line {number}: {line[:60]!r}; expected numbers: fx fy cx cy") from None
    if len(values) == 9 and values[6:] == [0, 0, 1]:
        values = [values[0], values[4], values[2], values[5]]
    if len(values) not in (4, 6, 7):
        raise SettingsError(f"{path}: {len(values)} numbers; expected fx fy cx cy, or a 3 × 3 camera matrix")
    names = ("fx", "fy", "cx", "cy", "width", "height", "depth_scale")
    try:
        return Intrinsics(**dict(zip(names, values, strict=False)))  # type: ignore[arg-type]
    except ValidationError as fault:
        first = fault.errors()[0]
        raise SettingsError(f"{path}: {first['loc'][0]} = {first['input']}; {first['msg']}") from None


def camera_of_scans(path: Path, scans: ScanSource) -> Intrinsics:
    """The pinhole camera whose images some scans ``(H, W, 3)`` are, from the first that tells.

    Raises `RecordingError` where none is an image of one.
    """
    for scan in scans.walk():
        if scan.points.ndim != 3:
            continue
        rows, columns = scan.points.shape[:2]
        v, u = np.nonzero(np.isfinite(scan.points).all(axis=2) & (scan.points[..., 0] > 0))
        if len(u) < FEWEST or min(np.ptp(u), np.ptp(v)) < min(rows, columns) / 4:
            continue
        x, y, z = scan.points[v, u].T
        (across, left), (down, up) = np.polyfit(u, y / x, 1), np.polyfit(v, z / x, 1)
        if across < 0 and down < 0:
            fx, fy = -1 / float(across), -1 / float(down)
            camera = Intrinsics(fx=fx, fy=fy, cx=fx * float(left), cy=fy * float(up), width=columns, height=rows)
            _refuse_off(path, scan.points, camera)
            return camera
    raise RecordingError(f"{path}: no scan is an image of a pinhole camera; expected that for depth images")


def depths_of(path: Path, points: Array, camera: Intrinsics) -> Array:
    """Depths ``(H, W)`` along the optical axis, metres, NaN for none, of a scan in the sensor frame.

    Raises `RecordingError` for points that are not those of the camera's pixels.
    """
    if not points.size:
        return np.full((camera.height or 0, camera.width or 0), np.nan)
    _refuse_off(path, points, camera)
    return np.where(np.isfinite(points).all(axis=2), points[..., 0], np.nan)


def _refuse_off(path: Path, points: Array, camera: Intrinsics) -> None:
    if points.ndim != 3 or points.shape[:2] != (camera.height, camera.width):
        raise RecordingError(
            f"{path}: a scan of shape {points.shape}; expected ({camera.height}, {camera.width}, 3) for depth images"
        )
    with np.errstate(invalid="ignore", divide="ignore"):
        u = camera.cx - camera.fx * points[..., 1] / points[..., 0] - np.arange(points.shape[1])
        v = camera.cy - camera.fy * points[..., 2] / points[..., 0] - np.arange(points.shape[0])[:, None]
        off = float(np.nanmax(np.abs([u, v]), initial=0.0))
    if not off < OFF_PIXELS:
        raise RecordingError(
            f"{path}: a point {off:.3g} pixels from the middle of its own; expected a pinhole camera's for depth images"
        )


def _first_size(images: Sequence[Path]) -> tuple[int, int] | None:
    for image in images:
        try:
            return size_of(image)
        except (FileContentError, FileMissingError, OSError):
            continue
    return None
