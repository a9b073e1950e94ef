"""Compiled code belongs to the sources that made it, is kept where that is possible, and is never needed."""

import ast
import importlib
import inspect
import os
import pkgutil
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from steelnb.core.cache import PACKAGE
from steelnb.core.kernels import COMPILED

INNER = "from steelnb.core.kernels import njit\n@njit(cache=True)\ndef inner(x):\n    return x + 1.0\n"
CONSTANT = "OFFSET = 10.0  # of njit\n"
OUTER = """
from steelnb.core.kernels import compiling, njit
from steelnb.points.constant import OFFSET
from steelnb.points.inner import inner

@njit(cache=True)
def outer(x):
    return inner(x) + OFFSET

print(outer(1.0), compiling.count > 0)
"""
WORLD = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "STEELNB_CACHE")}


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package with a kernel that calls one of another file and uses a constant of a third."""
    package = tmp_path / "steelnb"
    (package / "core").mkdir(parents=True)
    for name in ("__init__.py", "core/__init__.py", "core/determinism.py", "core/pins.env", "core/kernels.py"):
        shutil.copy(PACKAGE / name, package / name)
    (package / "points").mkdir()
    for name, text in {"inner": INNER, "constant": CONSTANT, "outer": OUTER}.items():
        (package / "points" / f"{name}.py").write_text(text)
    return package


def run(package: Path, code: str = "import steelnb.points.outer", **variables: str) -> subprocess.CompletedProcess:
    environment = {**WORLD, "PYTHONPATH": "", "PYTHONDONTWRITEBYTECODE": "1", **variables}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=package.parent)


def test_a_change_of_one_file_changes_what_kernels_of_others_compute(package):
    """In the next process: the value, and whether anything was compiled."""
    assert [run(package).stdout.split() for _ in range(2)] == [["12.0", "True"], ["12.0", "False"]]
    for name, text, expected in (
        ("inner", INNER.replace("+ 1.0", "+ 2.0"), "13.0"), ("constant", "OFFSET = 20.0  # of njit\n", "23.0"),
    ):  # fmt: skip
        (package / "points" / f"{name}.py").write_text(text)
        assert run(package).stdout.split() == [expected, "True"]
        assert len(list(package.rglob("kernels-*"))) == 1, "those of earlier sources are deleted"
    (package / "points" / "other.py").write_text("a = 1\n")
    assert run(package).stdout.split() == [expected, "False"]


def test_the_place_that_the_user_names_holds_a_folder_for_each_package(package, tmp_path):
    place = tmp_path / "mine"
    shutil.copytree(package, tmp_path / "second" / "steelnb")
    for each in (package, tmp_path / "second" / "steelnb"):
        assert run(each, NUMBA_CACHE_DIR=str(place)).stdout.split() == ["12.0", "True"]
    (package / "points" / "inner.py").write_text(INNER.replace("+ 1.0", "+ 2.0"))
    assert run(package, NUMBA_CACHE_DIR=str(place)).stdout.split() == ["13.0", "True"]
    assert run(tmp_path / "second" / "steelnb", NUMBA_CACHE_DIR=str(place)).stdout.split() == ["12.0", "False"]
    assert len(list(place.iterdir())) == 2
    assert not list(package.rglob("kernels-*"))


def test_without_a_writable_place_kernels_work(package, tmp_path):
    (package / "__pycache__").write_text("")  # not even root can write to such a folder
    nowhere = {"HOME": "/dev/null", "XDG_CACHE_HOME": "", "TMPDIR": str(tmp_path)}
    assert [run(package, **nowhere).stdout.split() for _ in range(2)] == [["12.0", "True"], ["12.0", "False"]]
    (kept,) = tmp_path.glob("steelnb-*")
    kept.chmod(0o777)
    tmp_path.chmod(0o777)  # now anyone could put code there
    done = run(package, **nowhere)
    assert done.stdout.split() == ["12.0", "True"]
    assert done.stderr.count("NUMBA_CACHE_DIR can name a folder") == 1
    assert run(package, NUMBA_CACHE_DIR=str(tmp_path / "mine"), **nowhere).stderr == ""


def test_constants_in_kernels_come_from_files_that_count():
    for info in pkgutil.walk_packages([str(PACKAGE)], "steelnb."):
        path = Path(info.module_finder.path, f"{info.name.rpartition('.')[2]}.py")
        if not path.is_file() or not COMPILED.search(path.read_bytes()):
            continue
        imports = [each for each in ast.walk(ast.parse(path.read_text())) if isinstance(each, ast.ImportFrom)]
        home = {alias.asname or alias.name: each.module for each in imports for alias in each.names}
        for value in vars(importlib.import_module(info.name)).values():
            kernel = getattr(value, "py_func", None)
            used = kernel.__code__.co_names if kernel and kernel.__module__ == info.name else ()
            for name in used:
                if home.get(name, "").startswith("steelnb"):
                    found = getattr(importlib.import_module(home[name]), name)
                    source = found if inspect.ismodule(found) else importlib.import_module(home[name])
                    assert COMPILED.search(Path(source.__file__).read_bytes()), f"{info.name}: {name} of {source}"


def test_the_package_works_if_nothing_can_be_written(tmp_path):
    shutil.copytree(PACKAGE, tmp_path / "steelnb", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in {file.parent for file in (tmp_path / "steelnb").rglob("*.py")}:
        (folder / "__pycache__").write_text("")
    code = """if True:
        import numpy as np, steelnb.hough
        from steelnb.core.cache import cached
        from steelnb.points.ranges import ranges_ahead
        assert len(ranges_ahead(np.ones((3, 1, 3)))) == cached(lambda: 3, "key")
        print(steelnb.__file__)
    """
    nowhere = {"HOME": "/dev/null", "XDG_CACHE_HOME": "", "TMPDIR": "/dev/null", "STEELNB_CACHE": "/dev/null/cache"}
    done = run(tmp_path / "steelnb", code, **nowhere)
    assert (done.returncode, done.stdout) == (0, f"{tmp_path}/steelnb/__init__.py\n"), done.stderr
    assert done.stderr.count("no place for compiled code") == done.stderr.count("nothing is cached here") == 1
