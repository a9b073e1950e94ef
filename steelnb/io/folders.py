"""Folders of clouds, a file a scan, with a trajectory → parts of a flight."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from steelnb.errors import FileMissingError, RecordingError, TopicError
from steelnb.io.calibration import Intrinsics, read_settings
from steelnb.io.clouds import read_points
from steelnb.io.scans import Decode, Parts
from steelnb.io.trajectories import (
    STAMP_FILES,
    holds_poses,
    read_stamps,
    read_trajectory,
    stamps_beside,
    stamps_of_names,
)
from steelnb.types import Array, IntArray, Trajectory

CLOUDS = (".ply", ".pcd", ".las", ".laz", ".npy")
TRAJECTORY = "trajectory.txt"
SETTINGS_FILES = ("settings.toml", "intrinsics.toml")
TEXTS = (".tum", ".txt", ".csv", ".kitti", ".poses")
TRUE = ("groundtruth", "ground_truth", "gt")


def is_cloud_folder(path: Path) -> bool:
    """Whether a folder, or one of its sub-folders, holds clouds."""
    return path.is_dir() and any(_clouds(folder) for folder in (path, *_folders(path)))


def open_clouds(path: Path, scans: str | None, poses: str | None, truth: str | None, settings: Path | None) -> Parts:
    """The parts of a folder of clouds in the sensor frame, with a trajectory of the drone.

    ``scans`` names a sub-folder; ``poses`` a trajectory file, else it is the only file
    with poses. Stamps are in file names, in a file of stamps, or, where there are as many, those of the poses. Raises
    `RecordingError`, `TopicError`, `FileContentError`, and what settings raise.
    """
    skipped: Counter[str] = Counter()
    files = _cloud_files(path, scans)
    T_drone_sensor, _, _ = folder_settings(path, settings)
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
    walk = partial(walk_files, files, read_points)
    return Parts(stamp_s, walk, prior, T_drone_sensor, facts | {"poses": said}, skipped=skipped)


def read_clouds_truth(path: Path, truth: str | None, settings: Path | None) -> Trajectory | None:
    """The trajectory named, or the one in the folder whose name says that it is true (``groundtruth.txt``)."""
    if truth is not None:
        return read_trajectory(named_file(path, truth))
    inside = [file for file in sorted(path.iterdir()) if file.stem.lower() in TRUE and file.suffix.lower() in TEXTS]
    return read_trajectory(inside[0]) if inside and holds_poses(inside[0]) else None


def walk_files(files: Sequence[Path], load: Callable[[Path], Array], number: IntArray) -> Iterator[Decode]:
    """The scans of numbered files, as `Parts` walks them."""
    return (partial(load, files[k]) for k in number.tolist())


def folder_settings(path: Path, settings: Path | None) -> tuple[Array, Intrinsics | None, Path | None]:
    """``T_drone_sensor``, by default the identity, intrinsics, and their file: named by the user, or in the folder."""
    file = settings or next((path / name for name in SETTINGS_FILES if (path / name).is_file()), None)
    T_drone_sensor, camera = read_settings(file)
    return np.eye(4) if T_drone_sensor is None else T_drone_sensor, camera, file


def named_file(path: Path, name: str) -> Path:
    """A file that a user names, from here or from the folder. Raises `FileMissingError`."""
    for file in (Path(name), path / name):
        if file.exists() and not file.is_dir():  # a pipe is refused by its name
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
    """The clouds of a folder, or of its only sub-folder with clouds or that named, by the numbers in their names: 9
    before 10. Raises `RecordingError`, `TopicError`."""
    folders = [path] if scans is None and _clouds(path) else [each for each in _folders(path) if _clouds(each)]
    if scans is not None and not ((path / scans).is_dir() and _clouds(path / scans)):
        names = ", ".join(each.name for each in folders) or "none"
        raise TopicError(f"{path}: no folder {scans!r} with clouds; expected one of {names}")
    if scans is None and len(folders) > 1:
        raise TopicError(f"{path}: clouds in {', '.join(each.name for each in folders)}; expected one to be named")
    files = _clouds(path / scans if scans is not None else folders[0])
    endings = sorted({file.suffix.lower() for file in files})
    if len(endings) > 1:
        raise RecordingError(f"{files[0].parent}: clouds that end with {', '.join(endings)}; expected one kind")
    return sorted(files, key=lambda file: ([float(n) for n in re.findall(r"\d+(?:\.\d+)?", file.stem)], file.stem))


def _clouds(folder: Path) -> list[Path]:
    return [file for file in folder.iterdir() if file.suffix.lower() in CLOUDS and not file.name.startswith(".")]


def _folders(path: Path) -> list[Path]:
    return sorted(each for each in path.iterdir() if each.is_dir() and not each.name.startswith("."))
