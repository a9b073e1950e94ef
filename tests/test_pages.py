"""Cells of executed notebooks as the pages show them."""

import nbformat
import plotly.graph_objects
from nbformat.v4 import new_code_cell, new_markdown_cell, new_output

from workflow.pages import PLOTLY, WIDGET, _cell


def test_the_folder_of_a_run_is_not_shown():
    source = '# Parameters\nseed = 1\nresults_dir = "/somewhere/on/this/computer"\n'
    shown = _cell(new_code_cell(source, metadata={"tags": ["injected-parameters"]}), {})
    assert shown.source == "# Parameters\nseed = 1\n"
    kept = 'results_dir = ""  # where to write'
    assert _cell(new_code_cell(kept, metadata={"tags": ["parameters"]}), {}).source == kept


def test_a_3d_view_is_as_wide_as_its_page_and_asks_no_network():
    figure = plotly.graph_objects.Figure(plotly.graph_objects.Scatter3d(x=[0], y=[0], z=[0])).to_plotly_json()
    outputs = [new_output("display_data", {PLOTLY: figure}), new_output("display_data", {WIDGET: {}})]
    (shown,) = _cell(new_code_cell("view", outputs=outputs), {}).outputs
    assert nbformat.from_dict(shown).data.keys() == {"text/html"}
    assert '"responsive": true' in shown.data["text/html"]
    assert "cdn" not in shown.data["text/html"].lower()


def test_links_lead_to_pages_or_nowhere():
    text = "[02](02_x.ipynb), [code](../steelnb/experiment.py), [site](https://a.example)"
    shown = _cell(new_markdown_cell(text), {"02_x.ipynb": "x-zigzag.ipynb"})
    assert shown.source == "[02](x-zigzag.ipynb), code, [site](https://a.example)"
