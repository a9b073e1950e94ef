"""Folders of clouds, a file for each scan, with a trajectory ↔ `Recording`."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from steelnb.datatypes import Array, Trajectory
from steelnb.errors import FileContentError, FileMissingError, RecordingError, TopicError
from steelnb.recordings.choice import Choice, read_settings
from steelnb.recordings.file_scans import FilePictures, FileScans, chosen, in_order
from steelnb.recordings.images import read_picture, write_png
from steelnb.recordings.imu_files import IMU, read_imu, write_imu
from steelnb.recordings.points import READERS, WRITERS, read_points
from steelnb.recordings.recording import Recording
from steelnb.recordings.stamps import STAMP_FILES, name_of, read_list, rising, stamps_beside, stamps_of_names
from steelnb.recordings.trajectories import KITTI, form_of, read_kitti, read_trajectory, write_tum

SETTINGS, TRAJECTORY, PICTURES = "settings.toml", "trajectory.txt", "pictures"
"""What we write beside the scans: where the sensor is on the drone, the drone's poses as recorded, camera images."""
TEXTS = (".tum", ".txt", ".csv", ".kitti", ".poses")
TRUE = ("groundtruth", "ground_truth", "gt")
Progress = Callable[[float], None]


def is_cloud_folder(path: Path) -> bool:
    """Whether a folder, or one of its sub-folders, holds clouds."""
    return path.is_dir() and any(_clouds(folder) for folder in (path, *_folders(path)))


def open_clouds(path: Path, choice: Choice) -> Recording:
    """A folder of PLY, PCD, LAS, LAZ or NPY clouds in the sensor frame, and a trajectory of the drone.

    ``choice.scans`` names a sub-folder or a pattern such as ``*.pcd``; ``choice.poses`` a trajectory file, else it is
    the one file that holds poses. Stamps are in the files' names, in a file of stamps, or, where there are as many,
    those of the trajectory. Raises `RecordingError`, `TopicError`, `FileContentError`, and what settings raise.
    """
    skipped: Counter[str] = Counter()
    facts = {"form": "folder of clouds"}
    files = _files(path, choice.scans)
    T_drone_sensor, _ = read_settings(settings_file(path, choice))
    stamp_s, source = scan_stamps(path, files)
    poses_file = trajectory_file(path, choice)
    poses = _poses(poses_file, stamp_s, skipped)
    if stamp_s is None:
        if len(poses) != len(files):
            raise RecordingError(
                f"{path}: {len(files)} clouds without stamps, {len(poses)} poses in {poses_file.name}; expected as "
                f"many, or stamps in the clouds' names or in one of {', '.join(STAMP_FILES)}"
            )
        stamp_s, source = poses.stamp_s, poses_file.name
    facts |= {"scans": f"{len(files)} × {files[0].suffix.lower()}", "stamps": source, "poses": poses_file.name}
    stamp_s, files = chosen(path, stamp_s, files, skipped)
    truth = truth_of(path, choice, poses_file, skipped, facts)
    if truth is None and poses_file.stem.lower() in TRUE:
        truth, facts["poses"] = poses, "true poses"
    mount = np.eye(4) if T_drone_sensor is None else T_drone_sensor
    scans = FileScans(stamp_s, files, read_points, skipped, facts)
    imu, pictures = read_imu(path / IMU, skipped), _pictures(path / PICTURES, skipped)
    return Recording(path, scans, poses, mount, imu, truth, pictures, skipped, facts)


def save_clouds(target: Path, recording: Recording, on_progress: Progress, ending: str) -> None:
    """Write each scan as a file named after its stamp, and what else there is beside: poses, extrinsics, IMU, pictures.

    NPY and PCD keep images; the others hold the finite points alone. NPY is exact; PLY and PCD are in single
    precision, LAS and LAZ in steps of 10 µm.
    """
    target.mkdir()
    for k, scan in enumerate(recording.scans.walk()):
        WRITERS[ending](target / f"{name_of(scan.stamp_s)}{ending}", scan.points)
        on_progress((k + 1) / len(recording.scans.stamp_s))
    write_tum(target / TRAJECTORY, recording.poses)
    write_settings(target / SETTINGS, recording.T_drone_sensor)
    write_imu(target / IMU, recording.imu)
    if recording.pictures is not None and len(recording.pictures.stamp_s):
        (target / PICTURES).mkdir()
        for picture in recording.pictures.walk():
            write_png(target / PICTURES / f"{name_of(picture.stamp_s)}.png", picture.pixels)


def write_settings(path: Path, T_drone_sensor: Array, intrinsics: str = "") -> None:
    """Write a settings file as `Choice` describes it."""
    from scipy.spatial.transform import Rotation

    quaternion = Rotation.from_matrix(T_drone_sensor[:3, :3]).as_quat(canonical=True).tolist()
    mount = f"[extrinsics]\ntranslation_m = {T_drone_sensor[:3, 3].tolist()}\nrotation_xyzw = {quaternion}\n"
    path.write_text(mount + intrinsics)


def settings_file(path: Path, choice: Choice) -> Path | None:
    """The settings that a user names, or those in the folder."""
    inside = next((path / name for name in (SETTINGS, "intrinsics.toml") if (path / name).is_file()), None)
    return choice.settings or inside


def scan_stamps(path: Path, files: list[Path]) -> tuple[Array | None, str]:
    """Stamps of files from their names, or from a file of stamps with them or above; and where they are from.

    Raises `RecordingError` where there are more or fewer than files.
    """
    named = stamps_of_names([file.stem for file in files])
    if named is not None:
        return named, "file names"
    times = stamps_beside(files[0]) or stamps_beside(path)
    if times is None:
        return None, ""
    listed = read_list(times)
    by_name = {Path(rest.split(",")[0].strip()).name: stamp for stamp, rest in listed if rest}
    if all(file.name in by_name for file in files):
        return np.array([by_name[file.name] for file in files]), times.name
    if len(listed) != len(files):
        raise RecordingError(f"{times}: {len(listed)} stamps; expected the {len(files)} of the {files[0].suffix} files")
    return np.array([stamp for stamp, _ in listed]), times.name


def trajectory_file(path: Path, choice: Choice) -> Path:
    """The file named by the user, from here or from the folder; else `TRAJECTORY`; else the only one with poses.

    Raises `FileMissingError`, `RecordingError` without any, `TopicError` where several hold poses.
    """
    if choice.poses is not None:
        return named_file(path, choice.poses)
    if (path / TRAJECTORY).is_file():
        return path / TRAJECTORY
    found = [file for file in sorted(path.iterdir()) if file.suffix.lower() in TEXTS and _holds_poses(file)]
    found = [file for file in found if file.stem.lower() not in TRUE] or found
    if not found:
        raise RecordingError(f"{path}: no trajectory; expected a TUM, KITTI or EuRoC file in it, or one named")
    if len(found) > 1:
        names = ", ".join(file.name for file in found)
        raise TopicError(f"{path}: several files hold poses: {names}; expected one of them to be named as the poses")
    return found[0]


def named_file(path: Path, name: str) -> Path:
    """A file that a user names, from here or from the recording's folder. Raises `FileMissingError`."""
    for file in (Path(name), path / name):
        if file.is_file():
            return file
    raise FileMissingError(f"{name}: no such file, here or in {path}; expected a trajectory")


def truth_of(
    path: Path, choice: Choice, poses_file: Path, skipped: Counter[str], facts: dict[str, str]
) -> Trajectory | None:
    """The truth that a user names or that lies beside the folder or, under a name that says so, in it."""
    if choice.truth is not None:
        file = named_file(path, choice.truth)
    elif truth_beside(path).is_file():
        file = truth_beside(path)
    else:
        inside = [file for file in sorted(path.iterdir()) if file.stem.lower() in TRUE and file.suffix.lower() in TEXTS]
        if not inside or inside[0] == poses_file or not _holds_poses(inside[0]):
            return None
        file = inside[0]
    counted: Counter[str] = Counter()
    truth, facts["truth"] = read_trajectory(file, counted), file.name
    skipped.update({f"truth: {reason}": number for reason, number in counted.items()})
    return truth


def truth_beside(path: Path) -> Path:
    """Where the truth of a folder is."""
    path = path.resolve()
    return path.with_name(path.name + ".truth.tum")


def _poses(file: Path, stamp_s: Array | None, skipped: Counter[str]) -> Trajectory:
    if form_of(file) is KITTI and stamps_beside(file) is None and stamp_s is not None:
        return read_kitti(file, skipped, times=stamp_s)
    return read_trajectory(file, skipped)


def _pictures(folder: Path, skipped: Counter[str]) -> FilePictures | None:
    """Images named after their stamps."""
    files = in_order([file for file in folder.iterdir() if file.suffix.lower() == ".png"]) if folder.is_dir() else []
    stamp_s = stamps_of_names([file.stem for file in files])
    if stamp_s is None:
        return None
    kept = rising(stamp_s, skipped, "picture: ")
    return FilePictures(stamp_s[kept], [files[k] for k in np.flatnonzero(kept).tolist()], read_picture, skipped)


def _holds_poses(file: Path) -> bool:
    try:
        return file.name not in STAMP_FILES and file.is_file() and form_of(file) is not None
    except (FileContentError, FileMissingError):
        return False


def _files(path: Path, scans: str | None) -> list[Path]:
    """The clouds of a folder in order. Raises `RecordingError` for none, `TopicError` where it is not clear which."""
    folder, pattern = path, "*"
    if scans is not None and "*" in scans:
        pattern = scans
    elif scans is not None:
        folder = path / scans
        if not folder.is_dir():
            raise TopicError(f"{path}: no folder {scans!r}; expected one of {', '.join(_names(path)) or 'none'}")
    elif not _clouds(path):
        holding = [each for each in _folders(path) if _clouds(each)]
        if len(holding) > 1:
            raise TopicError(f"{path}: clouds in {', '.join(each.name for each in holding)}; expected one to be named")
        folder = holding[0] if holding else path
    files = [file for file in _clouds(folder) if file.match(pattern)]
    endings = sorted({file.suffix.lower() for file in files})
    if not files:
        raise RecordingError(f"{folder}: no clouds; expected files that end with one of {', '.join(READERS)}")
    if len(endings) > 1:
        raise TopicError(f"{folder}: clouds that end with {', '.join(endings)}; expected one to be named, as '*.ply'")
    return in_order(files)


def _clouds(folder: Path) -> list[Path]:
    return [file for file in folder.iterdir() if file.suffix.lower() in READERS and not file.name.startswith(".")]


def _folders(path: Path) -> list[Path]:
    return sorted(each for each in path.iterdir() if each.is_dir() and not each.name.startswith("."))


def _names(path: Path) -> list[str]:
    return [each.name for each in _folders(path)]
