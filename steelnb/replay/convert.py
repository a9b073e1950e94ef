"""`steelnb convert`: a recording, a trajectory or a single cloud in another form; the endings say which it is."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from steelnb.datatypes import Array, Trajectory
from steelnb.errors import FileMissingError, OutputError, UnsupportedFormatError
from steelnb.recordings import new_folder, read_cloud
from steelnb.recordings.choice import Choice
from steelnb.recordings.clouds import READERS as CLOUD_READERS
from steelnb.recordings.formats import open_recording, save_recording, truth_path
from steelnb.recordings.points import WRITERS as CLOUD_WRITERS
from steelnb.recordings.trajectories import form_of, read_trajectory, write_euroc, write_kitti, write_tum
from steelnb.replay.outputs import write_map

TRAJECTORY_WRITERS: dict[str, Callable[[Path, Trajectory], None]] = {
    ".tum": write_tum,
    ".kitti": write_kitti,
    ".csv": write_euroc,
}
TRAJECTORY_ENDINGS = (*TRAJECTORY_WRITERS, ".txt")
SINGLE_MAX_M = 1e4
"""Coordinates beyond it lose a millimetre in single precision."""


def convert(
    source: Path | str,
    target: Path | str,
    form: str | None = None,
    choice: Choice | None = None,
    rate_hz: float | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> tuple[str, ...]:
    """Write ``source`` as ``target``, and give lines that say what was written.

    A trajectory file (TUM, KITTI, EuRoC) becomes one of ``.tum``, ``.kitti`` or ``.csv`` (EuRoC); a recording too, by
    its poses. A cloud file becomes ``.ply``, ``.pcd``, ``.las``, ``.laz`` or ``.npy``. Anything else is a recording,
    and ``form`` one of `steelnb.recordings.formats.FORMS`. ``rate_hz`` is for KITTI poses without stamps. Raises
    `OutputError` where the target exists, and what reading and writing raise; nothing is written then.
    """
    source, target = Path(source), Path(target)
    if not source.exists():
        raise FileMissingError(f"{source}: does not exist; expected a recording, a trajectory or a cloud")
    if target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise OutputError(f"{target}: exists already; expected a new name")
    ending, wanted = source.suffix.lower(), target.suffix.lower()
    if form is None and source.is_file() and ending in TRAJECTORY_ENDINGS and wanted in TRAJECTORY_WRITERS:
        return _trajectory(source, target, rate_hz)
    if form is None and source.is_file() and ending in (*CLOUD_READERS, ".npy") and wanted in CLOUD_WRITERS:
        return _cloud(source, target)
    if source.is_file() and ending in (*CLOUD_READERS, ".npy", ".kitti", ".tum"):
        expected = TRAJECTORY_WRITERS if ending in TRAJECTORY_WRITERS else CLOUD_WRITERS
        raise UnsupportedFormatError(f"{target}: ending {wanted!r}; expected one of {', '.join(expected)}")
    recording = open_recording(source, choice or Choice())
    if form is None and wanted in TRAJECTORY_WRITERS:
        TRAJECTORY_WRITERS[wanted](target, recording.poses)
        return (*_skipped(recording.skipped), f"{target} written: {len(recording.poses)} poses as recorded")
    save_recording(target, recording, form, on_progress)
    truth = f", and the truth as {truth_path(target)}" if recording.truth is not None else ""
    return (*_skipped(recording.skipped), f"{target} written: {len(recording.scans.stamp_s)} scans{truth}")


def _skipped(skipped: Counter[str]) -> tuple[str, ...]:
    reasons = "; ".join(f"{count} {reason}" for reason, count in sorted(skipped.items()) if count)
    return (f"skipped   {reasons}",) if reasons else ()


def _trajectory(source: Path, target: Path, rate_hz: float | None) -> tuple[str, ...]:
    if form_of(source) is None and source.suffix.lower() == ".txt":
        raise UnsupportedFormatError(f"{source}: no trajectory; expected TUM, KITTI or EuRoC lines for {target.name}")
    skipped: Counter[str] = Counter()
    poses = read_trajectory(source, skipped, rate_hz)
    TRAJECTORY_WRITERS[target.suffix.lower()](target, poses)
    return (*_skipped(skipped), f"{target} written: {len(poses)} poses")


def _cloud(source: Path, target: Path) -> tuple[str, ...]:
    if source.suffix.lower() == ".npy":
        from steelnb.recordings.points import read_points

        points = read_points(source).reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)]
        note: tuple[str, ...] = ()
    else:
        cloud = read_cloud(source)
        points = cloud.points + cloud.origin
        dropped = f"{cloud.dropped_duplicates} duplicates and {cloud.dropped_invalid} invalid points"
        note = (f"skipped   {dropped}",) if cloud.dropped_duplicates or cloud.dropped_invalid else ()
    writer: Callable[[Path, Array], None] = CLOUD_WRITERS[target.suffix.lower()]
    if target.suffix.lower() == ".ply":
        writer = write_map  # in double precision
    elif target.suffix.lower() == ".pcd" and np.abs(points).max() > SINGLE_MAX_M:
        raise UnsupportedFormatError(
            f"{target}: coordinates of {np.abs(points).max():.3g} m; expected .ply, .las, .laz or .npy, since PCD is "
            "written in single precision"
        )
    with new_folder(target.parent) as folder:
        writer(folder / target.name, points)
    return (*note, f"{target} written: {len(points)} points")
