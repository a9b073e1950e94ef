"""Arrays kept on disk between the notebooks of a project, so that what several of them need is computed once.

The environment variable ``STEELNB_CACHE`` names the folder; the workflow sets it to ``.cache`` of the project, and
without it nothing is kept. Several processes may read and write at once; a broken file counts as none.
"""

import contextlib
import os
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from steelnb.keys import code_digest, digest, environment_digest

CACHE_VARIABLE = "STEELNB_CACHE"
BYTES_MAX = 2_000_000_000
"""Size of each kind: beyond it, the files that were used longest ago go."""

T = TypeVar("T")
Arrays = Mapping[str, Any]


def kept(
    kind: str,
    key: Callable[[], object],
    modules: Iterable[str],
    make: Callable[[], T],
    pack: Callable[[T], Arrays],
    unpack: Callable[[Arrays], T],
) -> T:
    """What ``make`` gives: read by ``unpack`` from the folder ``kind`` of the cache if it is there, else made and kept
    as the arrays of ``pack``. A file belongs to ``key()``, which JSON can hold, to the code of the ``modules`` and all
    that they import, and to the versions of the libraries.
    """
    folder = os.environ.get(CACHE_VARIABLE)
    if not folder:
        return make()
    name = digest(key(), code_digest([__name__, *modules]), environment_digest(Path(folder).parent))
    path = Path(folder, kind, f"{name}.npz")
    with contextlib.suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):  # not there, or broken
        with np.load(path) as arrays:
            found = unpack(arrays)
        os.utime(path)
        return found
    made = make()
    with contextlib.suppress(OSError):  # a full disk costs time, nothing else
        _write(path, pack(made))
        _trim(path.parent)
    return made


def _write(path: Path, arrays: Arrays) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_suffix(f".{os.getpid()}.new")
    try:
        with fresh.open("wb") as file:
            np.savez(file, **arrays)
        os.replace(fresh, path)
    finally:
        fresh.unlink(missing_ok=True)


def _trim(folder: Path) -> None:
    """Remove files used longest ago, until the folder is small enough; files of a killed process go the same way."""
    files = []
    for path in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):  # another process was faster
            status = path.stat()
            files.append((status.st_mtime_ns, status.st_size, path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= BYTES_MAX:
            return
        path.unlink(missing_ok=True)
        total -= size
