"""The only guard of a notebook's parameters, whether the workflow, papermill alone or a reader set them: the function
of `steelnb.notebook.cases` that is the notebook's makes its settings of them before anything runs."""

import ast
import gc
import inspect
import itertools
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import create_model

from steelnb.core.errors import InputError
from steelnb.core.files import check_writable
from steelnb.notebook.cases import NOTEBOOKS
from steelnb.notebook.results import EXPERIMENTS_FILE, earlier_files, find_root
from steelnb.settings import Settings
from steelnb.settings.presets import read_toml

FOLDER = "results_dir"
"""The parameter that every notebook has, and that the workflow sets."""
INJECTED = "# Parameters\n"
"""The first line of the cell that papermill inserts behind the one tagged ``parameters``."""
_checked: dict[str, dict[str, Any]] = {}
"""The running notebook and its parameters."""


def check(notebook: str) -> Any:
    """Check the parameters of the running notebook, and return what its function in `NOTEBOOKS` makes of them.

    Call it first after the parameters. papermill itself only warns of an unknown name and would run the defaults.
    Numbers are converted to the types of the parameters. Raises `InputError`, and `OutputError` for a folder of results
    that cannot be written or holds files that are not a notebook's.
    """
    names = vars(sys.modules["__main__"])
    known = inspect.signature(NOTEBOOKS[notebook]).parameters
    given = {name: names[name] for name in known if name in names}
    cells = names.get("In", [])
    injected = max((k for k, cell in enumerate(cells) if cell.startswith(INJECTED)), default=0)
    if injected:  # a copy may have more parameters than its original
        own = {FOLDER, *_assigned(cells[injected - 1])}
        given |= {name: names[name] for name in _assigned(cells[injected]) if name not in own}
    values, made = checked_parameters(notebook, given, notebook)
    names.update(values)
    _checked.clear()
    _checked[notebook] = values
    if folder := names[FOLDER]:
        check_writable(folder)
        earlier_files(folder)
    if not gc.get_freeze_count():  # not in a second run, which would keep the first one's results for good
        gc.freeze()  # the collector would look through all that is imported, again and again
    return made


def checked_parameters(notebook: str, given: Mapping[str, Any], label: str) -> tuple[dict[str, Any], Any]:
    """Parameters of one of `NOTEBOOKS`, converted to their types, and what its function makes of them. Raises
    `InputError`, which begins with the ``label``."""
    make = NOTEBOOKS[notebook]
    kinds: dict[str, Any] = {name: (each.annotation, ...) for name, each in inspect.signature(make).parameters.items()}
    fitted = create_model(label, __base__=Settings, **kinds)(**given)
    values = {name: getattr(fitted, name) for name in kinds}
    try:
        return values, make(**values)
    except InputError as fault:
        raise InputError(f"{label}: {fault}") from None


def note() -> None:
    """Say that the conclusions are those of the committed run, if the notebook was checked with other parameters than
    those of the full budget of one of its experiments in `EXPERIMENTS_FILE`."""
    ((notebook, values),) = _checked.items()
    path = (find_root() / EXPERIMENTS_FILE).with_name(f"{notebook}.ipynb")
    tables, defaults = read_toml(path.with_name(EXPERIMENTS_FILE.name)), _committed(path)
    experiments = {id: each for id, each in tables.items() if each["notebook"] == path.name}
    full = []
    for each in experiments.values():
        matrix = each.get("matrix", {})
        for some in itertools.product(*matrix.values()):
            full.append(defaults | each["full"] | dict(zip(matrix, some, strict=True)))
    if not any(all(each.get(name) == value for name, value in values.items()) for each in full):
        from IPython.display import display

        text = "These sentences describe the committed run ({}), not this one."
        folder = f"results/{next(iter(experiments))}"
        link = text.format(f'<a href="../{folder}">{folder}</a>')
        display({"text/plain": text.format(folder), "text/html": f"<b>{link}</b>"}, raw=True)


def _committed(path: Path) -> dict[str, Any]:
    """The parameters of a notebook at the last commit, since a reader may have edited and saved the file itself."""
    command = ["git", "-C", str(path.parent), "show", f"HEAD:./{path.name}"]
    shown = subprocess.run(command, capture_output=True, check=False, text=True, encoding="utf-8")
    cells = json.loads(path.read_text(encoding="utf-8") if shown.returncode else shown.stdout)["cells"]
    return next(literals("".join(cell["source"])) for cell in cells if "parameters" in cell["metadata"].get("tags", ()))


def _assigned(source: str) -> dict[str, ast.expr]:
    """The names that the code of a cell assigns, and the expressions. Raises SyntaxError."""
    found: dict[str, ast.expr] = {}
    for statement in ast.parse(source).body:
        if isinstance(statement, ast.Assign | ast.AnnAssign) and statement.value is not None:
            targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
            found |= {target.id: statement.value for target in targets if isinstance(target, ast.Name)}
    return found


def literals(source: str) -> dict[str, Any]:
    """The names and values of a cell of plain literals. Raises SyntaxError and ValueError."""
    return {name: ast.literal_eval(value) for name, value in _assigned(source).items()}
