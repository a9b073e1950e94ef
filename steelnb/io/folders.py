"""Folders of clouds, a file a scan, and of depth images (TUM RGB-D, 7-Scenes), with a trajectory → parts of a flight.

The trajectories of depth images are of the camera, z forward; here they are turned and moved to the drone.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steelnb.errors import (
    FileContentError,
    FileMissingError,
    RecordingError,
    SettingsError,
    SteelnbError,
    TopicError,
)
from steelnb.files import reading, text_lines
from steelnb.io.bag_files import PIXELS_MAX
from steelnb.io.calibration import T_OPTICAL_SENSOR, T_SENSOR_OPTICAL, Intrinsics, depth_points, read_settings
from steelnb.io.clouds import read_points
from steelnb.io.scans import Decode, Parts
from steelnb.io.trajectories import (
    STAMP_FILES,
    holds_poses,
    read_stamps,
    read_trajectory,
    stamps_beside,
    stamps_of_names,
    trajectory_of_matrices,
)
from steelnb.types import Array, IntArray, Trajectory

CLOUDS = (".ply", ".pcd", ".las", ".laz", ".npy")
TRAJECTORY = "trajectory.txt"
SETTINGS_FILES = ("settings.toml", "intrinsics.toml")
TEXTS = (".tum", ".txt", ".csv", ".kitti", ".poses")
TRUE = ("groundtruth", "ground_truth", "gt")
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


def is_cloud_folder(path: Path) -> bool:
    """Whether a folder, or one of its sub-folders, holds clouds."""
    return path.is_dir() and any(_clouds(folder) for folder in (path, *_folders(path)))


def open_clouds(path: Path, scans: str | None, poses: str | None, truth: str | None, settings: Path | None) -> Parts:
    """The parts of a folder of clouds in the sensor frame, with a trajectory of the drone.

    ``scans`` names a sub-folder or a pattern such as ``*.pcd``; ``poses`` a trajectory file, else it is the only file
    with poses. Stamps are in file names, in a file of stamps, or, where there are as many, those of the poses. Raises
    `RecordingError`, `TopicError`, `FileContentError`, and what settings raise.
    """
    skipped: Counter[str] = Counter()
    files = _cloud_files(path, scans)
    T_drone_sensor, _ = read_settings(settings_file(path, settings))
    stamp_s, source = _scan_stamps(path, files)
    file = named_file(path, poses) if poses else _trajectory_file(path)
    prior = read_trajectory(file, skipped, stamp_s)
    if stamp_s is None:
        if len(prior) != len(files):
            raise RecordingError(
                f"{path}: {len(files)} clouds without stamps, {len(prior)} poses in {file.name}; expected as many, or "
                f"stamps in the clouds' names or in one of {', '.join(STAMP_FILES)}"
            )
        stamp_s, source = prior.stamp_s, file.name
    said = f"true poses, {file.name}" if file.stem.lower() in TRUE else file.name
    facts = {"form": "folder of clouds", "scans": f"{len(files)} × {files[0].suffix.lower()}", "stamps": source}
    mount = np.eye(4) if T_drone_sensor is None else T_drone_sensor
    return Parts(
        stamp_s, partial(walk_files, files, read_points), prior, mount, facts | {"poses": said}, skipped=skipped
    )


def read_clouds_truth(path: Path, truth: str | None, settings: Path | None) -> Trajectory | None:
    """The trajectory named, or the one in the folder whose name says that it is true (``groundtruth.txt``)."""
    if truth is not None:
        return read_trajectory(named_file(path, truth))
    inside = [file for file in sorted(path.iterdir()) if file.stem.lower() in TRUE and file.suffix.lower() in TEXTS]
    return read_trajectory(inside[0]) if inside and holds_poses(inside[0]) else None


def walk_files(files: Sequence[Path], load: Callable[[Path], Array], number: IntArray) -> Iterator[Decode]:
    """The scans of numbered files, as `Parts` walks them."""
    return (partial(load, files[k]) for k in number.tolist())


def settings_file(path: Path, settings: Path | None) -> Path | None:
    """The settings that a user names, or those in the folder."""
    return settings or next((path / name for name in SETTINGS_FILES if (path / name).is_file()), None)


def named_file(path: Path, name: str) -> Path:
    """A file that a user names, from here or from the folder. Raises `FileMissingError`."""
    for file in (Path(name), path / name):
        if file.is_file():
            return file
    raise FileMissingError(f"{name}: no such file, here or in {path}; expected a trajectory")


def _scan_stamps(path: Path, files: list[Path]) -> tuple[Array | None, str]:
    """Stamps of files and their source: their names, or a file of stamps with them or above; None without."""
    named = stamps_of_names([file.stem for file in files])
    if named is not None:
        return named, "file names"
    times = stamps_beside(files[0]) or stamps_beside(path)
    if times is None:
        return None, ""
    listed = read_stamps(times)
    by_name = {Path(rest.split(",")[0].strip()).name: stamp for stamp, rest in listed if rest}
    if all(file.name in by_name for file in files):
        return np.array([by_name[file.name] for file in files]), times.name
    if len(listed) != len(files):
        raise RecordingError(f"{times}: {len(listed)} stamps; expected {len(files)}, one a {files[0].suffix} file")
    return np.array([stamp for stamp, _ in listed]), times.name


def _trajectory_file(path: Path) -> Path:
    """`TRAJECTORY`, or else the only file that holds poses. Raises `RecordingError`, `TopicError`."""
    if (path / TRAJECTORY).is_file():
        return path / TRAJECTORY
    texts = [f for f in sorted(path.iterdir()) if f.suffix.lower() in TEXTS and f.name not in STAMP_FILES]
    found = [file for file in texts if file.is_file() and holds_poses(file)]
    found = [file for file in found if file.stem.lower() not in TRUE] or found
    if not found:
        raise RecordingError(f"{path}: no trajectory; expected a TUM, KITTI or EuRoC file in it, or one named")
    if len(found) > 1:
        names = ", ".join(file.name for file in found)
        raise TopicError(f"{path}: several files hold poses: {names}; expected one of them to be named as the poses")
    return found[0]


def _cloud_files(path: Path, scans: str | None) -> list[Path]:
    """The clouds of a folder by the numbers in their names: 9 before 10. Raises `RecordingError`, `TopicError`."""
    folder, pattern = path, "*"
    if scans is not None and "*" in scans:
        pattern = scans
    elif scans is not None:
        folder = path / scans
        if not folder.is_dir():
            names = ", ".join(each.name for each in _folders(path)) or "none"
            raise TopicError(f"{path}: no folder {scans!r}; expected one of {names}")
    elif not _clouds(path):
        holding = [each for each in _folders(path) if _clouds(each)]
        if len(holding) > 1:
            raise TopicError(f"{path}: clouds in {', '.join(each.name for each in holding)}; expected one to be named")
        folder = holding[0] if holding else path
    files = [file for file in _clouds(folder) if file.match(pattern)]
    endings = sorted({file.suffix.lower() for file in files})
    if not files:
        raise RecordingError(f"{folder}: no clouds; expected files that end with one of {', '.join(CLOUDS)}")
    if len(endings) > 1:
        raise TopicError(f"{folder}: clouds that end with {', '.join(endings)}; expected one to be named, as '*.ply'")
    return sorted(files, key=_natural)


def _natural(file: Path) -> list[tuple[float, str]]:
    pieces = re.split(r"(\d+(?:\.\d+)?)", file.stem)
    return [(float(piece), piece) if k % 2 else (-1.0, piece) for k, piece in enumerate(pieces)]


def _clouds(folder: Path) -> list[Path]:
    return [file for file in folder.iterdir() if file.suffix.lower() in CLOUDS and not file.name.startswith(".")]


def _folders(path: Path) -> list[Path]:
    return sorted(each for each in path.iterdir() if each.is_dir() and not each.name.startswith("."))


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
    """The parts of a folder of ``frame-000000.depth.png`` and ``.pose.txt``, 30 a second or by ``timestamps.txt``.

    Raises as `open_tum`.
    """
    skipped: Counter[str] = Counter()
    files, stamp_s, source = _frames(path)
    mount, camera, facts = _camera(path, settings, files, "7-scenes")
    prior = read_trajectory(named_file(path, poses), skipped) if poses else _frame_poses(path, files, stamp_s, skipped)
    facts |= {"form": "7-Scenes", "stamps": source, "poses": Path(poses).name if poses else "true poses"}
    load = partial(_read_depth_points, camera=camera, scale=camera.depth_scale or SCENES_SCALE, invalid=SCENES_INVALID)
    return Parts(stamp_s, partial(walk_files, files, load), _of_drone(prior, mount), mount, facts, skipped=skipped)


def read_depth_truth(path: Path, truth: str | None, settings: Path | None) -> Trajectory | None:
    """The drone's true poses from the camera's: of the trajectory named, ``groundtruth.txt`` or the frames' poses."""
    T_drone_sensor, _ = read_settings(settings_file(path, settings))
    if truth is not None or is_tum(path):
        file = named_file(path, truth) if truth else path / GROUNDTRUTH
        found = read_trajectory(file) if file.is_file() else None
    else:
        files, stamp_s, _ = _frames(path)
        found = _frame_poses(path, files, stamp_s, Counter())
    return None if found is None else _of_drone(found, np.eye(4) if T_drone_sensor is None else T_drone_sensor)


def _read_depth_points(file: Path, camera: Intrinsics, scale: float, invalid: int) -> Array:
    depth = read_depth(file)
    if fault := camera.differs(*depth.shape):
        raise FileContentError(f"{file}: {fault}")
    return depth_points(np.where(depth == invalid, 0, depth) * scale, camera)


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Numbers ``(H, W)`` of a 16-bit grey PNG file. Raises `FileContentError` and `FileMissingError`."""
    from PIL import Image

    with reading(path, "a 16-bit grey PNG"), Image.open(path, formats=["PNG"]) as image:
        if image.width * image.height > PIXELS_MAX:
            raise FileContentError(f"{path}: {image.width} × {image.height} pixels; expected at most {PIXELS_MAX}")
        pixels = np.asarray(image)
    if pixels.ndim != 2 or pixels.dtype.kind not in "iu" or pixels.dtype.itemsize < 2:
        raise FileContentError(f"{path}: {pixels.dtype} pixels of shape {pixels.shape}; expected a 16-bit grey PNG")
    return pixels.astype(np.uint16)


def _camera(
    path: Path, settings: Path | None, images: Sequence[Path], published: str
) -> tuple[Array, Intrinsics, dict[str, str]]:
    """``T_drone_sensor``, and the camera of settings, or as published for images of its size."""
    file = settings_file(path, settings)
    T_drone_sensor, camera = read_settings(file)
    source = str(file)
    size = _size(images)
    if camera is None and size in (None, (480, 640)):
        fx, fy, cx, cy = CAMERAS[published]
        camera, source = Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=640, height=480), f"published for {published}"
    if camera is None:
        raise SettingsError(
            f"{path}: no intrinsics for images of {size[1]} × {size[0]} pixels; "  # type: ignore[index]
            "expected [intrinsics] with fx, fy, cx and cy in a settings file"
        )
    if size and (fault := camera.differs(*size)):
        raise SettingsError(f"{path}: images of {fault}, as the intrinsics of {source} say")
    said = f"fx {camera.fx:.6g}, fy {camera.fy:.6g}, cx {camera.cx:.6g}, cy {camera.cy:.6g}: {source}"
    return np.eye(4) if T_drone_sensor is None else T_drone_sensor, camera, {"intrinsics": said}


def _size(images: Sequence[Path]) -> tuple[int, int] | None:
    """Rows and columns of the first image that can be read."""
    for image in images:
        try:
            rows, columns = read_depth(image).shape
        except SteelnbError:
            continue
        return rows, columns
    return None


def _frames(path: Path) -> tuple[list[Path], Array, str]:
    """Images and stamps of 7-Scenes, and where the stamps are from."""
    numbers = {file: int(found[1]) for file in path.iterdir() if (found := _FRAME.fullmatch(file.name))}
    files = sorted(numbers, key=lambda file: (numbers[file], file.name))
    times = path / "timestamps.txt"
    if not times.is_file():
        return (
            files,
            np.array([numbers[file] / SCENES_RATE_HZ for file in files]),
            f"frame numbers at {SCENES_RATE_HZ:g} Hz",
        )
    stamps = [stamp for stamp, _ in read_stamps(times)]
    if len(stamps) != len(files):
        raise RecordingError(f"{times}: {len(stamps)} stamps; expected {len(files)}, one an image")
    return files, np.array(stamps), times.name


def _frame_poses(path: Path, files: Sequence[Path], stamp_s: Array, skipped: Counter[str]) -> Trajectory:
    """The camera's poses ``frame-000000.pose.txt``, world z up; missing ones are counted, broken ones an error.

    The world of 7-Scenes has the axes of a camera held level, y down.
    """
    poses, stamps = [], []
    for file, stamp in zip(files, stamp_s.tolist(), strict=True):
        pose_file = file.with_name(file.name.replace(".depth.png", ".pose.txt"))
        try:
            with reading(pose_file, "the 16 numbers of a 4 × 4 pose"):
                words = [word for _, line in text_lines(pose_file) for word in line.split()]
                poses.append(np.array(words, dtype=float).reshape(4, 4))
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
