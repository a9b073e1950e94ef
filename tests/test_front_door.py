"""`import steelnb`: the public names, their docstrings, and that it imports little."""

import inspect
import subprocess
import sys

import pytest

import steelnb

HEAVY = ("numba", "open3d", "pybullet", "pandas", "matplotlib", "evo", "dask", "rosbags", "scipy")


def test_every_public_name_can_be_had_and_says_what_it_is():
    for name in steelnb.__all__:
        value = getattr(steelnb, name)
        if name != "__version__":
            text = inspect.getdoc(value) or ""
            assert len(text) > 20, name
            assert not text.startswith(f"{name}("), name  # dataclasses without a docstring describe their signature
    assert set(dir(steelnb)) == set(steelnb.__all__)


def test_an_unknown_name_is_refused():
    with pytest.raises(AttributeError, match="'detect_planes'"):
        steelnb.detect_planes  # noqa: B018


def test_the_import_alone_is_light():
    command = [sys.executable, "-c", f"import sys, steelnb; print(sorted({set(HEAVY)!r} & set(sys.modules)))"]
    assert subprocess.run(command, capture_output=True, check=True).stdout.strip() == b"[]"
