"""File access: every error while reading becomes an `InputError`, and output is written completely or not at all."""

import os
import tempfile
import unicodedata
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from steelnb.core.errors import InputError, OutputError, SteelnbError

OVERWRITE = "--force (in Python, overwrite=True)"


@contextmanager
def reading(path: Path | str, form: str) -> Iterator[None]:
    """Convert any exception of a file reader to a one-line `InputError`; ``form``: the expected content, such as "a PLY
    file"."""
    check_exists(path, form)
    if os.path.isdir(path):
        raise InputError(f"{path}: a folder; expected {form}")
    with damaged(path, form):
        yield


def check_exists(path: Path | str, form: str) -> None:
    """Raise `InputError` unless this is a file or a folder. Pipes, devices and sockets may never end."""
    if not os.path.exists(path):  # Path.exists raises for a name that is too long
        raise InputError(f"{path}: does not exist; expected {form}")
    if not os.path.isfile(path) and not os.path.isdir(path):
        raise InputError(f"{path}: a pipe, a device or a socket; expected {form}, in a file")


@contextmanager
def damaged(path: Path | str, form: str) -> Iterator[None]:
    """Like `reading`, for a part of a file that exists, such as one message of a bag."""
    try:
        yield
    except SteelnbError:
        raise
    except Exception as fault:
        message = " ".join(str(fault).replace(str(path), "it").split())[:200] or type(fault).__name__
        raise InputError(f"{path}: not {form}: {message}") from None


def display_name(path: Path | str) -> str:
    """The name of a file for texts and pictures."""
    return printable(os.path.basename(path))


def printable(name: str) -> str:
    """A name for texts and pictures: bytes that are no UTF-8, and control signs, become �."""
    if name.isprintable():
        return name
    return "".join("\N{REPLACEMENT CHARACTER}" if unicodedata.category(c) in ("Cc", "Cs") else c for c in name)


def check_folder(target: Path, overwrite: bool, source: Path | None = None) -> None:
    """Raise `OutputError` if a folder is not empty, unless it may be overwritten, and if it is the ``source``."""
    if source is not None and os.path.realpath(target) == os.path.realpath(source):
        raise OutputError(f"{target}: is what is read; expected another folder")
    if not overwrite and os.path.exists(target) and (not target.is_dir() or any(target.iterdir())):
        raise OutputError(f"{target}: exists already; expected a new folder, or {OVERWRITE}")


def check_writable(target: Path | str) -> None:
    """Raise `OutputError` if a folder cannot be written to, or cannot be made."""
    try:
        with tempfile.TemporaryDirectory(prefix=".steelnb-", dir=_nearest(Path(target).absolute())):
            pass
    except OSError as fault:
        raise OutputError(f"{target}: cannot be written: {fault.strerror or fault}") from None


def _nearest(target: Path) -> Path:
    """The folder itself if it exists, else the nearest one above it that does."""
    return next(folder for folder in (target, *target.parents) if os.path.exists(folder))


@contextmanager
def new_folder(target: Path | str, stale: Sequence[str] = ()) -> Iterator[Path]:
    """A hidden folder to write to. At the end its files move to ``target``; on an error they are deleted.

    Files of the same names are replaced, and files that match a pattern of ``stale`` are removed. The hidden folder is
    created first, so a place that is not writable raises `OutputError` before any work is done.
    """
    target = Path(target).absolute()
    try:
        with tempfile.TemporaryDirectory(prefix=".steelnb-", dir=_nearest(target)) as scratch:
            yield Path(scratch)
            target.mkdir(parents=True, exist_ok=True)
            for old in [old for pattern in stale for old in target.glob(pattern)]:
                old.unlink(missing_ok=True)  # it may match twice
            for file in Path(scratch).iterdir():
                os.replace(file, target / file.name)
    except OSError as fault:
        raise OutputError(f"{target}: cannot be written: {fault.strerror or fault}") from None


@contextmanager
def new_file(target: Path | str) -> Iterator[Path]:
    """A path to write a file to. At the end the file replaces ``target``, in a folder that is made if needed; on an
    error it is deleted. Raises `OutputError`.

    Devices and pipes, such as /dev/stdout, are written to directly.
    """
    target = Path(target)
    if os.path.isdir(target):
        raise OutputError(f"{target}: a folder; expected the name of a file")
    if os.path.exists(target) and not os.path.isfile(target):
        yield target
    else:
        target = Path(os.path.realpath(target))  # a link stays one
        with new_folder(target.parent) as folder:
            yield folder / target.name
