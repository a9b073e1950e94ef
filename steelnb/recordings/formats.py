"""Any of the files that hold a flight ↔ `Recording`: which form they have, and who reads and writes it."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from steelnb.errors import FileMissingError, OutputError, UnsupportedFormatError
from steelnb.recordings.bag_files import is_bag
from steelnb.recordings.bag_writer import write_bag
from steelnb.recordings.bags import open_bag
from steelnb.recordings.choice import Choice
from steelnb.recordings.cloud_folders import is_cloud_folder, open_clouds, save_clouds
from steelnb.recordings.depth_folders import is_scenes, is_tum, open_scenes, open_tum, save_scenes, save_tum
from steelnb.recordings.recording import Recording
from steelnb.recordings.segments import new_folder
from steelnb.recordings.trajectories import read_trajectory, write_tum

__all__ = ["FORMS", "Choice", "open_recording", "save_recording", "truth_path"]

Progress = Callable[[float], None]

FORMS = ("ros1", "mcap", "sqlite", "ply", "pcd", "las", "laz", "npy", "tum-rgbd", "7-scenes")
ENDING = {".bag": "ros1", ".mcap": "mcap", ".db3": "sqlite", "": "npy"}
"""The form of a path to be written, where none is named."""


@dataclass(frozen=True)
class Reader:
    """Whether the files at a path are of its forms, and the recording that they hold."""

    fits: Callable[[Path], bool]
    open: Callable[[Path, Choice], Recording]


READERS: tuple[Reader, ...] = (
    Reader(is_bag, open_bag),
    Reader(is_tum, open_tum),
    Reader(is_scenes, open_scenes),
    Reader(is_cloud_folder, open_clouds),
)
"""Asked in this order."""
WRITERS: dict[str, Callable[[Path, Recording, Progress], None]] = {
    "ros1": lambda path, recording, on_progress: write_bag(path, recording, "ros1", on_progress),
    "mcap": lambda path, recording, on_progress: write_bag(path, recording, "mcap", on_progress),
    "sqlite": lambda path, recording, on_progress: write_bag(path, recording, "sqlite", on_progress),
    **{ending[1:]: partial(save_clouds, ending=ending) for ending in (".ply", ".pcd", ".las", ".laz", ".npy")},
    "tum-rgbd": save_tum,
    "7-scenes": save_scenes,
}
"""Each writes a new file or folder at a path; the truth is not theirs."""


def open_recording(path: Path | str, choice: Choice = Choice()) -> Recording:  # noqa: B008 (frozen)
    """The recording at a path: a bag, a ROS 2 folder, a folder of depth images or of clouds.

    The truth is taken from ``STEM.truth.tum`` beside it unless ``choice`` names another or the files hold it. Raises
    `FileMissingError`, `UnsupportedFormatError`, `FileContentError`, `RecordingError`, `TopicError`,
    `ExtrinsicsError` and `SettingsError`.
    """
    path = Path(path)
    if not path.exists():
        raise FileMissingError(f"{path}: does not exist; expected a recording")
    try:
        reader = next((reader for reader in READERS if reader.fits(path)), None)
    except OSError as fault:
        raise FileMissingError(f"{path}: cannot be read: {fault.strerror}; expected a recording") from None
    if reader is None:
        what = "a folder of an unknown kind" if path.is_dir() else f"ending {path.suffix!r}"
        raise UnsupportedFormatError(
            f"{path}: {what}; expected .bag, .mcap, .db3, a ROS 2 folder, or a folder of depth images or clouds"
        )
    recording = reader.open(path, choice)
    if recording.truth is not None:
        return recording
    named = Path(choice.truth) if choice.truth else truth_path(path)
    if not named.is_file():
        if choice.truth:
            raise FileMissingError(f"{named}: does not exist; expected a trajectory file")
        return recording
    reasons: Counter[str] = Counter()
    truth = read_trajectory(named, reasons)
    recording.skipped.update({f"truth: {reason}": count for reason, count in reasons.items()})
    return replace(recording, truth=truth, facts=recording.facts | {"truth": str(named)})


def save_recording(
    path: Path | str, recording: Recording, form: str | None = None, on_progress: Progress | None = None
) -> None:
    """Write a recording as one of ``FORMS``; its truth, if any, goes to ``STEM.truth.tum`` beside it.

    The form is that of the ending (`ENDING`) where none is named. Bags with an ending are one file; ``mcap`` and
    ``sqlite`` without are a ROS 2 folder with its metadata. Written beside, then renamed: nothing half-written stays.
    Raises `UnsupportedFormatError` and `OutputError`, and what reading the recording raises.
    """
    path = Path(path).absolute()
    form = form_to_write(path, form)
    if recording.truth is None and truth_path(path).exists():
        raise OutputError(f"{truth_path(path)}: would be taken for this recording's truth; expected no such file")
    with new_folder(path.parent) as folder:
        WRITERS[form](folder / path.name, recording, on_progress or (lambda _: None))
        if recording.truth is not None:
            write_tum(truth_path(folder / path.name), recording.truth)


def form_to_write(path: Path, form: str | None = None) -> str:
    """The form that `save_recording` would write at a path: the one named, else that of the ending.

    Raises `UnsupportedFormatError`, and `OutputError` for a folder that is not empty.
    """
    form = form or ENDING.get(path.suffix.lower())
    if form not in WRITERS:
        raise UnsupportedFormatError(f"{path}: form {form or path.suffix!r}; expected one of {', '.join(WRITERS)}")
    own = ENDING[path.suffix.lower()] if path.suffix.lower() in ENDING and path.suffix else None
    if form != own if own else form == "ros1":
        raise UnsupportedFormatError(f"{path}: form {form} with ending {path.suffix!r}; expected {_endings(form)}")
    if path.is_dir() and any(path.iterdir()):
        raise OutputError(f"{path}: a folder that is not empty; expected a new one")
    return form


def _endings(form: str) -> str:
    """The endings that a form may have, in words."""
    own = next((ending for ending, name in ENDING.items() if name == form and ending), "")
    return f"a path that ends in {own}" if form == "ros1" else f"{own + ' or ' if own else ''}none, for a folder"


def truth_path(path: Path) -> Path:
    """Where the truth of the recording at a path is: X.bag and X/ have X.truth.tum."""
    path = path if path.name not in ("", "..") else path.resolve()
    stem = path.with_suffix("") if path.suffix.lower() in ENDING else path
    return stem.with_name(stem.name + ".truth.tum")
