"""The cells of a notebook file, and the defaults of its parameters."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from steelnb.errors import InputError
from steelnb.parameters import FOLDER, literals


def read_cells(notebook: Path) -> list[dict[str, Any]]:
    """The cells of a notebook file. Raises `InputError`."""
    try:
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    except OSError as fault:
        raise InputError(f"{notebook}: {fault.strerror}") from None
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{notebook}: not a notebook; expected JSON with cells (nbformat 4)") from None
    return list(cells)


def read_parameters(notebook: Path) -> dict[str, Any]:
    """Names and defaults of the cell tagged ``parameters``, which must hold plain literals. Raises `InputError`.

    `papermill.inspect_notebook` gives the defaults as text only, and takes a second to import.
    """
    tagged = [cell for cell in read_cells(notebook) if "parameters" in cell.get("metadata", {}).get("tags", [])]
    if len(tagged) != 1:
        raise InputError(f"{notebook}: {len(tagged)} cells are tagged 'parameters'; expected one")
    try:
        defaults = literals(source(tagged[0]))
    except (SyntaxError, ValueError) as fault:
        raise InputError(f"{notebook}: cell 'parameters': expected plain literals ({fault})") from None
    if FOLDER not in defaults:
        raise InputError(f"{notebook}: cell 'parameters': expected {FOLDER} = \"\" among the parameters")
    return defaults


def source(cell: Mapping[str, Any]) -> str:
    """The text of a cell, which a notebook file holds whole or line by line."""
    return "".join(cell["source"])
