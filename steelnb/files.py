"""Files in and out: one boundary for what reading raises, and output that is whole or not there."""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from steelnb.errors import InputError, OutputError, SteelnbError


@contextmanager
def reading(path: Path | str, form: str, folder: bool = False) -> Iterator[None]:
    """Turn what reading a file raises, whichever library does it, into an `InputError` of one line.

    ``form`` names the expected content, such as "a PLY file", which is a ``folder`` or a file.
    """
    if not os.path.exists(path):
        raise InputError(f"{path}: does not exist; expected {form}")
    if os.path.isdir(path) != folder:
        raise InputError(f"{path}: a {'file' if folder else 'folder'}; expected {form}")
    with damaged(path, form):
        yield


@contextmanager
def damaged(path: Path | str, form: str) -> Iterator[None]:
    """`reading` for a part of a file that is known to exist, such as one message of a bag."""
    try:
        yield
    except SteelnbError:
        raise
    except Exception as fault:
        said = " ".join(str(fault).replace(str(path), "it").split())[:200] or type(fault).__name__
        raise InputError(f"{path}: not {form}: {said}") from None


def check_folder(target: Path, overwrite: bool) -> None:
    """Raise `OutputError` for a folder that holds a file, unless it may be overwritten."""
    if not overwrite and target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise OutputError(f"{target}: exists already; expected a new folder, or --force to overwrite")


@contextmanager
def new_folder(target: Path | str, stale: Sequence[str] = ()) -> Iterator[Path]:
    """Hidden folder to write to; at the end its files move to ``target``, and on an error they are gone.

    Files there of the same names are replaced, and those that match a pattern of ``stale`` are removed. The folder is
    made at once, so that an unwritable place raises `OutputError` before any work is done.
    """
    target = Path(target).absolute()
    place = next(folder for folder in (target, *target.parents) if folder.exists())
    try:
        with tempfile.TemporaryDirectory(prefix=".steelnb-", dir=place) as scratch:
            yield Path(scratch)
            target.mkdir(parents=True, exist_ok=True)
            for old in [old for pattern in stale for old in target.glob(pattern)]:
                old.unlink()
            for file in Path(scratch).iterdir():
                os.replace(file, target / file.name)
    except OSError as fault:
        raise OutputError(f"{target}: cannot be written: {fault.strerror or fault}") from None
