"""JupyterLab as `make lab` starts it: saving an executed notebook changes no file of the project."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import nbformat
import pytest
from jupyter_core.utils import run_sync
from jupyter_server.serverapp import ServerApp

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def run_in_lab(path: Path) -> nbformat.NotebookNode:
    """A notebook with all that JupyterLab adds when it runs: outputs, counts, times and metadata."""
    notebook = nbformat.read(path, 4)
    notebook.metadata.kernelspec.display_name = "Python 3 (ipykernel)"
    notebook.metadata.language_info.update(version="3.11.2", mimetype="text/x-python", file_extension=".py")
    notebook.metadata["widgets"] = {"application/vnd.jupyter.widget-state+json": {"state": {}}}
    for number, cell in enumerate(notebook.cells, start=1):
        cell.metadata |= {"collapsed": False, "scrolled": True, "execution": {"iopub.execute_input": "now"}}
        if cell.cell_type == "code":
            cell.execution_count = number
            cell.outputs = [nbformat.v4.new_output("stream", text="a number")]
            cell.metadata.setdefault("tags", [])  # JupyterLab leaves an empty list where a tag was removed
    return notebook


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The contents manager of a server on a clone of the notebooks, with the settings of `make lab`."""
    for name in ("CONFIG_DIR", "DATA_DIR", "RUNTIME_DIR"):
        monkeypatch.setenv(f"JUPYTER_{name}", str(tmp_path / name))
    settings = re.search(
        r'^lab:(?:.*\n\t)+?.*JUPYTER_CONFIG_PATH="(\S+)"', (ROOT / "Makefile").read_text(), re.MULTILINE
    )
    assert settings is not None
    monkeypatch.setenv("JUPYTER_CONFIG_PATH", settings[1].replace("$(CURDIR)", str(ROOT)))
    project = tmp_path / "project"
    shutil.copytree(ROOT / "notebooks", project / "notebooks", ignore=shutil.ignore_patterns(".ipynb_checkpoints"))
    git(project, "init", "-q")
    git(project, "add", ".")
    app = ServerApp(root_dir=str(project), allow_root=True, open_browser=False, port_retries=0)
    app.initialize([], find_extensions=False, new_httpserver=False)
    yield app.contents_manager
    ServerApp.clear_instance()


def git(folder: Path, *arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=folder, check=True, capture_output=True, text=True).stdout


def save(manager, path: str, notebook: nbformat.NotebookNode) -> None:
    run_sync(manager.save)({"type": "notebook", "format": "json", "content": notebook}, path)


def test_saving_what_was_run_changes_nothing_and_an_edit_alone_is_saved(manager) -> None:
    project = Path(manager.root_dir)
    for path in NOTEBOOKS:
        save(manager, f"notebooks/{path.name}", run_in_lab(path))
    assert git(project, "diff", "--stat") == ""
    notebook = run_in_lab(NOTEBOOKS[0])
    notebook.cells[1].source += "\nmine = 1"
    save(manager, f"notebooks/{NOTEBOOKS[0].name}", notebook)
    changed = [line for line in git(project, "diff", "-U0").splitlines() if re.match(r"[+-](?![+-])", line)]
    assert [line.strip("+- ,") for line in changed][-1] == '"mine = 1"'
    assert len(changed) == 3  # the line before it has an end now


@pytest.mark.parametrize(("user", "allowed"), [("0", True), ("1000", False)])
def test_only_root_is_allowed_to_be_root(tmp_path: Path, user: str, allowed: bool) -> None:
    (tmp_path / "id").write_text(f"#!/bin/sh\necho {user}\n")
    (tmp_path / "id").chmod(0o755)
    command = ["make", "-n", "-o", ".venv/.ready", "lab"]
    seen = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    shown = subprocess.run(command, cwd=ROOT, env=seen, check=True, capture_output=True, text=True).stdout
    assert ("--allow-root" in shown) == allowed
    assert "my-notebooks/00_explore.ipynb" in shown
