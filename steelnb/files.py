"""Atomic output: everything is written to a hidden folder beside its target and renamed at the end.

An error, Ctrl-C included, leaves the target and the folders above it as they were. The hidden folder that a killed
process left is removed by the next one that writes there.
"""

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from steelnb.errors import OutputError, SteelnbError

PREFIX = ".steelnb-"


@contextlib.contextmanager
def new_file(path: Path | str) -> Iterator[Path]:
    """Path to write a file to, of the same name, in a hidden folder; it becomes ``path`` at the end.

    An existing file is replaced. Raises `OutputError` if the place cannot be written.
    """
    path = Path(path)
    with _scratch(path.parent, str(path)) as folder:
        yield folder / path.name


@contextlib.contextmanager
def new_folder(target: Path | str, stale: Sequence[str] = ()) -> Iterator[Path]:
    """Hidden folder to write to; it becomes ``target`` at the end, or its files replace those in ``target``.

    The folder is made at once, so that an unwritable place raises `OutputError` before any work is done. Other files
    in ``target`` stay, except those that match a pattern of ``stale``.
    """
    with _scratch(Path(target), str(target), stale) as folder:
        yield folder


@contextlib.contextmanager
def _scratch(target: Path, shown: str, stale: Sequence[str] = ()) -> Iterator[Path]:
    """The hidden folder for ``target``; messages name ``shown``, the path that the user gave."""
    given, target = target, target.absolute()
    made = [folder for folder in (target, *target.parents) if not folder.exists()]
    try:
        # Inside an existing target, which may be writable where its parent is not; else beside it, on the same disk.
        place = target if not made else target.parent
        place.mkdir(parents=True, exist_ok=True)
        _remove_left(place)
        scratch = Path(tempfile.mkdtemp(prefix=PREFIX, dir=place))
        lock = os.open(scratch, os.O_RDONLY)
        with contextlib.suppress(OSError):  # on a disk without locks, what a killed process left stays
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as fault:
        _remove_empty(made)
        raise OutputError(f"{shown}: cannot be written: {fault.strerror or fault}") from None
    folder = scratch / "new"
    try:
        folder.mkdir()  # mkdtemp's own folder is closed to the group
        yield folder
        if made:
            os.rename(folder, target)
            return
        fresh = {file.name for file in folder.iterdir()}
        for name in sorted(fresh):
            os.replace(folder / name, target / name)
        for file in [file for pattern in stale for file in target.glob(pattern)]:
            if file.name not in fresh:
                file.unlink(missing_ok=True)
    except OSError as fault:
        raise OutputError(f"{shown}: cannot be written: {fault.strerror or fault}") from None
    except SteelnbError as fault:
        if str(folder) not in str(fault):
            raise
        raise type(fault)(str(fault).replace(str(folder), str(given))) from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        os.close(lock)
        if not target.exists():
            _remove_empty(made)


def _remove_left(place: Path) -> None:
    """Remove the hidden folders of processes that were killed: nobody holds their locks."""
    for folder in place.glob(f"{PREFIX}*/new"):  # which is made after the lock was taken
        with contextlib.suppress(OSError):
            lock = os.open(folder.parent, os.O_RDONLY)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder.parent, ignore_errors=True)
            finally:
                os.close(lock)


def _remove_empty(folders: Sequence[Path]) -> None:
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()
