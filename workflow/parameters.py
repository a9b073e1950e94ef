"""The parameters of a notebook: their names, types and defaults, and values refused before anything runs.

papermill only warns about a parameter that a notebook does not have, so that a misspelt one would silently run the
defaults. Nothing here imports a heavy library.
"""

import ast
import inspect
import itertools
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from steelnb.errors import FileMissingError, NotebookError, SettingsError
from steelnb.report.words import guess
from steelnb.settings import ExperimentSettings

FLOAT_MAX = sys.float_info.max
PRESET_ARGUMENTS = tuple(inspect.signature(ExperimentSettings.preset).parameters)


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
        for statement in ast.parse(source(tagged[0])).body:
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
            raise SettingsError(f"{experiment}: results_dir is set by the workflow; name a folder with OUT=folder")
        if name not in known:
            raise SettingsError(
                f"{experiment}: unknown parameter {name!r}{guess(name, known)}; known: {', '.join(known)}"
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


def source(cell: Mapping[str, Any]) -> str:
    """The text of a cell, which a notebook file holds whole or line by line."""
    return "".join(cell["source"])
