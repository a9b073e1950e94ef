"""Results kept on disk between the notebooks of a project, so that what several of them need is computed once.

The environment variable ``STEELNB_CACHE`` names the folder; the workflow sets it to ``.cache`` of the project, and
without it nothing is kept. Several processes may read and write at once; a broken file counts as none.
"""

import contextlib
import os
import pickle
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from steelnb.keys import code_digest, digest, environment_digest

CACHE_VARIABLE = "STEELNB_CACHE"
BYTES_MAX = 2_000_000_000
"""Size of each kind: beyond it, the files that were used longest ago go."""

T = TypeVar("T")


def kept(kind: str, key: Callable[[], object], modules: Iterable[str], make: Callable[[], T]) -> T:
    """What ``make`` gives: read from the folder ``kind`` of the cache if it is there, else made and kept by pickle.

    A file belongs to ``key()``, which JSON can hold, to the code of the ``modules`` and all that they import, and to
    the versions of the libraries.
    """
    folder = os.environ.get(CACHE_VARIABLE)
    if not folder:
        return make()
    name = digest(key(), code_digest([__name__, *modules]), environment_digest(Path(folder).parent))
    path = Path(folder, kind, f"{name}.pickle")
    with contextlib.suppress(Exception):  # not there, or broken, which pickle tells in many ways
        with path.open("rb") as file:
            found: T = pickle.load(file)
        os.utime(path)
        return found
    made = make()
    fresh = path.with_suffix(f".{os.getpid()}.new")
    with contextlib.suppress(OSError):  # a full disk costs time, nothing else
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            fresh.write_bytes(pickle.dumps(made, protocol=5))
            os.replace(fresh, path)
        finally:
            fresh.unlink(missing_ok=True)
        _trim(path.parent)
    return made


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
