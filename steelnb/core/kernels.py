"""`njit`: Numba's, with a cache of compiled code that may be missing, not writable or damaged, and a word to the user.

Numba raises "no locator available" at the import of a kernel if neither the package nor the user's home is writable,
and raises or crashes on damaged files of its cache.
"""

import contextlib
import functools
import os
import pickle
import stat
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import caching, event

from steelnb.core.sealed import Sealed

CACHE_DIR = "NUMBA_CACHE_DIR"
"""Numba's variable for the folder of its cache."""
QUIET_S = 2.0
"""Compiling for less than this is not mentioned."""
COMPILING = "compiling kernels, once, about two minutes"
"""What the user is told."""


def njit(*, cache: bool, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator like `numba.njit`. With ``cache``, compiled code is kept beside the source, else in the user's cache,
    else in a temporary folder; without any, it is compiled in every process. Damaged code is compiled again."""

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(**options)(function)
        if cache and kernel is not function:  # with NUMBA_DISABLE_JIT it is the function itself
            kernel._cache = _cache_of(function)
        return kernel

    return decorate


class _Places(caching.CompileResultCacheImpl):
    _locator_classes = [caching.UserProvidedCacheLocator, caching.InTreeCacheLocator]  # noqa: RUF012
    if os.path.isabs(os.path.expanduser("~")):  # else Numba makes a folder named ~
        _locator_classes = [*_locator_classes, caching.UserWideCacheLocator]


class _Files(caching.IndexDataCacheFile):
    def _dump(self, obj: Any) -> bytes:
        return pickle.dumps(Sealed(super()._dump(obj)))


class _KernelCache(caching.FunctionCache):
    """Files that cannot be loaded or saved cost time only."""

    _impl_class = _Places

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        files, impl = self._cache_file, self._impl
        self._cache_file = _Files(files._cache_path, impl.filename_base, impl.locator.get_source_stamp())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # damaged bytes raise anything
            try:
                Path(self._cache_file._index_path).unlink(missing_ok=True)
            except OSError as fault:
                self._give_up(fault)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except Exception as fault:  # of the disk, or of Numba, which cannot store some kernels
            self._give_up(fault)

    def _give_up(self, fault: Exception) -> None:
        text = f"{self.cache_path}: compiled code cannot be kept; delete the folder if it is damaged: {fault}"
        warnings.warn(text, stacklevel=2)
        self.disable()


def _cache_of(function: Callable[..., Any]) -> Any:
    try:
        return _KernelCache(function)
    except RuntimeError:  # no writable place
        _use_temporary_folder()
    try:
        return _KernelCache(function)
    except RuntimeError:
        return caching.NullCache()


@functools.cache
def _use_temporary_folder() -> None:
    """Give Numba a temporary folder, here and in the processes that this one starts, and warn."""
    kept = "it is compiled anew in every process"
    with contextlib.suppress(OSError):
        folder = Path(tempfile.gettempdir(), f"steelnb-{os.geteuid()}")
        folder.mkdir(mode=0o700, exist_ok=True)
        made = folder.lstat()
        # Code is loaded from it, so nobody else may write to it.
        if stat.S_ISDIR(made.st_mode) and made.st_uid == os.geteuid() and not made.st_mode & 0o022:
            os.environ[CACHE_DIR] = numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
            kept = f"it is kept in {folder}"
    warnings.warn(f"no writable cache for compiled code: {kept}; {CACHE_DIR} can name a folder for it", stacklevel=2)


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
