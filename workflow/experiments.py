"""`notebooks/runs.toml`: experiments, their parts and the key of each part, checked before anything runs."""

import hashlib
import itertools
import json
import platform
import re
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from steelnb.cache import digest_sources
from steelnb.errors import InputError, OutputError
from steelnb.parameters import check_settings, fit_parameters
from steelnb.results import EXPERIMENTS_FILE, file_digest
from steelnb.settings import Settings, read_toml
from steelnb.settings.base import guess
from workflow.parameters import read_cells, read_parameters, source

FOLDERS = {"full": "results", "smoke": "results-smoke"}


def digest(*values: Any) -> str:
    """SHA-256 of values that JSON can hold; the order of a table's keys does not count."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


class Experiment(Settings):
    """One table of `runs.toml`: a notebook, its parameters for each budget, and a matrix of parts.

    ``inputs`` are files of the project that the notebook reads: when one changes, it runs again. One that is ``apart``
    is too long for every day: at the full budget it runs only when it is named. ``title``, ``about`` and ``figures``
    are for the pages.
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
    apart: bool = False


@dataclass(frozen=True)
class Part:
    """One execution of a notebook, of one combination of the matrix; ``name`` is empty where there is just one."""

    experiment: Experiment
    name: str
    root: Path
    parameters: Mapping[str, Any]

    @property
    def label(self) -> str:
        return f"{self.experiment.id}/{self.name}" if self.name else self.experiment.id

    @property
    def notebook(self) -> Path:
        return self.root / "notebooks" / self.experiment.notebook

    def key(self) -> str:
        """Hash of everything that the results depend on: the source of the cells (no outputs), parameters, files
        that are read, the package, the lock and Python. Raises `SteelnbError`."""
        cells = [
            (cell["cell_type"], source(cell), cell.get("metadata", {}).get("tags", []))
            for cell in read_cells(self.notebook)
        ]
        files = {name: file_digest(self.root / name) for name in (*self.experiment.inputs, "environment.lock")}
        return digest(cells, self.parameters, files, digest_sources(excluded=()), platform.python_version_tuple()[:2])


def read_experiments(root: Path) -> dict[str, Experiment]:
    """The experiments of the project below ``root``, by id. Raises `InputError`."""
    found = {}
    for name, table in read_toml(root / EXPERIMENTS_FILE).items():
        if name == "check":  # how results are compared: `steelnb.report.differences`
            continue
        if not re.fullmatch(r"[a-z0-9][a-z0-9_-]*", name) or not isinstance(table, dict):
            raise InputError(f"{EXPERIMENTS_FILE}: {name!r}: expected a table named in small letters and hyphens")
        try:
            found[name] = Experiment(id=name, **table)
        except InputError as fault:
            raise InputError(f"{EXPERIMENTS_FILE}: [{name}]: {fault}") from None
    return found


def select(experiments: Mapping[str, Experiment], ids: Iterable[str], budget: str) -> list[Experiment]:
    """The experiments named, in the file's order; by default all, at the full budget without those apart.

    Raises `InputError`.
    """
    ids = list(ids)
    if budget not in FOLDERS:
        raise InputError(f"budget = {budget!r}: expected one of {', '.join(FOLDERS)}")
    for name in ids:
        if name not in experiments:
            known = ", ".join(experiments)
            raise InputError(f"unknown experiment {name!r}{guess(name, experiments)}; known: {known}")
    chosen = ids or [name for name, each in experiments.items() if budget == "smoke" or not each.apart]
    return [experiment for name, experiment in experiments.items() if name in chosen]


def make_parts(root: Path, experiment: Experiment, budget: str, given: Mapping[str, Any]) -> list[Part]:
    """The parts of an experiment, every parameter checked. Raises `InputError`.

    ``given`` are the user's parameters; they win over budget and matrix, and a matrix axis they name is dropped. A
    dotted name, such as ``tof.rate_hz``, goes into the notebook's parameter ``overrides``.
    """
    defaults = read_parameters(root / "notebooks" / experiment.notebook)
    user = {name: value for name, value in given.items() if "." not in name or "overrides" not in defaults}
    dotted = {name: value for name, value in given.items() if name not in user}
    chosen = {**getattr(experiment, budget), **user}
    if dotted:
        chosen["overrides"] = {**chosen.get("overrides", defaults["overrides"]), **dotted}
    axes = {name: values for name, values in experiment.matrix.items() if name not in user}
    parts = []
    for combination in itertools.product(*axes.values()):
        named = dict(zip(axes, combination, strict=True))
        values = fit_parameters(experiment.id, {**chosen, **named}, defaults)
        check_settings(experiment.id, {**defaults, **values})
        name = "-".join(re.sub(r"[^A-Za-z0-9_.]+", "-", str(value)) for value in combination)
        parts.append(Part(experiment, name, root, values))
    if len({part.name for part in parts}) != len(parts) or not parts:
        raise InputError(f"{EXPERIMENTS_FILE}: [{experiment.id}]: matrix: expected distinct values on every axis")
    return parts


def output_folder(root: Path, budget: str, given: Mapping[str, Any], output: Path | None) -> Path:
    """Folder of the results ``<folder>/<id>/``. Raises `InputError` if a run with parameters of its own, or a smoke
    run, would touch the full results, and `OutputError` if nothing can be written there."""
    if output is None and given:
        raise InputError(f"P={next(iter(given))}: parameters of your own want an output folder, OUT=folder")
    folder = (output or root / FOLDERS[budget]).resolve()
    full = (root / FOLDERS["full"]).resolve()
    if (given or budget != "full") and folder.is_relative_to(full):
        raise InputError(f"OUT={output}: expected a folder outside {full}, which holds the default results")
    place = next(path for path in (folder, *folder.parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=place):
            return folder
    except OSError as fault:
        raise OutputError(f"{folder}: cannot be written: {fault.strerror}") from None
