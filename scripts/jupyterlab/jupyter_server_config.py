"""Saves the project's notebooks without outputs, so that running one leaves `git status` clean.

Outputs stay on the screen until the notebook is closed; `make docs` makes pages that keep them. A git filter would have
to be set up in every clone, and `make reproduce` would not see edits in copies of the notebooks. Notebooks in other
folders are saved as they are.
"""

import warnings
from pathlib import Path
from typing import Any

PROJECT_FILE = "runs.toml"
"""Marks the folder of the project's notebooks."""
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}


def keep_source_only(model: dict[str, Any], path: str, contents_manager: Any, **_: Any) -> None:
    """Remove all but the source of the cells and their tags from a notebook of the project that is being saved."""
    if model["type"] != "notebook" or not Path(contents_manager.root_dir, path).with_name(PROJECT_FILE).is_file():
        return
    notebook = model["content"]
    notebook["metadata"] = METADATA
    for cell in notebook["cells"]:
        cell["metadata"] = {name: value for name, value in cell["metadata"].items() if name == "tags" and value}
        if cell["cell_type"] == "code":
            cell |= {"outputs": [], "execution_count": None}


warnings.filterwarnings("ignore", "Overriding existing pre_save_hook")  # the server validates one setting twice
c = get_config()  # type: ignore[name-defined]  # noqa: F821
c.FileContentsManager.pre_save_hook = keep_source_only
