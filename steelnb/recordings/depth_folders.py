"""Folders of depth images, as TUM RGB-D and 7-Scenes lay them out ↔ `Recording`.

Their trajectories are of the camera, z forward; ours are of the drone, so poses are turned and moved to it. Both data
sets hold true poses alone. What we write holds the poses as recorded in a further file, ``trajectory.txt``.
"""

import re
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from steelnb.datatypes import Array, Trajectory
from steelnb.errors import FileContentError, FileMissingError, RecordingError
from steelnb.recordings.choice import Choice, Intrinsics
from steelnb.recordings.cloud_folders import (
    SETTINGS,
    TRAJECTORY,
    Progress,
    named_file,
    truth_beside,
    truth_of,
    write_settings,
)
from steelnb.recordings.depth_images import LARGEST, camera_of, camera_of_scans, depths_of
from steelnb.recordings.file_scans import FilePictures, FileScans, chosen
from steelnb.recordings.images import read_depth, read_picture, write_png
from steelnb.recordings.imu_files import IMU, read_imu, write_imu
from steelnb.recordings.pinhole import T_OPTICAL_SENSOR, depth_points
from steelnb.recordings.recording import GAP_MAX_S, Recording, interpolate
from steelnb.recordings.stamps import name_of, read_list, read_stamps, rising, text_lines
from steelnb.recordings.trajectories import read_trajectory, trajectory_of_matrices, write_tum

TUM_SCALE, SCENES_SCALE = 1 / 5000, 1 / 1000
"""Metres a unit."""
SCENES_RATE_HZ = 30.0
TUM_CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3), "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6), "": (525.0, 525.0, 319.5, 239.5),
}  # fmt: skip
"""As published with the sequences, by a part of their names; without one, the driver's default."""
SCENES_CAMERA = (585.0, 585.0, 320.0, 240.0)
_FRAME = re.compile(r"frame-(\d+)\.depth\.png")


def is_tum(path: Path) -> bool:
    """Whether a folder is laid out as TUM RGB-D."""
    return (path / "depth.txt").is_file()


def is_scenes(path: Path) -> bool:
    """Whether a folder is laid out as 7-Scenes."""
    return path.is_dir() and any(_FRAME.fullmatch(file.name) for file in path.iterdir())


def open_tum(path: Path, choice: Choice) -> Recording:
    """A folder with ``depth.txt``, maybe ``rgb.txt``, and ``groundtruth.txt`` or ``trajectory.txt``.

    Raises `RecordingError` without images or poses, `FileContentError`, and `SettingsError` without intrinsics.
    """
    skipped: Counter[str] = Counter()
    facts = {"form": "TUM RGB-D"}
    stamp_s, files = _listed(path / "depth.txt")
    default = next(numbers for name, numbers in TUM_CAMERAS.items() if name in path.absolute().as_posix())
    said = f"published default of {next(n for n in TUM_CAMERAS if n in path.absolute().as_posix()) or 'the driver'}"
    T_drone_sensor, camera = camera_of(path, choice, files, _kinect(default), said, facts)
    poses, true = _tum_poses(path, choice, T_drone_sensor, skipped, facts)
    stamp_s, files = chosen(path, stamp_s, files, skipped)
    load = partial(_load, camera=camera, scale=camera.depth_scale or TUM_SCALE, invalid=0)
    return Recording(
        path, FileScans(stamp_s, files, load, skipped, facts), poses, T_drone_sensor, read_imu(path / IMU, skipped),
        truth=_truth(path, choice, T_drone_sensor, skipped, facts, poses if true else None),
        pictures=_pictures(*_listed(path / "rgb.txt"), skipped) if (path / "rgb.txt").is_file() else None,
        skipped=skipped, facts=facts,
    )  # fmt: skip


def open_scenes(path: Path, choice: Choice) -> Recording:
    """A folder of ``frame-000000.depth.png``, ``.pose.txt`` and maybe ``.color.png``, 30 a second.

    Raises as `open_tum`.
    """
    skipped: Counter[str] = Counter()
    facts = {"form": "7-Scenes"}
    files = sorted((f for f in path.iterdir() if _FRAME.fullmatch(f.name)), key=lambda f: (_number(f), f.name))
    stamp_s = np.array([_number(file) / SCENES_RATE_HZ for file in files])
    facts["stamps"] = f"frame numbers at {SCENES_RATE_HZ:g} Hz"
    if (path / "timestamps.txt").is_file():
        stamp_s, facts["stamps"] = read_stamps(path / "timestamps.txt"), "timestamps.txt"
        if len(stamp_s) != len(files):
            raise RecordingError(f"{path / 'timestamps.txt'}: {len(stamp_s)} stamps; expected the {len(files)} images'")
    T_drone_sensor, camera = camera_of(path, choice, files, _kinect(SCENES_CAMERA), "published default", facts)
    name = choice.poses or (TRAJECTORY if (path / TRAJECTORY).is_file() else None)
    if name is not None:
        poses = _turned(read_trajectory(named_file(path, name), skipped), T_drone_sensor)
        facts["poses"] = Path(name).name
    else:
        poses, facts["poses"] = _turned(_frame_poses(path, files, stamp_s, skipped), T_drone_sensor), "true poses"
    colours = [(stamp, _beside(file, "color.png")) for stamp, file in zip(stamp_s.tolist(), files, strict=True)]
    colours = [(stamp, file) for stamp, file in colours if file.is_file()]
    stamp_s, files = chosen(path, stamp_s, files, skipped)
    load = partial(_load, camera=camera, scale=camera.depth_scale or SCENES_SCALE, invalid=LARGEST)
    return Recording(
        path, FileScans(stamp_s, files, load, skipped, facts), poses, T_drone_sensor, read_imu(path / IMU, skipped),
        truth=_truth(path, choice, T_drone_sensor, skipped, facts, None if name else poses),
        pictures=_pictures(np.array([s for s, _ in colours]), [f for _, f in colours], skipped) if colours else None,
        skipped=skipped, facts=facts,
    )  # fmt: skip


def save_tum(target: Path, recording: Recording, on_progress: Progress) -> None:
    """Write depth images in 0.2 mm, ``depth.txt``, pictures with ``rgb.txt``, ``trajectory.txt``, ``settings.toml``.

    Depths are rounded to 0.1 mm; beyond 13.1 m there is no number for them, and they are left out and counted. Raises
    `RecordingError` for scans that are not images of a pinhole camera.
    """
    target.mkdir()
    (target / "depth").mkdir()
    lines: list[str] = []

    def place(k: int, stamp_s: float) -> Path:
        lines.append(f"{stamp_s:.9f} depth/{name_of(stamp_s)}.png")
        return target / "depth" / f"{name_of(stamp_s)}.png"

    _save_depths(target, recording, on_progress, TUM_SCALE, place)
    (target / "depth.txt").write_text("\n".join(["# depth maps", "# timestamp filename", *lines, ""]))
    if recording.pictures is not None:
        (target / "rgb").mkdir()
        lines = []
        for picture in recording.pictures.walk():
            write_png(target / "rgb" / f"{name_of(picture.stamp_s)}.png", picture.pixels)
            lines.append(f"{picture.stamp_s:.9f} rgb/{name_of(picture.stamp_s)}.png")
        (target / "rgb.txt").write_text("\n".join(["# color images", "# timestamp filename", *lines, ""]))


def save_scenes(target: Path, recording: Recording, on_progress: Progress) -> None:
    """Write depth images in millimetres and a pose beside each; the stamps, which the layout lacks, and all poses too.

    Frames without a pose get none. Pictures are left out: the layout has one for each depth image. Raises as
    `save_tum`.
    """
    target.mkdir()
    stamp_s = recording.scans.stamp_s
    _save_depths(target, recording, on_progress, SCENES_SCALE, lambda k, _: target / f"frame-{k:06d}.depth.png")
    T_world_drone, covered = interpolate(recording.poses, stamp_s, GAP_MAX_S)
    # The layout's world is a camera's too: y down.
    T_level_optical = T_OPTICAL_SENSOR @ T_world_drone @ recording.T_drone_sensor @ np.linalg.inv(T_OPTICAL_SENSOR)
    for k in np.flatnonzero(covered):
        np.savetxt(target / f"frame-{k:06d}.pose.txt", T_level_optical[k], fmt="%.17e", delimiter="\t")
    (target / "timestamps.txt").write_text("".join(f"{stamp!r}\n" for stamp in stamp_s.tolist()))


def _save_depths(
    target: Path, recording: Recording, on_progress: Progress, scale: float, place: Callable[[int, float], Path]
) -> None:
    camera = camera_of_scans(recording.path, recording.scans)
    stamp_s = recording.scans.stamp_s
    beyond = 0
    for k, scan in enumerate(recording.scans.walk()):
        depth = np.round(depths_of(recording.path, scan.points, camera) / scale)
        far = depth >= LARGEST
        beyond += int(np.count_nonzero(far))
        write_png(place(k, scan.stamp_s), np.where(np.isnan(depth) | far, 0, depth).astype(np.uint16))
        on_progress((k + 1) / len(stamp_s))
    if beyond:
        recording.skipped[f"point beyond {LARGEST * scale:.1f} m, not written"] += beyond
    T = recording.poses.T_world_drone @ recording.T_drone_sensor @ np.linalg.inv(T_OPTICAL_SENSOR)
    write_tum(target / TRAJECTORY, Trajectory(recording.poses.stamp_s, T))
    intrinsics = camera.model_copy(update={"depth_scale": scale}).model_dump()
    table = "".join(f"{name} = {value!r}\n" for name, value in intrinsics.items())
    write_imu(target / IMU, recording.imu)
    write_settings(target / SETTINGS, recording.T_drone_sensor, f"\n[intrinsics]\n{table}")


def _load(file: Path, camera: Intrinsics, scale: float, invalid: int) -> Array:
    depth = read_depth(file)
    if (camera.height or depth.shape[0], camera.width or depth.shape[1]) != depth.shape:
        raise FileContentError(
            f"{file}: {depth.shape[1]} × {depth.shape[0]}; expected {camera.width} × {camera.height}"
        )
    return depth_points(np.where(depth == invalid, 0, depth) * scale, camera)


def _listed(path: Path) -> tuple[Array, list[Path]]:
    """Stamps and files of a list."""
    listed = read_list(path)
    for stamp_s, name in listed:
        if not name:
            raise FileContentError(f"{path}: stamp {stamp_s} without a file; expected a stamp and a file's name a line")
    if not listed:
        raise RecordingError(f"{path}: lists no images; expected a stamp and a file's name a line")
    return np.array([stamp for stamp, _ in listed]), [path.parent / name for _, name in listed]


def _tum_poses(
    path: Path, choice: Choice, T_drone_sensor: Array, skipped: Counter[str], facts: dict[str, str]
) -> tuple[Trajectory, bool]:
    """The drone's poses, and whether they are the true ones."""
    names = (TRAJECTORY, "groundtruth.txt")
    name = choice.poses or next((name for name in names if (path / name).is_file()), None)
    if name is None:
        raise RecordingError(f"{path}: no poses; expected {' or '.join(names)}, or a trajectory file that is named")
    true = Path(name).name == names[1]
    facts["poses"] = "true poses" if true else Path(name).name
    return _turned(read_trajectory(named_file(path, name), skipped), T_drone_sensor), true


def _truth(
    path: Path,
    choice: Choice,
    T_drone_sensor: Array,
    skipped: Counter[str],
    facts: dict[str, str],
    true: Trajectory | None,
) -> Trajectory | None:
    """The true poses themselves, or those of a file: beside the folder the drone's, in it the camera's."""
    beside = truth_beside(path)
    found = truth_of(path, choice, path / "groundtruth.txt" if true else path / TRAJECTORY, skipped, facts)
    if found is None:
        return true
    return found if choice.truth is None and beside.is_file() else _turned(found, T_drone_sensor)


def _turned(camera: Trajectory, T_drone_sensor: Array) -> Trajectory:
    """The drone's poses from those of a camera that looks along z."""
    return Trajectory(camera.stamp_s, camera.T_world_drone @ T_OPTICAL_SENSOR @ np.linalg.inv(T_drone_sensor))


def _frame_poses(path: Path, files: list[Path], stamp_s: Array, skipped: Counter[str]) -> Trajectory:
    """The poses ``frame-000000.pose.txt``, of the camera; missing ones are counted, broken ones an error.

    The world of 7-Scenes has the axes of a camera held level, y down; it is turned, so that z is up.
    """
    found = [_pose(_beside(file, "pose.txt")) for file in files]
    missing = sum(pose is None for pose in found)
    if missing:
        skipped["missing pose file"] += missing
    kept = np.array([k for k, pose in enumerate(found) if pose is not None], dtype=np.int64)
    if not len(kept):
        raise RecordingError(f"{path}: no poses; expected frame-000000.pose.txt beside each image, or {TRAJECTORY}")
    camera = trajectory_of_matrices(path, stamp_s[kept], np.array([found[k] for k in kept]), skipped)
    return Trajectory(camera.stamp_s, np.linalg.inv(T_OPTICAL_SENSOR) @ camera.T_world_drone)


def _pose(file: Path) -> Array | None:
    numbers: list[float] = []
    try:
        for number, line in text_lines(file):
            try:
                row = [float(word) for word in line.split()]
            except ValueError:
                row = []
            if len(row) != 4:
                raise FileContentError(f"{file}, line {number}: {line[:60]!r}; expected four numbers of a 4 × 4 pose")
            numbers += row
    except FileMissingError:
        return None
    if len(numbers) != 16:
        raise FileContentError(f"{file}: {len(numbers)} numbers; expected the 16 of a 4 × 4 pose")
    return np.array(numbers).reshape(4, 4)


def _pictures(stamp_s: Array, files: list[Path], skipped: Counter[str]) -> FilePictures:
    kept = rising(stamp_s, skipped, "picture: ")
    return FilePictures(stamp_s[kept], [files[k] for k in np.flatnonzero(kept).tolist()], read_picture, skipped)


def _kinect(numbers: tuple[float, float, float, float]) -> Intrinsics:
    fx, fy, cx, cy = numbers
    return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=640, height=480)


def _number(file: Path) -> int:
    return int(file.name.removeprefix("frame-").partition(".")[0])


def _beside(file: Path, ending: str) -> Path:
    return file.with_name(f"{file.name.partition('.')[0]}.{ending}")
