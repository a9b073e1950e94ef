"""Compiled code is cached where that is possible, and damaged or missing caches cost time only."""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from steelnb.core.cache import PACKAGE

KERNEL = """
from steelnb.core.kernels import njit

@njit(cache=True)
def inner(x):
    return x + 1.0

@njit(cache=True, error_model="numpy")
def outer(x):
    return inner(x) / 0.0
"""
DAMAGES = {
    "truncated": lambda whole: whole[: len(whole) // 2],
    "empty": lambda whole: b"",
    "of something else": lambda whole: b"hello",
    "zeros": lambda whole: bytes(len(whole)),
    "machine code changed": lambda whole: whole[:-200] + bytes(255 - byte for byte in whole[-200:-100]) + whole[-100:],
}


def hits(folder: Path) -> int:
    """Import the module anew and call its kernel; returns how many times machine code was loaded."""
    spec = importlib.util.spec_from_file_location("mine", folder / "mine.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.outer(1.0) == float("inf")
    return sum(module.outer.stats.cache_hits.values())


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a module of kernels, with their machine code."""
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    (tmp_path / "mine.py").write_text(KERNEL)
    assert (hits(tmp_path), hits(tmp_path)) == (0, 1)
    return tmp_path


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_damaged_code_is_compiled_again(module, suffix):
    for damage in DAMAGES.values():
        for file in module.rglob(f"*.{suffix}"):
            file.write_bytes(damage(file.read_bytes()))
        assert (hits(module), hits(module)) == (0, 1)


def test_a_place_that_cannot_be_mended_is_named(module):
    for file in module.rglob("*.nbi"):
        file.unlink()
        file.mkdir()
    with pytest.warns(UserWarning, match=f"{module}/__pycache__: compiled code cannot be kept; delete the folder"):
        assert hits(module) == 0


def test_without_a_writable_place_the_package_works(tmp_path):
    shutil.copytree(PACKAGE, tmp_path / "steelnb", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in {file.parent for file in (tmp_path / "steelnb").rglob("*.py")}:
        (folder / "__pycache__").write_text("")  # not even root can write to such a folder
    code = """if True:
        import numpy as np, ROOM
        from steelnb.core.cache import cached
        from steelnb.points.ranges import ranges_ahead
        assert len(ranges_ahead(np.ones((3, 1, 3)))) == cached(lambda: 3, "key")
        print(steelnb.__file__)
    """
    nowhere = {"PYTHONPATH": "", "HOME": "/dev/null", "STEELNB_CACHE": "/dev/null/cache", "TMPDIR": str(tmp_path)}
    for room, kept in (
        ("steelnb.notebook.study", f"it is kept in {tmp_path}/steelnb-"),
        ("steelnb.hough", "it is compiled anew in every process"),
    ):
        command = [sys.executable, "-c", code.replace("ROOM", room)]
        done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **nowhere}, cwd=tmp_path)
        assert (done.returncode, done.stdout) == (0, f"{tmp_path}/steelnb/__init__.py\n"), done.stderr
        assert done.stderr.count("no writable cache") == done.stderr.count(kept) == 1
        assert done.stderr.count("/dev/null/cache: nothing is cached here") == 1
        (folder,) = tmp_path.glob("steelnb-*")
        folder.chmod(0o777)  # now anyone could put code there
