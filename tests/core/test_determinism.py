"""`steelnb.core.determinism`: libraries make the same choices on every processor."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from steelnb.core import determinism

PINS = dict(line.split("=", 1) for line in Path(determinism.FILE).read_text(encoding="utf-8").split())


def features(**found: bool) -> SimpleNamespace:
    return SimpleNamespace(_core=SimpleNamespace(_multiarray_umath=SimpleNamespace(__cpu_features__=found)))


@pytest.fixture
def modern(monkeypatch):
    """A processor with AVX2, before anything is imported."""
    monkeypatch.setattr(determinism, "missing_features", lambda: "")
    monkeypatch.delitem(sys.modules, "numpy", raising=False)


def test_variables_are_set_unless_the_user_has_set_them(modern):
    environment = {"OMP_NUM_THREADS": "4"}
    determinism.pin(environment)
    assert environment == {**PINS, "OMP_NUM_THREADS": "4"}
    numpy_disables = {determinism.NUMPY_DISABLES: "X86_V4"}  # NumPy takes only one of its two variables
    determinism.pin(numpy_disables)
    assert determinism.NUMPY_ENABLES not in numpy_disables


def test_numpy_starts_with_the_variables():
    code = "import steelnb, numpy; from numpy._core._multiarray_umath import __cpu_features__ as f; print(f['X86_V4'])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"


@pytest.mark.parametrize(
    ("avx512", "warned"),
    [({"X86_V4": True}, 1), ({"X86_V4": False}, 0), ({"X86_V4": False, "AVX512F": True}, 0), ({"AVX512F": True}, 1)],
)
def test_numpy_imported_before_matters_only_if_it_uses_avx512(modern, monkeypatch, recwarn, avx512, warned):
    monkeypatch.setitem(sys.modules, "numpy", features(**avx512))
    determinism.pin({})
    assert len(recwarn) == warned


def test_a_processor_without_avx2_is_named_and_numpy_still_starts(monkeypatch, tmp_path, recwarn):
    (tmp_path / "old").write_text("model name : Xeon\nflags : sse4_2 avx fma\n")
    (tmp_path / "new").write_text("model name : Xeon\nflags : sse4_2 avx avx2 fma\n")
    assert determinism.missing_features(str(tmp_path / "old")) == "AVX2"
    assert not any(determinism.missing_features(str(tmp_path / name)) for name in ("new", "none"))
    monkeypatch.setattr(determinism, "missing_features", lambda: "AVX2")
    environment: dict[str, str] = {}
    determinism.pin(environment)
    assert determinism.NUMPY_ENABLES not in environment
    assert len(recwarn) == 1
