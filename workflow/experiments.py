"""`notebooks/runs.toml`: which notebook runs with which parameters, checked before anything runs."""

import itertools
import json
import os
import platform
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import nbformat
from pydantic import Field

from steelnb.core.cache import digest_rooms
from steelnb.core.checks import checked_choice
from steelnb.core.errors import InputError
from steelnb.core.files import reading
from steelnb.notebook.cases import NOTEBOOKS
from steelnb.notebook.parameters import FOLDER, checked_parameters, literals
from steelnb.notebook.results import EXPERIMENTS_FILE, file_digest
from steelnb.settings import Settings, parse_parameter, read_tables

BUDGETS = {"full": "results", "smoke": "results-smoke"}
OF_FILES = ("tower.members", "tower.mesh")
"""Settings whose values are files if they have an ending."""


class Experiment(Settings):
    """One table of `runs.toml`: a notebook, its parameters for each budget, and a matrix of values to combine.

    ``inputs`` are files of the project that the notebook reads. An experiment that is ``apart`` runs at the full budget
    only if it is named. ``order``: 1 is started first, −1 last. ``title``, ``about`` and ``figures`` (the report's) are
    for the overview.
    """

    notebook: str
    title: str
    about: str = ""
    figures: str = ""
    matrix: dict[str, list[Any]] = Field(default_factory=dict)
    full: dict[str, Any]
    smoke: dict[str, Any]
    inputs: list[str] = Field(default_factory=list)
    apart: bool = False
    order: Literal[-1, 0, 1] = 0


@dataclass(frozen=True)
class Part:
    """One execution of a notebook, for one combination of the matrix; ``name`` is empty if it is the only one."""

    id: str
    name: str
    notebook: Path
    experiment: Experiment
    parameters: Mapping[str, Any]

    @property
    def label(self) -> str:
        return f"{self.id}/{self.name}" if self.name else self.id

    def key(self) -> str:
        """All that the results depend on: cells without outputs, parameters, files, package and Python."""
        root = self.notebook.parents[1]
        files = {name: file_digest(root / name) for name in (*self.experiment.inputs, "environment.lock")}
        cells = [(cell.cell_type, cell.source) for cell in nbformat.read(self.notebook, 4).cells]
        versions = [digest_rooms(), *platform.python_version_tuple()[:2]]
        return json.dumps([cells, self.parameters, files, versions], sort_keys=True)


def read_experiments(root: Path) -> dict[str, Experiment]:
    """The experiments of the project below ``root``, by id. Raises `InputError`."""
    return read_tables(root / EXPERIMENTS_FILE, Experiment, "a TOML file of experiments")


def read_parameters(notebook: Path) -> dict[str, Any]:
    """Names and defaults of the cell tagged ``parameters``, which must hold plain literals. Raises `InputError`."""
    with reading(notebook, f"a notebook with one cell 'parameters' of plain literals and {FOLDER} = \"\""):
        cells = nbformat.read(notebook, 4).cells
        (source,) = (cell.source for cell in cells if "parameters" in cell.metadata.get("tags", []))
        defaults = literals(source)
        defaults.pop(FOLDER)
        return defaults


def parse_parameters(text: str) -> dict[str, Any]:
    """Parse the text of ``P="seed=3 tof.rate_hz=10 flights=['loops', 'zigzag']"``. Elements of a list need no quotes,
    since a shell removes them. Files are given from the working directory, while kernels run in another one. Raises
    `InputError`."""

    def value(item: str) -> tuple[str, Any]:
        name, found = parse_parameter(item.strip())
        if isinstance(found, str) and re.fullmatch(r"\[.*\]|\(.*\)", found, re.DOTALL):
            found = [value(f"{name}={each}")[1] for each in found[1:-1].split(",") if each.strip()]
        if isinstance(found, str) and os.path.splitext(found)[1]:
            if name in OF_FILES and not os.path.isfile(found):
                raise InputError(f"{name} = {found!r}: no such file; expected one, from this folder")
            found = os.path.abspath(found) if os.path.isfile(found) else found
        return name, json.loads(json.dumps(found))

    items = re.split(r"\s+(?=['\"]?[A-Za-z_][\w.]*\s*=)", text.strip())
    found = [value(re.sub(r"^(['\"])(.*)\1$", r"\2", item)) for item in items if item]
    if twice := [name for name, count in Counter(name for name, _ in found).items() if count > 1]:
        raise InputError(f"{twice[0]} is given twice; expected it once")
    return dict(found)


def make_parts(root: Path, ids: Sequence[str], budget: str, given: Mapping[str, Any] | None = None) -> list[Part]:
    """Parts of the experiments ``ids``, with every parameter checked. Default: all; at the full budget not those apart.

    Parameters ``given`` by the user override budget and matrix, and drop the axes that they name. A dotted name, such
    as ``tof.rate_hz``, goes into the notebook's parameter ``overrides``. Raises `InputError`.
    """
    experiments = read_experiments(root)
    checked_choice(budget, "BUDGET", BUDGETS)
    for id in ids:
        checked_choice(id, "ONLY", experiments)
    chosen = ids or [id for id, each in experiments.items() if budget == "smoke" or not each.apart]
    some = [(id, each, getattr(each, budget)) for id, each in experiments.items() if id in chosen]
    return [part for id, each, usual in some for part in _combine(root, id, each, usual, given or {})]


def first_parts(root: Path, budget: str) -> list[Part]:
    """The first part of each notebook, also of experiments that are `apart`: other parts run the same cells."""
    parts = make_parts(root, [*read_experiments(root)], budget)
    return list({part.notebook: part for part in reversed(parts)}.values())


def _combine(
    root: Path, id: str, experiment: Experiment, usual: Mapping[str, Any], given: Mapping[str, Any]
) -> list[Part]:
    notebook = root / "notebooks" / experiment.notebook
    defaults = read_parameters(notebook)
    dotted = {name: value for name, value in given.items() if "." in name and "overrides" in defaults}
    plain = {name: value for name, value in given.items() if name not in dotted}
    axes = {name: values for name, values in experiment.matrix.items() if name not in plain}
    parts = {}
    for combination in itertools.product(*axes.values()):
        values = {**usual, **plain, **dict(zip(axes, combination, strict=True))}
        if dotted:
            values["overrides"] = {**values.get("overrides", defaults["overrides"]), **dotted}
        for parameter in values:
            checked_choice(parameter, f"{id}: the name of a parameter", defaults)
        if notebook.stem in NOTEBOOKS:
            checked, _ = checked_parameters(notebook.stem, {**defaults, **values}, id)
            values = {parameter: checked[parameter] for parameter in values}
        name = "-".join(re.sub(r"[^A-Za-z0-9_.]+", "-", str(value)) for value in combination)
        if name in parts:
            raise InputError(f"{EXPERIMENTS_FILE}: [{id}]: matrix: {name} twice; expected distinct values")
        parts[name] = Part(id, name, notebook, experiment, values)
    return list(parts.values())
