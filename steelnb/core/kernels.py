"""`njit`: Numba's, with a folder of compiled code for these very sources, and a word to the user while it compiles.

A kernel's code contains that of the kernels it calls, and the constants it uses. Numba compiles it again if its own
file has changed, and does not look at the others. Therefore the folder's name has a digest of all files of the package
that say ``njit`` or ``register_jitable``: those with kernels, and those with a constant that kernels use.
"""

import functools
import hashlib
import os
import re
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import event

PACKAGE = Path(__file__).resolve().parents[1]
CACHE_DIR = "NUMBA_CACHE_DIR"
"""Numba's variable for the place of compiled code; the folder is then made in it."""
COMPILED = re.compile(rb"njit|register_jitable")
"""What stands in the files that determine what kernels compute."""
QUIET_S = 2.0
"""Compiling for less than this is not mentioned."""
COMPILING = "compiling kernels, once, about two minutes"
"""What the user is told."""


def njit(*, cache: bool, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator like `numba.njit`. With ``cache``, compiled code is kept in `kernel_folder`."""

    def decorate(function: Callable[..., Any]) -> Any:
        config: Any = numba.config
        folder, usual = kernel_folder() if cache else "", config.CACHE_DIR
        config.CACHE_DIR = folder  # Numba looks at it here only; kernels of other packages stay where they were
        try:
            return numba.njit(cache=bool(folder), **options)(function)
        finally:
            config.CACHE_DIR = usual

    return decorate


def digest_kernels(package: Path) -> str:
    """Digest of the sources that determine what kernels compute."""
    found = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        if COMPILED.search(text := path.read_bytes()):
            found.update(f"{path.relative_to(package)} {len(text)}\n".encode() + text)
    return found.hexdigest()[:16]


@functools.cache
def kernel_folder() -> str:
    """The folder of compiled code: in `CACHE_DIR` if the user sets it, else beside the package, else in the user's
    cache or a temporary folder. Empty, after a warning, if no place can be written to: kernels are then compiled in
    every process. Folders of earlier sources are deleted."""
    of_package = f"kernels-{hashlib.sha256(str(PACKAGE).encode()).hexdigest()[:8]}-"
    for place in _places():
        folder = place / f"{of_package}{digest_kernels(PACKAGE)}"
        try:
            place.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not _is_ours(place):
                continue
            if not folder.exists():
                for earlier in set(place.glob(f"{of_package}*")) - {folder}:
                    shutil.rmtree(earlier, ignore_errors=True)
                folder.mkdir(exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        return str(folder)
    warnings.warn(f"no place for compiled code: every process compiles; {CACHE_DIR} can name a folder", stacklevel=2)
    return ""


def _places() -> list[Path]:
    if chosen := os.environ.get(CACHE_DIR):
        return [Path(chosen).absolute()]
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # not absolute without a home
    temporary = Path(os.environ.get("TMPDIR") or "/tmp", f"steelnb-{os.geteuid()}")
    return [place for place in (PACKAGE / "__pycache__", Path(home, "steelnb"), temporary) if place.is_absolute()]


def _is_ours(place: Path) -> bool:
    """Whether nobody else can put code into a folder below one that all may write to, such as /tmp."""
    made = place.lstat()
    return not place.parent.stat().st_mode & 0o002 or (made.st_uid == os.geteuid() and not made.st_mode & 0o022)


class Compiling(event.Listener):  # type: ignore[misc]
    """Counts compiled kernels and the seconds they take, and tells the user once why nothing happens."""

    def __init__(self) -> None:
        self.count, self.seconds = 0, 0.0
        self._depth, self._began, self._told = 0, 0.0, False

    def on_start(self, event: Any) -> None:
        if self._depth == 0:
            self._began = time.monotonic()
            if self.seconds > QUIET_S and not self._told and ("ipykernel" in sys.modules or sys.stderr.isatty()):
                self._told = True
                print(f"steelnb: {COMPILING}", file=sys.stderr, flush=True)
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        self.count += 1
        if self._depth == 0:
            self.seconds += time.monotonic() - self._began


compiling = Compiling()
event.register("numba:compile", compiling)
