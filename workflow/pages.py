"""Executed notebooks → docs/notebooks/, in a form that Sphinx shows without network access."""

import json
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

import nbformat
import plotly.io
from plotly.offline import get_plotlyjs

from workflow.experiments import Part
from workflow.run_notebooks import EXECUTED, part_folder

PLOTLY, WIDGET = "application/vnd.plotly.v1+json", "application/vnd.jupyter.widget-view+json"
ELSEWHERE = re.compile(r"\[([^]]*)\]\((?!https?:|#|[\w.-]+\.ipynb)[^)\s]+\)")
"""A link to a file of the project that is not one of the pages."""


def write_pages(parts: Sequence[Part], cache: Path, docs: Path) -> None:
    """Write the executed notebook of each part, and Plotly's script."""
    shutil.rmtree(docs / "notebooks", ignore_errors=True)
    (docs / "notebooks").mkdir()
    (docs / "_static" / "plotly.min.js").write_text(get_plotlyjs(), encoding="utf-8")
    for part in parts:
        notebook = nbformat.read(part_folder(cache, part) / EXECUTED, as_version=4)
        notebook.metadata.pop("widgets", None)
        for cell in notebook.cells:
            _show(cell)
        nbformat.write(notebook, docs / "notebooks" / part.notebook.name)


def _show(cell: nbformat.NotebookNode) -> None:
    """Remove links into the tree, the results folder and widgets from a cell, and turn Plotly's figures into HTML."""
    if cell.cell_type == "markdown":
        cell.source = ELSEWHERE.sub(r"\1", cell.source)
        return
    cell.source = re.sub(r"^results_dir = ./.*\n?", "", cell.source, flags=re.MULTILINE)
    cell.outputs = [output for output in cell.outputs if WIDGET not in output.get("data", {})]
    for output in cell.outputs:
        if PLOTLY in output.get("data", {}):
            figure = plotly.io.from_json(json.dumps(output.data[PLOTLY]))
            shape = {"displaylogo": False, "responsive": True}  # as wide as the page, on a phone too
            html = plotly.io.to_html(figure, config=shape, full_html=False, include_plotlyjs=False)
            output.data = {"text/html": html}
