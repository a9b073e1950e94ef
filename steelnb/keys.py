"""Keys of results: hashes of what a notebook, a flight or a run of a study depends on.

One policy for all of them. Code counts by its syntax tree, without comments and docstrings, and only the modules that
are reached by imports from those named: editing a comment, or a module that a notebook never imports, re-runs nothing.
Nothing here imports a heavy library, and no module is executed.
"""

import ast
import functools
import hashlib
import json
import platform
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from steelnb.errors import InputError

PACKAGE = "steelnb"
PACKAGE_FOLDER = Path(__file__).resolve().parent
EXPERIMENTS_FILE = Path("notebooks", "experiments.toml")
DATA = (".toml", ".json", ".csv", ".txt", ".npz")


def find_root(start: Path | None = None) -> Path:
    """The nearest folder from ``start`` (default: the current one) upwards that holds ``notebooks/experiments.toml``,
    else the parent of the package. Raises `InputError`."""
    start = (start or Path.cwd()).resolve()
    for folder in (start, *start.parents, PACKAGE_FOLDER.parent):
        if (folder / EXPERIMENTS_FILE).is_file():
            return folder
    raise InputError(f"{start}: no {EXPERIMENTS_FILE} here or in a folder above; expected a steelnb project")


def digest(*values: Any) -> str:
    """SHA-256 of values that JSON can hold; the order of a table's keys does not count."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def file_digest(path: Path) -> str | None:
    """SHA-256 of a file's content, or None where there is no file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


def lock_digest(root: Path) -> str | None:
    """SHA-256 of ``environment.lock`` below ``root``, or None where there is none."""
    return file_digest(root / "environment.lock")


def environment_digest(root: Path) -> str:
    """Digest of Python's minor version and of ``environment.lock`` below ``root``."""
    return digest(platform.python_version_tuple()[:2], lock_digest(root))


def code_digest(module_names: Iterable[str]) -> str:
    """Digest of the code of some modules of the package, such as ``steelnb.experiment``, and of all that they reach.

    Names outside the package are passed over: `environment_digest` covers them. Data files of the package count for
    everything, TOML by its values.
    """
    code = [[name, _parse(path).code] for name, path in sorted(reachable(module_names).items())]
    return digest(code, [_data(path) for path in sorted(PACKAGE_FOLDER.rglob("*")) if path.suffix in DATA])


def reachable(module_names: Iterable[str]) -> dict[str, Path]:
    """The modules of the package, name → file, that the names given import, directly or not, and themselves.

    A name may be a module's or one that a module holds: ``steelnb.experiment``, ``steelnb.experiment.run``. Followed
    are imports at the top and inside functions, and texts that name a module (lazy imports), but not those below
    ``if TYPE_CHECKING``. ``steelnb`` itself, and the names that it hands on, reach every module.
    """
    files = {_module_name(path): path for path in PACKAGE_FOLDER.rglob("*.py")}
    found: dict[str, Path] = {}
    waiting = list(module_names)
    while waiting:
        for name in _executed(waiting.pop(), files):
            if name not in found:
                found[name] = files[name]
                waiting += _parse(files[name]).imports
    return found


def imported_names(tree: ast.AST) -> list[str]:
    """Dotted names of the package that the code of a syntax tree imports, and that its texts hold, sorted.

    ``from steelnb.a import b`` gives ``steelnb.a.b``, whether or not ``b`` is a module.
    """
    names: set[str] = set()
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            waiting += node.orelse
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and re.fullmatch(r"[\w.]+", node.value):
            names |= {node.value} - {PACKAGE}
        waiting += ast.iter_child_nodes(node)
    return sorted(name for name in names if name.split(".")[0] == PACKAGE)


def _executed(name: str, files: Mapping[str, Path]) -> list[str]:
    """The modules that Python executes when a dotted name is imported: the module and the packages above it, but not
    `steelnb/__init__.py`, which only hands on names of other modules."""
    parts = name.split(".")
    if parts[0] != PACKAGE or parts[1:] == ["__version__"]:
        return []
    known = [prefix for length in range(2, len(parts) + 1) if (prefix := ".".join(parts[:length])) in files]
    return known or list(files)


def _module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE_FOLDER).with_suffix("").parts
    return ".".join([PACKAGE, *(parts[:-1] if parts[-1] == "__init__" else parts)])


class _Parsed(NamedTuple):
    code: str
    imports: list[str]


def _parse(path: Path) -> _Parsed:
    status = path.stat()
    return _parse_version(path, status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=1024)
def _parse_version(path: Path, modified_ns: int, size: int) -> _Parsed:
    """Hash of the syntax tree of a file, and the names that it imports; read again when the file has changed."""
    tree = ast.parse(path.read_bytes())
    imports = imported_names(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            del node.body[: ast.get_docstring(node, clean=False) is not None]
    return _Parsed(digest(ast.dump(tree)), imports)


def _data(path: Path) -> list[Any]:
    name = path.relative_to(PACKAGE_FOLDER).as_posix()
    if path.suffix == ".npz":
        return [name, file_digest(path)]
    text = path.read_text(encoding="utf-8")
    return [name, repr(tomllib.loads(text)) if path.suffix == ".toml" else text]
