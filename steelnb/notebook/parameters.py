"""Checks of a notebook's parameters: misspelt names, wrong types and settings out of range are refused before anything
runs, whether the workflow, papermill alone or a reader set them."""

import ast
import itertools
import sys
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from pydantic import create_model

from steelnb.core.checks import guess, quoted
from steelnb.core.errors import InputError
from steelnb.settings import ExperimentSettings, Settings
from steelnb.settings.base import Finite, SeedOrReport

PRESET_ARGUMENTS = "trajectory", "noise", "method", "sensor", "seed", "duration_s", "overrides"
FOLDER = "results_dir"
"""The parameter that every notebook has, and that the workflow sets."""
INJECTED = "# Parameters\n"
"""The first line of the cell that papermill inserts behind the one tagged ``parameters``."""


def check_names(parameter: str, names: Iterable[str], known: Collection[str]) -> None:
    """Raise `InputError` for the first of the names in a parameter that is not ``known``."""
    for name in names:
        if name not in known:
            raise InputError(f"{parameter} = {name!r}{guess(name, known)}: expected one of {quoted(known)}")


def validate() -> None:
    """Check what papermill set in the running notebook, and convert numbers to the types of their defaults.

    Call it in the first cell after the parameters: papermill itself only warns of an unknown name and would run the
    defaults. If a flight is shorter than the notebook's default, a warning is printed. Does nothing without IPython, or
    if papermill set nothing. Raises `InputError`.
    """
    loaded = sys.modules.get("IPython")  # which a kernel has loaded
    shell = loaded.get_ipython() if loaded else None
    if shell is None:
        return
    cells, names = shell.user_ns["In"], shell.user_ns
    place = max((k for k, cell in enumerate(cells) if cell.startswith(INJECTED)), default=0)
    tagged = [cell for cell in cells[:place] if f"\n{FOLDER} = " in cell and not cell.startswith(INJECTED)]
    if tagged:
        defaults, given = literals(tagged[-1]), [name for name in assigned(cells[place]) if name != FOLDER]
        values = check_parameters("parameters", {name: names[name] for name in given}, defaults)
        names.update(values)
        short_s, whole_s = values.get("duration_s"), defaults.get("duration_s")
        if short_s is not None and (whole_s is None or short_s < whole_s):
            print("Short run: no conclusions. Those at the end are about the committed run.")


def assigned(source: str) -> dict[str, ast.expr]:
    """The names that the code of a cell assigns, and the expressions. Raises SyntaxError."""
    found: dict[str, ast.expr] = {}
    for statement in ast.parse(source).body:
        if isinstance(statement, ast.Assign | ast.AnnAssign) and statement.value is not None:
            targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
            found |= {target.id: statement.value for target in targets if isinstance(target, ast.Name)}
    return found


def literals(source: str) -> dict[str, Any]:
    """The names and values of a cell of plain literals. Raises SyntaxError and ValueError."""
    return {name: ast.literal_eval(value) for name, value in assigned(source).items()}


def check_parameters(experiment: str, given: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Check that the names ``given`` are known, and convert their values to the types of the defaults.

    The settings are built too, for every combination of values in lists, so that a value out of range is refused before
    a notebook starts. Raises `InputError`.
    """
    kinds: dict[str, Any] = {name: (_kind(name, value), value) for name, value in defaults.items() if name != FOLDER}
    fitted = create_model(experiment, __base__=Settings, **kinds)(**given)
    names = [name for name in PRESET_ARGUMENTS if name in kinds]
    values = [getattr(fitted, name) for name in names]
    choices = [value if isinstance(value, list | tuple) else [value] for value in values]
    for combination in itertools.product(*choices) if names else ():
        try:
            ExperimentSettings.preset(**dict(zip(names, combination, strict=True)))
        except InputError as fault:
            raise InputError(f"{experiment}: {fault}") from None
    return {name: getattr(fitted, name) for name in given}


def _kind(name: str, default: Any) -> Any:
    """The type of a parameter, from its default. An empty list allows any elements, None any value."""
    if isinstance(default, list | tuple):
        return list[_kind(name, default[0]) if default else Any]  # type: ignore[misc]
    if default is None:
        return Any
    if name in ("seed", "seeds"):
        return SeedOrReport
    return {float: Finite, dict: dict[str, Any]}.get(type(default), type(default))
