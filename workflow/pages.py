"""Notebooks as executed → docs/notebooks/, in a form that Sphinx shows without any network."""

import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nbformat
import plotly.io
from plotly.offline import get_plotlyjs

from workflow.execute import EXECUTED
from workflow.task_notebooks import Plan, part_folder

PLOTLY = "application/vnd.plotly.v1+json"
INJECTED = "injected-parameters"
WIDGET = "application/vnd.jupyter.widget-view+json"


def write_pages(plans: list[Plan], cache: Path, docs: Path) -> list[str]:
    """Write ``notebooks/<id>[-<part>].ipynb`` below ``docs``, with Plotly's own script beside, where all is found that
    has been executed. Gives the labels of the parts that have not."""
    folder = docs / "notebooks"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    parts = [(part, part_folder(cache, part) / EXECUTED) for plan in plans for part in plan.parts]
    done = [(part, path, f"{part.label.replace('/', '-')}.ipynb") for part, path in parts if path.is_file()]
    # The first part of each notebook is where links to the notebook lead.
    pages = {part.experiment.notebook: name for part, _, name in reversed(done)}
    for part, path, name in done:
        notebook = nbformat.read(path, as_version=4)
        title = part.experiment.title + (f": {part.name}" if part.name else "")
        notebook.cells = [_cell(cell, pages) for cell in notebook.cells]
        notebook.cells[0].source = re.sub(r"\A# .*", f"# {title}", notebook.cells[0].source)
        notebook.metadata.pop("widgets", None)
        notebook.metadata.pop("papermill", None)
        nbformat.write(notebook, folder / name)
    (docs / "_static").mkdir(exist_ok=True)
    (docs / "_static" / "plotly.min.js").write_text(get_plotlyjs(), encoding="utf-8")
    return [part.label for part, path in parts if not path.is_file()]


def _cell(cell: Any, pages: Mapping[str, str]) -> Any:
    if cell.cell_type == "markdown":
        cell.source = re.sub(r"\[([^]]*)\]\(([^)\s]+)\)", lambda link: _link(link[1], link[2], pages), cell.source)
        return cell
    cell.metadata.pop("papermill", None)
    if INJECTED in cell.metadata.get("tags", []):  # the folder of the run says nothing to a reader
        cell.source = re.sub(r"^results_dir = .*\n?", "", cell.source, flags=re.MULTILINE)
    shown = [output for output in cell.get("outputs", []) if WIDGET not in output.get("data", {})]
    for output in shown:
        if PLOTLY in output.get("data", {}):
            figure = plotly.io.from_json(json.dumps(output.data[PLOTLY]))
            shape = {"displaylogo": False, "responsive": True}  # as wide as the page, on a phone too
            html = plotly.io.to_html(figure, config=shape, full_html=False, include_plotlyjs=False)
            output.data = {"text/html": html}
    cell.outputs = shown
    return cell


def _link(text: str, target: str, pages: Mapping[str, str]) -> str:
    """A link to a notebook leads to its page, one to a file of the project nowhere, any other where it did."""
    if target.startswith(("https://", "http://", "#")):
        return f"[{text}]({target})"
    return f"[{text}]({pages[target]})" if target in pages else text
