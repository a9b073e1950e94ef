"""Files ↔ `Flight`: bags, ROS 2 folders, folders of clouds and of depth images. The truth is read apart."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from steelnb.errors import FileMissingError, SettingsError, TopicError, UnsupportedFormatError
from steelnb.files import reading
from steelnb.io.bag_files import is_bag, truth_path
from steelnb.io.bags import open_bag, read_bag_truth
from steelnb.io.calibration import read_correction
from steelnb.io.depth_folders import is_scenes, is_tum, open_scenes, open_tum, read_depth_truth
from steelnb.io.folders import is_cloud_folder, open_clouds, read_clouds_truth
from steelnb.io.scans import Parts
from steelnb.io.trajectories import read_trajectory
from steelnb.types import Flight, Trajectory


class _Format(NamedTuple):
    fits: Callable[[Path], bool]
    open: Callable[[Path, str | None, str | None, str | None, Path | None], Parts]
    truth: Callable[[Path, str | None, Path | None], Trajectory | None]


_FORMATS = (
    _Format(is_bag, open_bag, read_bag_truth),
    _Format(is_tum, open_tum, read_depth_truth),
    _Format(is_scenes, open_scenes, read_depth_truth),
    _Format(is_cloud_folder, open_clouds, read_clouds_truth),
)
"""Asked in this order."""


def read_flight(
    path: Path | str,
    *,
    scans: str | None = None,
    poses: str | None = None,
    truth: str | None = None,
    settings: Path | str | None = None,
    gap_max_s: float | None = None,
    images: str | None = None,
) -> Flight:
    """Open a recorded flight; its scans are read one at a time as they are iterated over.

    Parameters
    ----------
    path : a ROS 1 bag, an MCAP or sqlite file, a ROS 2 folder, a folder of clouds (PLY, PCD, LAS, LAZ, NPY) with a
        trajectory, or of depth images (TUM RGB-D, 7-Scenes).
    scans : topic or sub-folder of the scans; by default the only one of a fitting type.
    poses : topic or trajectory file (TUM, KITTI, EuRoC) of the drone's drifting poses; by default the only one.
    truth : topic of the true poses, which is then not taken for the drifting ones. It is read by `read_truth`.
    settings : TOML file with tables ``[extrinsics]`` (``translation_m`` and ``rotation_rpy_deg`` of the sensor in
        the drone frame), ``[intrinsics]`` (``fx fy cx cy width height depth_scale``) and ``[errors]``
        (``range_offset_m range_scale time_offset_s``), without which scans and their stamps then come.
    gap_max_s : poses further apart are not interpolated between; scans in such a gap are left out. By default 0.5 s, or
        two usual intervals of the poses, but never more than 2 s.
    images : topic of a camera's images; by default the only one in a bag. Where that is of no use, ``facts`` say why.

    Returns a `Flight` whose ``prior`` is interpolated at the scans, whose ``facts`` name the format, topics and
    calibration, and whose ``skipped`` counts what was left out. Raises `FileMissingError`, `UnsupportedFormatError`,
    `FileContentError`, `RecordingError`, `TopicError` and `SettingsError`.
    """
    if gap_max_s is not None and not 0 < gap_max_s < float("inf"):
        raise SettingsError(f"gap = {gap_max_s}: expected a positive number of seconds")
    path = Path(path)
    opened = _format(path).open
    if images is not None:
        if opened is not open_bag:
            raise TopicError(f"{path}: images {images!r}: expected a bag, whose topics have names")
        opened = partial(open_bag, images=images)
    parts = opened(path, scans, poses, truth, Path(settings) if settings else None)
    return parts.flight(path, gap_max_s, read_correction(settings))


def read_truth(path: Path | str, *, truth: str | None = None, settings: Path | str | None = None) -> Trajectory | None:
    """The true poses of the drone beside a recorded flight, for judging alone; None where there are none.

    ``truth`` names a topic or a trajectory file; by default ``STEM.truth.tum`` beside the recording, or the data set's
    own. Raises as `read_flight`.
    """
    path = Path(path)
    kind = _format(path)
    beside = truth_path(path)
    if truth is None and beside.is_file():
        return read_trajectory(beside)
    return kind.truth(path, truth, Path(settings) if settings else None)


def _format(path: Path) -> _Format:
    if not path.exists():
        raise FileMissingError(f"{path}: does not exist; expected a recording")
    with reading(path, "a recording", folder=True):
        found = next((each for each in _FORMATS if each.fits(path)), None)
    if found is None:
        kind = "a folder of an unknown kind" if path.is_dir() else f"ending {path.suffix!r}"
        raise UnsupportedFormatError(
            f"{path}: {kind}; expected .bag, .mcap, .db3, a ROS 2 folder, or a folder of depth images or clouds"
        )
    return found
