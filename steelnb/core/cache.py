"""A cache on disk, by joblib, for flights, estimates and rows of runs.

Keys are settings as JSON, the input data of an estimator, and `SOURCES`. Several processes may use the cache at once.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import os
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from joblib import Memory

CACHE_VARIABLE = "STEELNB_CACHE"
"""Environment variable that names the cache's folder; the workflow sets it to the project's ``.cache``. Without it,
nothing is cached."""
BYTES_MAX = 2_000_000_000
"""Above this size, the least recently used entries are deleted when a process first uses the folder."""
PACKAGE = Path(__file__).resolve().parents[1]
ROOMS = (
    "core", "settings", "simulation", "points", "hough", "registration", "fusion", "odometry", "planning", "metrics",
    "io", "experiment.py",
)  # fmt: skip
"""The rooms that flights and estimates depend on."""
LIBRARIES = (
    "imufusion", "kiss-icp", "numba", "numpy", "open3d", "open3d-cpu", "opencv-python-headless", "pybullet", "scipy",
    "small-gicp",
)  # fmt: skip
"""Libraries that affect results."""

T = TypeVar("T")


def digest_rooms(*rooms: str) -> str:
    """SHA-256 of the package's files in some ``rooms``, all if none is named, and of the installed versions of
    `LIBRARIES`."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*")):
        name = path.relative_to(PACKAGE)
        if path.is_file() and (not rooms or name.parts[0] in rooms) and "__pycache__" not in name.parts:
            digest.update(f"{name} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    for library in LIBRARIES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            digest.update(f"{library} {importlib.metadata.version(library)}\n".encode())
    return digest.hexdigest()


SOURCES = digest_rooms(*ROOMS)
"""Computed when this process starts, so later edits do not change it."""


def cached(make: Callable[[], T], *key: object, folder: str | None = None) -> T:
    """The result of ``make``, cached in ``folder`` (default: the folder in `CACHE_VARIABLE`). Exceptions are not
    cached. joblib hashes the ``key``, arrays by their content."""
    folder = folder or os.environ.get(CACHE_VARIABLE)
    if not folder:
        return make()
    memory = _memory(folder)
    if memory is None:
        return make()
    return memory.cache(_call, ignore=["make"])(make, key, SOURCES)


def _call(make: Callable[[], T], key: tuple[object, ...], sources: str) -> T:
    return make()


@functools.cache
def _memory(folder: str) -> "Memory | None":
    """The cache in a folder. None, after a warning, if it is not writable."""
    from joblib import Memory

    try:
        memory = Memory(folder, verbose=0)
        tempfile.TemporaryFile(dir=folder).close()
        memory.reduce_size(bytes_limit=BYTES_MAX)
    except OSError as fault:
        warnings.warn(f"{folder}: nothing is cached here: {fault.strerror or fault}", stacklevel=3)
        return None
    return memory
