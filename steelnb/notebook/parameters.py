"""A notebook's parameters: wrong ones are refused before anything runs, whether the workflow, papermill alone or a
reader set them, and a run with others than the committed ones says so above its conclusions."""

import ast
import gc
import itertools
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, create_model

from steelnb.core.checks import checked_kind
from steelnb.core.errors import InputError
from steelnb.core.files import check_writable
from steelnb.notebook.combinations import check_combinations, check_names, check_once
from steelnb.notebook.results import EXPERIMENTS_FILE, earlier_files, find_root
from steelnb.settings import Settings
from steelnb.settings.base import Duration, Finite, NotNegative, Positive, SeedOrReport
from steelnb.settings.presets import read_toml

__all__ = ["FOLDER", "check_names", "check_parameters", "literals", "note", "validate"]

FOLDER = "results_dir"
"""The parameter that every notebook has, and that the workflow sets."""
INJECTED = "# Parameters\n"
"""The first line of the cell that papermill inserts behind the one tagged ``parameters``."""
Count = Annotated[int, Field(gt=0, le=10_000)]
KINDS: Mapping[str, Any] = {
    "seed": SeedOrReport, "seeds": Count, "cloud_seeds": SeedOrReport, "tower": str, "level": NotNegative,
    "draws": Annotated[int, Field(ge=2, le=10_000)], "views": Count, "slow_views": Count, "condition_views": Count,
    "duration_s": Duration, "drift_s": Duration, "cloud_s": Duration, "range_max_m": Positive,
    "correspondence_m": Positive, "reach_m": Positive, "step_m": Positive, "poor_starts": Count,
    "noise_m": Annotated[Finite, Field(ge=0, le=1)], "clutter": Annotated[Finite, Field(ge=0, le=0.9)],
    "kept": Annotated[Finite, Field(ge=0.05, le=1)], "map_dx_m": Annotated[Finite, Field(ge=0.005, le=5)],
    "map_min_votes": Annotated[int, Field(ge=2)],
}  # fmt: skip
"""Parameter → the type of its values or, if it is a list or a table, of its elements. Others have the default's.
Those of single frames leave bars to find in views of 3,400 to 21,000 returns over 6 to 11 m (notebook 06)."""
MAY_BE_EMPTY = ("slow", "blind_s", "options", "overrides")


def validate() -> None:
    """Check the parameters of the running notebook, and convert numbers to the types of their defaults.

    Call it first after the parameters: papermill itself only warns of an unknown name and would run the defaults. Does
    nothing without IPython, or in a notebook without a parameter `FOLDER`. Raises `InputError`, and `OutputError` for a
    folder of results that cannot be written or holds files that are not a notebook's.
    """
    own, injected, names = _cells()
    if not own:
        return
    given = [name for name in assigned(injected or own) if name != FOLDER]
    tracked = {} if injected else next(iter(_tracked(own).values()), {})
    defaults = {**{name: names[name] for name in assigned(own)}, **(literals(own) if injected else tracked)}
    names.update(check_parameters("parameters", {name: names[name] for name in given}, defaults))
    folder = checked_kind(names[FOLDER], FOLDER, str | Path)
    if str(folder):
        check_writable(folder)
        earlier_files(folder)
    if not gc.get_freeze_count():  # not in a second run, which would keep the first one's results for good
        gc.freeze()  # the collector would look through all that is imported, again and again


def note() -> None:
    """Say that the conclusions are those of the committed run, if the running notebook has other parameters than that.

    The committed ones are those of the full budget of one of its experiments in `EXPERIMENTS_FILE`. Does nothing
    without IPython, or in a notebook that is none of the project's.
    """
    own, injected, _ = _cells()
    if not own:
        return
    try:
        values = {**literals(own), **literals(injected)}
    except ValueError:  # an expression, which is not what is committed
        values = {}
    values.pop(FOLDER, None)
    for name, defaults in _tracked(own).items():
        experiments = read_toml(find_root() / EXPERIMENTS_FILE)
        ids = [id for id, each in experiments.items() if each["notebook"] == name]
        base = literals(own) if injected else defaults
        base.pop(FOLDER, None)
        if ids and not any(values == {**base, **full} for id in ids for full in _full(experiments[id])):
            from IPython.display import display

            text, folder = "These sentences describe the committed run ({}), not this one.", f"results/{ids[0]}"
            link = text.format(f'<a href="../{folder}">{folder}</a>')
            display({"text/plain": text.format(folder), "text/html": f"<b>{link}</b>"}, raw=True)


def _full(experiment: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The parameters of each part of an experiment at the full budget, beside the defaults."""
    matrix = experiment.get("matrix", {})
    return [
        {**experiment["full"], **dict(zip(matrix, each, strict=True))} for each in itertools.product(*matrix.values())
    ]


def _cells() -> tuple[str, str, dict[str, Any]]:
    """The cell of parameters of the running notebook and the one that papermill injected, each empty for none, and the
    names of its kernel."""
    loaded = sys.modules.get("IPython")  # which a kernel has loaded
    shell = loaded.get_ipython() if loaded else None
    if shell is None:
        return "", "", {}
    cells = shell.user_ns["In"]
    place = max((k for k, cell in enumerate(cells) if cell.startswith(INJECTED)), default=len(cells))
    tagged = [cell for cell in cells[:place] if f"\n{FOLDER} = " in cell and not cell.startswith(INJECTED)]
    injected = cells[place] if place < len(cells) else ""
    return tagged[-1] if tagged else "", injected, shell.user_ns


def _tracked(source: str) -> dict[str, dict[str, Any]]:
    """The file name of the project's notebook that has the parameters of a cell, and their committed defaults. A copy
    may have more parameters. Empty if there is none."""
    names, root = set(assigned(source)), find_root()
    own: dict[Path, dict[str, Any]] = {}
    for path in sorted((root / EXPERIMENTS_FILE).parent.glob("*.ipynb")):
        found = _defaults(path.read_text(encoding="utf-8"))
        if found and found.keys() <= names:
            own[path] = found
    if not own:
        return {}
    path = max(own, key=lambda path: len(own[path]))
    # A reader may have edited and saved the file itself.
    command = ["git", "-C", str(path.parent), "show", f"HEAD:./{path.name}"]
    try:
        committed = subprocess.run(command, capture_output=True, check=True, text=True, encoding="utf-8").stdout
    except (OSError, subprocess.CalledProcessError):
        return {path.name: own[path]}
    return {path.name: _defaults(committed) or own[path]}


def _defaults(notebook: str) -> dict[str, Any]:
    """Names and values of the cell tagged ``parameters``; an expression in place of a literal is None."""
    cells = json.loads(notebook)["cells"]
    for cell in cells:
        if "parameters" in cell["metadata"].get("tags", []):
            found = {}
            for name, value in assigned("".join(cell["source"])).items():
                try:
                    found[name] = ast.literal_eval(value)
                except ValueError:
                    found[name] = None
            return found
    return {}


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

    What they describe is checked too (`check_combinations`), so that a value out of range is refused before a notebook
    starts. Raises `InputError`.
    """
    kinds: dict[str, Any] = {name: (_kind(name, value), value) for name, value in defaults.items() if name != FOLDER}
    fitted = create_model(experiment, __base__=Settings, **kinds)(**given)
    values = {name: getattr(fitted, name) for name in kinds}
    try:
        for name, value in values.items():
            for key, each in {name: value, **(value if isinstance(value, dict) else {})}.items():
                if isinstance(each, list):
                    check_once(key, each)
        check_combinations(values)
    except InputError as fault:
        raise InputError(f"{experiment}: {fault}") from None
    return {name: values[name] for name in given}


def _kind(name: str, default: Any) -> Any:
    """The type of a parameter, from its name or its default. An empty list allows any elements, None any value."""
    at_least = Field(min_length=0 if name in MAY_BE_EMPTY else 1)
    if isinstance(default, list | tuple):
        element = "seed" if name == "seeds" else name  # a number of seeds, or a list of them
        return Annotated[list[_kind(element, default[0])], at_least] if default else list[Any]  # type: ignore[misc]
    if isinstance(default, dict) and default and name not in MAY_BE_EMPTY:
        return Annotated[dict[str, _kind(name, next(iter(default.values())))], at_least]  # type: ignore[misc]
    if name in KINDS:
        return KINDS[name] | None if default is None else KINDS[name]
    if default is None:
        return Any
    return {float: Finite, dict: dict[str, Any]}.get(type(default), type(default))
