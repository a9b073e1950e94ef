"""Folders of depth images (TUM RGB-D, 7-Scenes) with a trajectory → parts of a flight.

The trajectories are of the camera, z forward; here they are turned and moved to the drone.
"""

import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steelnb.errors import FileContentError, FileMissingError, RecordingError, SettingsError, SteelnbError
from steelnb.files import reading
from steelnb.images import CameraImages, GreyImage
from steelnb.io.calibration import T_OPTICAL_SENSOR, T_SENSOR_OPTICAL, Intrinsics, depth_points
from steelnb.io.folders import TRAJECTORY, folder_settings, named_file, walk_files
from steelnb.io.images import RecordedImages, read_depth, read_grey
from steelnb.io.scans import Parts
from steelnb.io.trajectories import read_stamps, read_trajectory, rising, trajectory_of_matrices
from steelnb.types import Array, Trajectory

GROUNDTRUTH = "groundtruth.txt"
TUM_SCALE, SCENES_SCALE = 1 / 5000, 1 / 1000
"""Metres a unit of a depth image."""
SCENES_INVALID = 65535
SCENES_RATE_HZ = 30.0
CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3), "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6), "tum": (525.0, 525.0, 319.5, 239.5),
    "7-scenes": (585.0, 585.0, 320.0, 240.0),
}  # fmt: skip
"""fx, fy, cx, cy for 640 × 480 pixels as published with the data sets; of TUM by a part of a sequence's name."""
_FRAME = re.compile(r"frame-(\d+)\.depth\.png")


def is_tum(path: Path) -> bool:
    """Whether a folder is laid out as TUM RGB-D."""
    return (path / "depth.txt").is_file()


def is_scenes(path: Path) -> bool:
    """Whether a folder is laid out as 7-Scenes."""
    return path.is_dir() and any(_FRAME.fullmatch(file.name) for file in path.iterdir())


def open_tum(path: Path, scans: str | None, poses: str | None, truth: str | None, settings: Path | None) -> Parts:
    """The parts of a folder with ``depth.txt``, and ``trajectory.txt`` or ``groundtruth.txt`` or poses that are named.

    Raises `RecordingError` without images or poses, `FileContentError`, and `SettingsError` without intrinsics.
    """
    skipped: Counter[str] = Counter()
    listed = read_stamps(path / "depth.txt")
    if not listed or not all(name for _, name in listed):
        raise RecordingError(f"{path / 'depth.txt'}: no images; expected a stamp and a file's name a line")
    files = [path / name for _, name in listed]
    camera_name = next((name for name in CAMERAS if name in path.absolute().as_posix()), "tum")
    mount, camera, facts = _camera(path, settings, files, camera_name)
    name = poses or next((name for name in (TRAJECTORY, GROUNDTRUTH) if (path / name).is_file()), None)
    if name is None:
        raise RecordingError(f"{path}: no poses; expected {TRAJECTORY} or {GROUNDTRUTH}, or a trajectory that is named")
    facts |= {
        "form": "TUM RGB-D",
        "poses": ("true poses, " if Path(name).name == GROUNDTRUTH else "") + Path(name).name,
    }
    prior = _of_drone(read_trajectory(named_file(path, name), skipped), mount)
    load = partial(_read_depth_points, camera=camera, scale=camera.depth_scale or TUM_SCALE, invalid=0)
    return Parts(
        np.array([s for s, _ in listed]), partial(walk_files, files, load), prior, mount, facts, skipped=skipped
    )


def open_scenes(path: Path, scans: str | None, poses: str | None, truth: str | None, settings: Path | None) -> Parts:
    """The parts of a folder of ``frame-000000.depth.png`` and ``.pose.txt``, 30 a second.

    Raises as `open_tum`.
    """
    skipped: Counter[str] = Counter()
    files, stamp_s = _frames(path)
    mount, camera, facts = _camera(path, settings, files, "7-scenes")
    prior = read_trajectory(named_file(path, poses), skipped) if poses else _frame_poses(path, files, stamp_s, skipped)
    facts |= {"form": "7-Scenes", "poses": Path(poses).name if poses else "true poses"}
    load = partial(_read_depth_points, camera=camera, scale=camera.depth_scale or SCENES_SCALE, invalid=SCENES_INVALID)
    images, facts["images"] = _colours(files, stamp_s, camera, mount)
    walk = partial(walk_files, files, load)
    return Parts(stamp_s, walk, _of_drone(prior, mount), mount, facts, skipped=skipped, images=images)


def _colours(
    files: Sequence[Path], stamp_s: Array, camera: Intrinsics, mount: Array
) -> tuple[CameraImages | None, str]:
    """Grey levels of the colour images beside depth images, and what they are in words. Intrinsics and mount are taken
    to be those of the depth images: 7-Scenes gives no others."""
    shown = [file.with_name(file.name.replace(".depth.png", ".color.jpg")) for file in files]
    shown = [file if file.is_file() else file.with_suffix(".png") for file in shown]
    number = np.flatnonzero(rising(stamp_s, Counter()) & [file.is_file() for file in shown])
    if not len(number):
        return None, "none: no frame-000000.color.jpg or .color.png"

    def load(file: Path) -> GreyImage:
        return camera.checked(read_grey(file), f"{file}: ")

    images = RecordedImages(len(number), lambda: (partial(load, shown[k]) for k in number))
    return CameraImages(stamp_s[number], images, camera.K, mount), f"{len(number)} of colour, as the depth images are"


def read_depth_truth(path: Path, truth: str | None, settings: Path | None) -> Trajectory | None:
    """The drone's true poses from the camera's: of the trajectory named, ``groundtruth.txt`` or the frames' poses."""
    T_drone_sensor, _, _ = folder_settings(path, settings)
    if truth is not None or is_tum(path):
        file = named_file(path, truth) if truth else path / GROUNDTRUTH
        found = read_trajectory(file) if file.is_file() else None
    else:
        files, stamp_s = _frames(path)
        found = _frame_poses(path, files, stamp_s, Counter())
    return None if found is None else _of_drone(found, T_drone_sensor)


def _read_depth_points(file: Path, camera: Intrinsics, scale: float, invalid: int) -> Array:
    depth = camera.checked(read_depth(file), f"{file}: ")
    return depth_points(np.where(depth == invalid, 0, depth) * scale, camera)


def _camera(
    path: Path, settings: Path | None, images: Sequence[Path], published: str
) -> tuple[Array, Intrinsics, dict[str, str]]:
    """``T_drone_sensor``, and the camera of settings, or as published. Raises `SettingsError` where the images are of
    another size."""
    T_drone_sensor, camera, file = folder_settings(path, settings)
    source = str(file)
    if camera is None:
        fx, fy, cx, cy = CAMERAS[published]
        camera, source = Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=640, height=480), f"published for {published}"
    try:
        camera.checked(_first(images))
    except FileContentError as fault:
        raise SettingsError(
            f"{path}: images of {fault}, as the intrinsics {source} say; others want [intrinsics] in a settings file"
        ) from None
    said = f"fx {camera.fx:.6g}, fy {camera.fy:.6g}, cx {camera.cx:.6g}, cy {camera.cy:.6g}: {source}"
    return T_drone_sensor, camera, {"intrinsics": said}


def _first(images: Sequence[Path]) -> NDArray[np.uint16]:
    """The first image that can be read. Raises as `read_depth` where none can."""
    for image in images[:-1]:
        with suppress(SteelnbError):
            return read_depth(image)
    return read_depth(images[-1])


def _frames(path: Path) -> tuple[list[Path], Array]:
    """Images and stamps of 7-Scenes."""
    numbers = {file: int(found[1]) for file in path.iterdir() if (found := _FRAME.fullmatch(file.name))}
    files = sorted(numbers, key=lambda file: (numbers[file], file.name))
    return files, np.array([numbers[file] / SCENES_RATE_HZ for file in files])


def _frame_poses(path: Path, files: Sequence[Path], stamp_s: Array, skipped: Counter[str]) -> Trajectory:
    """The camera's poses ``frame-000000.pose.txt``, world z up; missing ones are counted, broken ones an error.

    The world of 7-Scenes has the axes of a camera held level, y down.
    """
    poses, stamps = [], []
    for file, stamp in zip(files, stamp_s.tolist(), strict=True):
        pose_file = file.with_name(file.name.replace(".depth.png", ".pose.txt"))
        try:
            with reading(pose_file, "the 16 numbers of a 4 × 4 pose"):
                poses.append(np.array(pose_file.read_text().split(), dtype=float).reshape(4, 4))
            stamps.append(stamp)
        except FileMissingError:
            skipped["missing pose file"] += 1
    if not poses:
        raise RecordingError(
            f"{path}: no poses; expected frame-000000.pose.txt beside each image, or a trajectory named"
        )
    camera = trajectory_of_matrices(path, np.array(stamps), np.array(poses), skipped)
    return Trajectory(camera.stamp_s, T_SENSOR_OPTICAL @ camera.T_world_drone)


def _of_drone(camera: Trajectory, T_drone_sensor: Array) -> Trajectory:
    """The drone's poses from those of a camera that looks along z."""
    return Trajectory(camera.stamp_s, camera.T_world_drone @ T_OPTICAL_SENSOR @ np.linalg.inv(T_drone_sensor))
