"""Keys follow the code that runs: no comment, no docstring, no module that is not imported."""

import ast
from pathlib import Path

import pytest

from steelnb import keys

PACKAGE = {
    "__init__.py": '"""Front."""\nfrom steelnb.a import run\n_LAZY = {"load": "steelnb.b"}\n__version__ = "1"\n',
    "a.py": "from steelnb.sub import inner\n\ndef run():\n    from steelnb import late\n    return inner.x + late.y\n",
    "b.py": "import importlib\n\nlater = importlib.import_module('steelnb.c')\n",
    "c.py": "from typing import TYPE_CHECKING\n\nif TYPE_CHECKING:\n    import steelnb.a\n",
    "d.py": "from steelnb import __version__\n",
    "e.py": "import steelnb\n\nprint(steelnb)\n",
    "late.py": "y = 1\n",
    "sub/__init__.py": "from steelnb.sub.other import z\n",
    "sub/inner.py": "x = 1\n",
    "sub/other.py": "z = 1\n",
    "sub/unused.py": "w = 1\n",
    "presets/fast.toml": "# fast\nrate_hz = 10\n",
}


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "steelnb"
    for name, text in PACKAGE.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    monkeypatch.setattr(keys, "PACKAGE_FOLDER", folder)
    return folder


@pytest.mark.parametrize(
    ("name", "reached"),
    [
        ("steelnb.a", "a late sub sub.inner sub.other"),
        ("steelnb.a.run", "a late sub sub.inner sub.other"),
        ("steelnb.b", "b c"),
        ("steelnb.c", "c"),
        ("steelnb.d", "d"),
        ("steelnb.sub.unused", "sub sub.other sub.unused"),
        ("numpy.linalg", ""),
    ],
)
def test_imports_are_followed(package: Path, name: str, reached: str) -> None:
    assert set(keys.reachable([name])) == {f"steelnb.{each}" for each in reached.split()}


@pytest.mark.parametrize("name", ["steelnb.e", "steelnb.*", "steelnb.run"])
def test_the_package_and_the_names_of_its_front_page_reach_everything(package: Path, name: str) -> None:
    assert len(keys.reachable([name])) == 11


@pytest.mark.parametrize(
    ("file", "old", "new", "changes"),
    [
        ("a.py", "def run():\n", 'def run():\n    """Doc."""\n    # why\n\n', False),
        ("sub/unused.py", "w = 1", "w = 2", False),
        ("presets/fast.toml", "# fast", "# slow", False),
        ("presets/fast.toml", "10", "20", True),
        ("a.py", "inner.x + late.y", "inner.x - late.y", True),
        ("late.py", "y = 1", "y = 2", True),
        ("sub/other.py", "z = 1", "z = '1'", True),
    ],
)
def test_code_digest_follows_code_alone(package: Path, file: str, old: str, new: str, changes: bool) -> None:
    before = keys.code_digest(["steelnb.a"])
    text = (package / file).read_text()
    assert old in text
    (package / file).write_text(text.replace(old, new))
    assert (keys.code_digest(["steelnb.a"]) != before) is changes


def test_names_come_from_imports_uses_and_texts() -> None:
    source = "import numpy\nfrom steelnb.a import b as c\nimport steelnb.d\nx = 'steelnb.f', 'steelnb is'\n"
    assert keys.imported_names(ast.parse(source)) == ["steelnb.a.b", "steelnb.d", "steelnb.f"]
