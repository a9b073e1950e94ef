"""What was computed once is kept on disk by joblib: flights, estimates and rows of runs.

Keys are settings as JSON, the data that an estimator was given, and `SOURCES`. Several processes may read and write at
once; what cannot be read is computed again.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from joblib import Memory

CACHE_VARIABLE = "STEELNB_CACHE"
"""Names the folder; the workflow sets it to ``.cache`` of the project, and without it nothing is kept."""
BYTES_MAX = 2_000_000_000
"""Beyond it, what was used longest ago goes when a process first uses the folder."""
PACKAGE = Path(__file__).resolve().parent
APART = ("report", "cli.py", "__main__.py")
"""Parts of the package that change no number."""
LIBRARIES = (
    "imufusion", "kiss-icp", "numba", "numpy", "open3d", "open3d-cpu", "opencv-python-headless", "pybullet", "scipy",
    "small-gicp",
)  # fmt: skip
"""Libraries that compute."""

T = TypeVar("T")


def digest_sources(apart: tuple[str, ...] = APART) -> str:
    """SHA-256 of the files of the package except those ``apart``, and of the installed versions of `LIBRARIES`."""
    found = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*")):
        name = path.relative_to(PACKAGE)
        if path.is_file() and name.parts[0] not in apart and "__pycache__" not in name.parts:
            found.update(f"{name} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    for library in LIBRARIES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found.update(f"{library} {importlib.metadata.version(library)}\n".encode())
    return found.hexdigest()


SOURCES = digest_sources()
"""As they were when this process loaded them: an edit while it runs changes nothing here."""


def kept(make: Callable[[], T], *key: object, folder: str | None = None) -> T:
    """What ``make`` gives: read from ``folder``, by default the one that `CACHE_VARIABLE` names, if it is there, else
    made and kept. What raises is not kept. joblib hashes the ``key``, arrays by their content."""
    folder = folder or os.environ.get(CACHE_VARIABLE)
    if not folder:
        return make()
    return _memory(folder).cache(_made, ignore=["make"])(make, key, SOURCES)


def _made(make: Callable[[], T], key: tuple[object, ...], sources: str) -> T:
    return make()


@functools.cache
def _memory(folder: str) -> "Memory":
    from joblib import Memory

    memory = Memory(folder, verbose=0)
    memory.reduce_size(bytes_limit=BYTES_MAX)
    return memory
