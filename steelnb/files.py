"""Files in and out: one boundary for what reading raises, and atomic output.

Everything is written to a hidden folder beside its target and renamed at the end. An error, Ctrl-C included, leaves the
target and the folders above it as they were. The hidden folder that a killed process left is removed by the next one
that writes there.
"""

import contextlib
import fcntl
import io
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from steelnb.errors import FileContentError, FileMissingError, OutputError, SteelnbError

PREFIX = ".steelnb-"
LINE_BYTES_MAX = 1 << 20
"""Longest line of a text file that is read."""
_SHOWN = 200


@contextlib.contextmanager
def reading(
    path: Path | str, form: str, folder: bool = False, content: type[SteelnbError] = FileContentError
) -> Iterator[None]:
    """Turn what reading a file raises, whichever library does it, into one line that begins with the file's name.

    ``form`` names the expected content, such as "a PLY file". Raises `FileMissingError` for what is not there or cannot
    be opened, for pipes and devices, and for folders unless ``folder``; ``content`` for all else that is no error of
    ours, a lack of memory and the panics of Rust libraries, which are no `Exception`, among it.
    """
    try:
        if os.path.exists(path) and not os.path.isfile(path) and not (folder and os.path.isdir(path)):
            kind = "a folder" if os.path.isdir(path) else "a pipe or a device"
            raise FileMissingError(f"{path}: {kind}; expected {form}")
        yield
    except (SteelnbError, GeneratorExit, KeyboardInterrupt, SystemExit):
        raise
    except BaseException as fault:
        if isinstance(fault, OSError) and fault.errno is not None:
            raise FileMissingError(f"{path}: cannot be read: {fault.strerror}; expected {form}") from None
        said = " ".join(str(fault).replace(f"{path}", "it").split())[:_SHOWN].rstrip(".") or type(fault).__name__
        raise content(f"{path}: not {form}: {said}") from None


def open_lines(path: Path) -> io.BufferedReader:
    """Open a text file for its bytes.

    Reading raises `FileContentError` for zero bytes, which are no text, and for a line of more than `LINE_BYTES_MAX`.
    """
    return io.BufferedReader(_Lines(path), 1 << 18)


class _Lines(io.FileIO):
    """A file of lines of bounded length, so that no reader holds a whole file for want of a line end."""

    _since_end = 0

    def readinto(self, buffer) -> int | None:  # type: ignore[no-untyped-def]
        count = super().readinto(buffer)
        data = bytes(memoryview(buffer)[:count])
        last = max(data.rfind(b"\n"), data.rfind(b"\r"))
        self._since_end = count - last - 1 if last >= 0 else self._since_end + (count or 0)
        if b"\0" in data:
            raise FileContentError(f"{self.name}: holds zero bytes; expected text in UTF-8 or ASCII")
        if self._since_end > LINE_BYTES_MAX:
            raise FileContentError(f"{self.name}: a line of more than {LINE_BYTES_MAX} bytes; expected shorter ones")
        return count


def plain_name(path: Path) -> str:
    """The name of a file for titles, tables and other programs: bytes that are no UTF-8 are replaced."""
    return os.fsencode(path.name).decode("utf-8", errors="replace")


@contextlib.contextmanager
def new_file(path: Path | str) -> Iterator[Path]:
    """Path to write a file to, of the same name, in a hidden folder; it becomes ``path`` at the end.

    An existing file is replaced. Raises `OutputError` if the place cannot be written.
    """
    path = Path(path)
    with _scratch(path.parent, str(path)) as folder:
        yield folder / path.name


@contextlib.contextmanager
def new_folder(target: Path | str, stale: Sequence[str] = (), overwrite: bool = True) -> Iterator[Path]:
    """Hidden folder to write to; it becomes ``target`` at the end, or its files replace those in ``target``.

    The folder is made at once, so that an unwritable place raises `OutputError` before any work is done. Other files
    in ``target`` stay, except those that match a pattern of ``stale``. Without ``overwrite``, a file that exists by the
    end raises `OutputError`, as does a folder in the place of a file; nothing is replaced then. Of several processes
    that write to one target, each puts all its files there before the next one does.
    """
    with _scratch(Path(target), str(target), stale, overwrite) as folder:
        yield folder


def replace_files(folder: Path, target: Path, stale: Sequence[str]) -> None:
    """Move all files of a finished ``folder``, which is gone then, to an existing one on the same disk.

    Files there of the same names are replaced, those that match a pattern of ``stale`` removed, and all others stay.
    Raises `OutputError` as `new_folder`.
    """
    with new_folder(target, stale) as new:
        for file in folder.iterdir():
            os.replace(file, new / file.name)
        folder.rmdir()


@contextlib.contextmanager
def _scratch(target: Path, shown: str, stale: Sequence[str] = (), overwrite: bool = True) -> Iterator[Path]:
    """The hidden folder for ``target``; messages name ``shown``, the path that the user gave."""
    given, target, made = target, target.absolute(), list[Path]()
    try:
        made += [folder for folder in (target, *target.parents) if not folder.exists()]
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
            try:
                os.rename(folder, target)
                return
            except OSError:
                if not target.is_dir():
                    raise
        _publish(folder, target, given, stale, overwrite)  # another process may have made the target since
    except OSError as fault:
        raise OutputError(f"{shown}: cannot be written: {fault.strerror or fault}") from None
    except SteelnbError as fault:
        if str(folder) not in str(fault):
            raise
        raise type(fault)(str(fault).replace(str(folder), str(given))) from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        os.close(lock)
        if not os.path.exists(target):
            _remove_empty(made)


def _publish(folder: Path, target: Path, given: Path, stale: Sequence[str], overwrite: bool) -> None:
    """Move all files to an existing folder, or none where one of them may not replace what is there."""
    lock = os.open(target, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_EX)
        fresh = sorted(file.name for file in folder.iterdir())
        for name in fresh:
            if os.path.isdir(target / name) or (not overwrite and os.path.lexists(target / name)):
                raise OutputError(f"{given / name}: exists already; expected a new name, or a file to replace")
        for name in fresh:
            os.replace(folder / name, target / name)
        for file in [file for pattern in stale for file in target.glob(pattern)]:
            if file.name not in fresh:
                file.unlink(missing_ok=True)
    finally:
        os.close(lock)


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
