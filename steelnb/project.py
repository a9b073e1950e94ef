"""The notebooks and their parameters: what `experiments.toml` says, checked before a notebook is run.

Nothing here imports a heavy module, so that a call that has nothing to do ends at once.
"""

import ast
import difflib
import hashlib
import inspect
import itertools
import json
import platform
import re
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

import steelnb
from steelnb.config import ExperimentSettings, Positive, Settings
from steelnb.errors import FileMissingError, NotebookError, OutputError, SettingsError, UnknownExperimentError
from steelnb.toml_file import read_toml

EXPERIMENTS_FILE = Path("notebooks", "experiments.toml")
RESULT_FOLDERS = {"full": "results", "smoke": "results-smoke"}
FLOAT_MAX = sys.float_info.max
PRESET_ARGUMENTS = tuple(inspect.signature(ExperimentSettings.preset).parameters)


class Experiment(Settings):
    """One table of `experiments.toml`: a notebook, its parameters for each budget, and a matrix of parts.

    ``about`` is a sentence for the gallery, which without one takes the notebook's first. ``inputs`` are files of the
    project that the notebook reads: when one changes, it is run again. One that is ``apart`` is too long for every day:
    at the full budget it runs only when it is named.
    """

    id: str
    notebook: str
    title: str
    about: str = ""
    figures: str = ""
    matrix: dict[str, list[Any]] = Field(default_factory=dict)
    full: dict[str, Any]
    smoke: dict[str, Any]
    inputs: list[str] = Field(default_factory=list)
    expected_s: Positive | None = None
    apart: bool = False


class CheckSettings(Settings):
    """The table ``[check]``: tolerance, and glob of ``<id>.<metric or column>`` → reason why it may differ."""

    relative_tolerance: Positive = 1e-6
    exceptions: dict[str, str] = Field(default_factory=dict)


@dataclass(frozen=True)
class Part:
    """One execution of a notebook. ``name`` is empty where the experiment has a single part; ``inputs`` are the files
    that it reads, and ``key`` is the hash of all it depends on."""

    experiment: str
    name: str
    notebook: Path
    parameters: dict[str, Any]
    key: str
    inputs: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        return f"{self.experiment}/{self.name}" if self.name else self.experiment


def find_root(start: Path | None = None) -> Path:
    """The nearest folder from ``start`` (default: the current one) upwards that holds ``notebooks/experiments.toml``,
    else the parent of the package. Raises `FileMissingError`."""
    start = (start or Path.cwd()).resolve()
    for folder in (start, *start.parents, Path(steelnb.__file__).resolve().parent.parent):
        if (folder / EXPERIMENTS_FILE).is_file():
            return folder
    raise FileMissingError(f"{start}: no {EXPERIMENTS_FILE} here or in a folder above; expected a steelnb project")


def _probe(folder: Path) -> None:
    """Raise `OutputError` unless a file can be written where ``folder`` is or will be; leaves nothing behind."""
    place = next(path for path in (folder, *folder.parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=place):
            pass
    except OSError as fault:
        raise OutputError(f"{folder}: cannot be written: {fault.strerror}") from None


def lock_digest(root: Path) -> str | None:
    """SHA-256 of ``environment.lock``, or None where there is none."""
    return file_digest(root / "environment.lock")


def file_digest(path: Path) -> str | None:
    """SHA-256 of a file's content, or None where there is no file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


class Project:
    """The experiments below ``root``. Raises `FileMissingError` or `SettingsError`."""

    def __init__(self, root: Path | None = None) -> None:
        self.root = root.resolve() if root else find_root()
        path = self.root / EXPERIMENTS_FILE
        tables = read_toml(path)
        self.check = CheckSettings(**tables.pop("check", {}))
        self.experiments = {name: self._experiment(name, table) for name, table in tables.items()}
        self.cache = self.root / ".cache" / "reproduce"

    @staticmethod
    def _experiment(name: str, table: Any) -> Experiment:
        if not re.fullmatch(r"[a-z0-9][a-z0-9_-]*", name) or not isinstance(table, dict):
            raise SettingsError(f"{EXPERIMENTS_FILE}: {name!r}: expected a table named in small letters and hyphens")
        try:
            return Experiment(id=name, **table)
        except SettingsError as fault:
            raise SettingsError(f"{EXPERIMENTS_FILE}: [{name}]: {fault}") from None

    def select(self, ids: Iterable[str] = (), apart: bool = True) -> list[Experiment]:
        """The experiments named, in the file's order; all if none is named. Raises `UnknownExperimentError`.

        Without ``apart``, those that run apart are left out unless they are named.
        """
        ids = list(ids)
        for name in ids:
            if name not in self.experiments:
                known = ", ".join(self.experiments)
                raise UnknownExperimentError(
                    f"unknown experiment {name!r}{_guess(name, self.experiments)}; known: {known}"
                )
        return [
            experiment
            for name, experiment in self.experiments.items()
            if name in ids or (not ids and (apart or not experiment.apart))
        ]

    def parts(self, experiment: Experiment, budget: str, given: Mapping[str, Any] | None = None) -> list[Part]:
        """The notebook executions of one experiment, every parameter checked. Raises `SettingsError`.

        ``given`` are the user's parameters; they win over budget and matrix, and a matrix axis they name is dropped.
        A dotted name, such as ``tof.rate_hz``, goes into the notebook's parameter ``overrides``.
        """
        if budget not in RESULT_FOLDERS:
            raise SettingsError(f"budget = {budget!r}: expected one of {', '.join(RESULT_FOLDERS)}")
        notebook = self.root / "notebooks" / experiment.notebook
        defaults = read_parameters(notebook)
        user = {name: value for name, value in (given or {}).items() if "." not in name}
        dotted = {name: value for name, value in (given or {}).items() if "." in name}
        chosen = {**getattr(experiment, budget), **user}
        if dotted and "overrides" in defaults:
            chosen["overrides"] = {**chosen.get("overrides", defaults["overrides"]), **dotted}
        elif dotted:
            chosen.update(dotted)
        axes = {name: values for name, values in experiment.matrix.items() if name not in user}
        parts, inputs = [], tuple(experiment.inputs)
        for combination in itertools.product(*axes.values()):
            values = fit_parameters(experiment.id, {**chosen, **dict(zip(axes, combination, strict=True))}, defaults)
            check_settings(experiment.id, {**defaults, **values})
            name = "-".join(re.sub(r"[^A-Za-z0-9_.]+", "-", str(value)) for value in combination)
            key = self.key(notebook, values, inputs)
            parts.append(Part(experiment.id, name, notebook, values, key, inputs))
        names = [part.name for part in parts]
        if len(set(names)) != len(names) or not parts:
            raise SettingsError(
                f"{EXPERIMENTS_FILE}: [{experiment.id}]: matrix: expected distinct values on every axis"
            )
        return parts

    def output_folder(self, budget: str, given: Mapping[str, Any], output: Path | None) -> Path:
        """Where results go, ``<folder>/<id>/``. Raises `SettingsError` if a run with parameters of its own, or a smoke
        run, would touch the full results, and `OutputError` if nothing can be written there."""
        if output is None and given:
            raise SettingsError(f"-p {next(iter(given))}: parameters of your own want an output folder, -o FOLDER")
        folder = (output or self.root / RESULT_FOLDERS[budget]).resolve()
        full = (self.root / RESULT_FOLDERS["full"]).resolve()
        if (given or budget != "full") and folder.is_relative_to(full):
            raise SettingsError(f"-o {output}: expected a folder outside {full}, which holds the default results")
        for place in (folder, self.cache):
            _probe(place)
        return folder

    def key(self, notebook: Path, parameters: Mapping[str, Any], inputs: Iterable[str] = ()) -> str:
        """Hash of what a part depends on: the source of its cells (no outputs), parameters, files that it reads, code,
        lock and Python."""
        cells = read_cells(notebook)
        source = [[cell["cell_type"], _source(cell), cell.get("metadata", {}).get("tags", [])] for cell in cells]
        python = platform.python_version_tuple()[:2]
        depends: list[Any] = [source, parameters, code_digest(), lock_digest(self.root), python]
        depends += [[name, file_digest(self.root / name)] for name in inputs]
        text = json.dumps(depends, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def code_digest() -> str:
    """SHA-256 of the names and contents of all modules of the package."""
    package = Path(steelnb.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(package).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def read_cells(notebook: Path) -> list[dict[str, Any]]:
    """The cells of a notebook file. Raises `FileMissingError` or `NotebookError`."""
    try:
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    except OSError as fault:
        raise FileMissingError(f"{notebook}: {fault.strerror}") from None
    except (ValueError, KeyError, TypeError):
        raise NotebookError(f"{notebook}: not a notebook; expected JSON with cells (nbformat 4)") from None
    return list(cells)


def read_parameters(notebook: Path) -> dict[str, Any]:
    """Names and defaults of the cell tagged ``parameters``, which must hold plain literals. Raises `NotebookError`.

    `papermill.inspect_notebook` gives the defaults as text only, and takes a second to import.
    """
    tagged = [cell for cell in read_cells(notebook) if "parameters" in cell.get("metadata", {}).get("tags", [])]
    if len(tagged) != 1:
        raise NotebookError(f"{notebook}: {len(tagged)} cells are tagged 'parameters'; expected one")
    defaults: dict[str, Any] = {}
    try:
        for statement in ast.parse(_source(tagged[0])).body:
            if isinstance(statement, ast.Assign | ast.AnnAssign) and statement.value is not None:
                targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
                value = ast.literal_eval(statement.value)
                defaults.update({target.id: value for target in targets if isinstance(target, ast.Name)})
    except (SyntaxError, ValueError) as fault:
        raise NotebookError(f"{notebook}: cell 'parameters': expected plain literals ({fault})") from None
    if "results_dir" not in defaults:
        raise NotebookError(f"{notebook}: cell 'parameters': expected results_dir = \"\" among the parameters")
    return defaults


def fit_parameters(experiment: str, given: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """``given`` with every name known and every value of its default's type. Raises `SettingsError`."""
    known = [name for name in defaults if name != "results_dir"]
    for name in given:
        if name == "results_dir":
            raise SettingsError(f"{experiment}: results_dir is set by reproduce; name the folder with -o")
        if name not in known:
            raise SettingsError(
                f"{experiment}: unknown parameter {name!r}{_guess(name, known)}; known: {', '.join(known)}"
            )
    try:
        return {name: _fit(name, value, defaults[name]) for name, value in given.items()}
    except SettingsError as fault:
        raise SettingsError(f"{experiment}: {fault}") from None


def _fit(name: str, value: Any, default: Any) -> Any:
    """``value`` in the type of ``default``: an int becomes a float, the elements of a list follow the default's."""
    kind = type(default)
    if default is None or (kind in (bool, int, str) and type(value) is kind):
        return value
    if kind is float and isinstance(value, int | float) and type(value) is not bool and abs(value) < FLOAT_MAX:
        return float(value)
    if kind in (list, tuple) and isinstance(value, list | tuple):
        return [_fit(f"{name}[{index}]", item, default[0]) if default else item for index, item in enumerate(value)]
    if kind is dict and isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return value
    raise SettingsError(f"{name} = {value!r}: expected {_EXPECTED.get(kind, 'a value')} such as {default!r}")


_EXPECTED = {
    bool: "true or false,",
    int: "a whole number",
    float: "a finite number",
    str: "a text",
    list: "a list",
    tuple: "a list",
    dict: "a table",
}


def check_settings(experiment: str, values: Mapping[str, Any]) -> None:
    """Build the settings that the parameters stand for, every combination where they are lists, so that a value out of
    range is refused before a notebook starts. Raises `SettingsError`."""
    names = [name for name in PRESET_ARGUMENTS if name in values]
    choices = [values[name] if isinstance(values[name], list | tuple) else [values[name]] for name in names]
    for combination in itertools.product(*choices) if names else ():
        try:
            ExperimentSettings.preset(**dict(zip(names, combination, strict=True)))
        except SettingsError as fault:
            raise SettingsError(f"{experiment}: {fault}") from None


def parse_parameter(text: str) -> tuple[str, Any]:
    """Read ``NAME=VALUE``: the value as Python literal, else as TOML value, else as text. Raises `SettingsError`."""
    name, equals, value = (piece.strip() for piece in text.partition("="))
    if not name or not equals:
        raise SettingsError(f"-p {text}: expected NAME=VALUE, such as trajectory=orbit or tof.rate_hz=10")
    for read in (ast.literal_eval, lambda text: tomllib.loads(f"value = {text}")["value"]):
        try:
            parsed = read(value)
            json.dumps(parsed)  # refuses what a notebook's parameter cannot be: sets, bytes, dates
        except (ValueError, SyntaxError, TypeError):
            continue
        return name, parsed
    return name, value


def _guess(name: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, list(known), n=1)
    return f", did you mean {near[0]!r}?" if near else ""


def _source(cell: Mapping[str, Any]) -> str:
    source = cell["source"]
    return source if isinstance(source, str) else "".join(source)
