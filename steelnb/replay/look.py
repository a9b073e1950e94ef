"""`steelnb view`: whatever can be looked at → an .rrd file, made for the occasion where there is none."""

import contextlib
import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from steelnb.datatypes import Array, Segments
from steelnb.errors import FileContentError, FileMissingError
from steelnb.exports import read_structure
from steelnb.recordings import read_cloud
from steelnb.recordings.choice import Choice
from steelnb.recordings.clouds import READERS
from steelnb.recordings.formats import open_recording
from steelnb.recordings.recording import GAP_MAX_S, Recording
from steelnb.replay.course import course_of
from steelnb.replay.outputs import true_poses
from steelnb.viewer import Log

MAGIC = b"RRF2"
STILL_POINTS_MAX = 1_000_000
PICTURE_PERIOD_S = 0.2
"""Pictures of a camera that is faster are left out: a scan comes no more often."""
Progress = Callable[[float, str], None]


@contextlib.contextmanager
def as_rrd(
    path: Path, choice: Choice | None = None, gap_max_s: float = GAP_MAX_S, on_progress: Progress | None = None
) -> Iterator[Path]:
    """The .rrd file of ``path`` within the `with`.

    That itself; the ``recording.rrd`` in a folder of `steelnb run`; or a temporary one of a recording (scans and poses
    as they are, and the truth), of a cloud, or of bars (``segments.json``, ``structure.json``). Raises
    `FileMissingError`, `FileContentError`, and what reading the file raises.
    """
    if not path.exists():
        raise FileMissingError(f"{path}: does not exist; expected something to look at")
    if path.is_dir() and (path / "recording.rrd").is_file():
        path = path / "recording.rrd"
    if path.suffix.lower() == ".rrd":
        _check(path)
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="steelnb-view-") as folder:
        rrd = Path(folder) / "recording.rrd"
        if path.suffix.lower() == ".json":
            write_still(rrd, path.name, *_bars(path))
        elif path.is_file() and path.suffix.lower() in READERS:
            write_still(rrd, path.name, read_cloud(path).points, None)
        else:
            write_recording(rrd, open_recording(path, choice or Choice()), gap_max_s, on_progress)
        yield rrd


def write_recording(
    rrd: Path, recording: Recording, gap_max_s: float = GAP_MAX_S, on_progress: Progress | None = None
) -> None:
    """Log a recording as it is, nothing corrected; one scan is in memory at a time.

    Raises `OutputError`, `RecordingError`, and what reading the recording raises.
    """
    course = course_of(recording, gap_max_s=gap_max_s)
    flight, true = course.flight, true_poses(course)
    with Log(rrd, recording.path.name, flight.T_drone_sensor) as log:
        for k, scan in enumerate(flight.scans):
            log.frame(scan.stamp_s, scan.points, None, flight.prior.T_world_drone[k], true.get(k))
            if on_progress:
                on_progress((k + 1) / len(flight.prior), "reading")
        last_s = -np.inf
        for picture in recording.pictures.walk() if recording.pictures else ():
            if picture.stamp_s - last_s >= PICTURE_PERIOD_S:
                log.picture(picture)
                last_s = picture.stamp_s


def write_still(rrd: Path, name: str, points: Array | None, segments: Segments | None) -> None:
    """Log what has no time: points ``(N, 3)``, at most `STILL_POINTS_MAX` of them, and bars."""
    with Log(rrd, name, np.eye(4)) as log:
        log.map(0.0, points, segments, STILL_POINTS_MAX)


def _check(path: Path) -> None:
    try:
        with path.open("rb") as file:
            begin = file.read(len(MAGIC))
    except OSError as fault:
        raise FileMissingError(f"{path}: cannot be read: {fault.strerror or fault}") from None
    if begin != MAGIC:
        raise FileContentError(f"{path}: begins with {begin!r}; expected {MAGIC!r}, as files of rerun do")


def _bars(path: Path) -> tuple[Array | None, Segments]:
    """Joints ``(J, 3)`` and bars of a structure, or the segments of `steelnb segment`, less their origin."""
    try:
        document = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as fault:
        raise FileContentError(f"{path}: not JSON: {fault}") from None
    if not isinstance(document, dict) or not str(document.get("format")).startswith("steelnb segments"):
        structure = read_structure(path)
        return structure.joint, structure.segments
    try:
        ends = np.array([[bar["start"], bar["end"]] for bar in document["segments"]], dtype=float).reshape(-1, 2, 3)
        ends -= np.array(document["origin"], dtype=float)
    except (KeyError, TypeError, ValueError) as fault:
        raise FileContentError(
            f"{path}: {type(fault).__name__} {fault}; expected segments with start and end"
        ) from None
    none = np.zeros(len(ends))
    return None, Segments(ends[:, 0], ends[:, 1], none.astype(np.int64), none)
