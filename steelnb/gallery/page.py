"""One notebook as executed → one HTML page; cards → the index."""

import functools
import html
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from steelnb.errors import NotebookError

HERE = Path(__file__).parent
MARK = '<meta name="generator" content="steelnb gallery">'
PLOTLY_TYPE = "application/vnd.plotly.v1+json"
WIDGET_TYPE = "application/vnd.jupyter.widget-view+json"
# Nothing may be fetched. Plotly compiles shaders from text, and hands pictures to the reader as blobs.
POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline' 'unsafe-eval'; img-src data: blob:"
CONTROLS = "Here are controls in JupyterLab (<code>make lab</code>); this page shows one choice."
CELLS = """
{%- extends 'basic/index.html.j2' -%}
{% block input %}
{%- set names = {'parameters': 'Parameters', 'injected-parameters': 'Parameters of this run'} -%}
<details class="code"><summary>{{ names.get((cell.metadata.tags or [''])[0], 'Code') }}</summary>
{{ cell.source | highlight_code(metadata=cell.metadata) }}
</details>
{%- endblock %}
"""


@dataclass(frozen=True)
class Page:
    """A notebook as HTML: its cells, its first sentence, and whether it holds a 3D view."""

    body: str
    lead: str
    plots: bool


@dataclass(frozen=True)
class Card:
    """What the index shows of an experiment; ``pages`` maps the names of its parts to files, none if it has not run."""

    id: str
    title: str
    about: str
    picture: str
    pages: dict[str, str]


def read_page(executed: Path, links: Mapping[str, str]) -> Page:
    """Convert a notebook; ``links`` maps notebooks to pages. Raises `NotebookError` if it holds an error."""
    import nbformat
    from jinja2 import DictLoader
    from nbconvert import HTMLExporter

    notebook = nbformat.read(executed, as_version=4)
    notebook.metadata.pop("widgets", None)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            if "injected-parameters" in cell.metadata.get("tags", []):  # the folder of that run is nobody's concern
                cell.source = re.sub(r"(?m)^(results_dir = .*|# Parameters)\n?", "", cell.source)
            cell.outputs = [_portable(output, executed) for output in cell.outputs if output.get("name") != "stderr"]
    exporter = HTMLExporter(
        extra_loaders=[DictLoader({"cells.html.j2": CELLS})],
        template_name="basic",
        template_file="cells.html.j2",
        exclude_input_prompt=True,
        exclude_output_prompt=True,
        exclude_anchor_links=True,
    )
    body, _ = exporter.from_notebook_node(notebook)
    body = re.sub(r'href="([^"]*)"', lambda found: _link(found[1], links), body)
    body = re.sub(r"<table\b.*?</table>", r'<div class="wide">\g<0></div>', body, flags=re.DOTALL)
    texts = [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]
    lead = next((line for line in "\n".join(texts).split("\n\n") if line.strip() and not line.startswith("#")), "")
    sentence = re.split(r"(?<=[.?!])\s", re.sub(r"[*`]|\s+", lambda m: " " if m[0].isspace() else "", lead).strip())[0]
    return Page(body, sentence, 'class="plot"' in body)


def _portable(output: Any, executed: Path) -> Any:
    """The output as nbconvert can show it: a figure of Plotly becomes a place to draw it in and its data, and controls,
    which do nothing without a kernel, a word on where they do."""
    if output.output_type == "error":
        raise NotebookError(f"{executed}: {output.ename}: {output.evalue}")
    data = output.get("data", {})
    if PLOTLY_TYPE in data:
        figure = json.dumps(data[PLOTLY_TYPE]).replace("</", "<\\/")
        height = data[PLOTLY_TYPE].get("layout", {}).get("height", 450)
        output.data = {
            "text/html": f'<div class="plot" style="height:{height}px"></div>'
            f'<script type="application/json">{figure}</script>'
        }
    if WIDGET_TYPE in data:
        output.data = {"text/html": f'<p class="note">{CONTROLS}</p>'}
    if "image/png" in data:
        output.metadata.setdefault("image/png", {}).setdefault("alt", "figure, described in the text beside it")
    return output


def _link(target: str, links: Mapping[str, str]) -> str:
    """A link to a notebook leads to its page; one to another file of the project leads nowhere from here."""
    if target.startswith(("#", "http:", "https:", "data:")):
        return f'href="{target}"'
    page = links.get(Path(target.partition("#")[0]).name)
    return f'href="{page}"' if page else ""


def page_html(page: Page, title: str, siblings: Mapping[str, str], own: str) -> str:
    """A whole page. ``siblings`` maps the names of the experiment's parts to their files, ``own`` among them."""
    others = "".join(
        f'<a href="{file}"{" aria-current=page" if file == own else ""}>{html.escape(name)}</a>'
        for name, file in siblings.items()
        if len(siblings) > 1
    )
    scripts = f"<script>{_plotly()}</script><script>{_text('page.js')}</script>" if page.plots else ""
    navigation = f'<nav><a href="index.html">All notebooks</a>{others}</nav>'
    return _whole(title, f"{navigation}<main>{page.body}</main>{scripts}")


def index_html(cards: Sequence[Card]) -> str:
    """The first page: a picture, a sentence and links for each experiment."""
    shown = []
    for card in cards:
        title, first = html.escape(card.title), next(iter(card.pages.values()), "")
        picture = f'<img src="{card.picture}" alt="{title}">' if card.picture else ""
        if card.pages:
            links = " ".join(f'<a href="{file}">{html.escape(name)}</a>' for name, file in card.pages.items())
            head = f'<a class="picture" href="{first}">{picture}</a><h2><a href="{first}">{title}</a></h2>'
        else:
            links = f"Takes long, and was not run here: <code>steelnb reproduce {card.id}</code>, then make it again."
            head = f'<span class="picture">{picture}</span><h2>{title}</h2>'
        shown.append(f"<article>{head}<p>{html.escape(card.about)}</p><p class=links>{links}</p></article>")
    heading = "<h1>steelnb</h1><p>A drone maps a steel tower while its position drifts: the notebooks, as executed.</p>"
    return _whole("steelnb", f'<main>{heading}<div class="cards">{"".join(shown)}</div></main>')


def _whole(title: str, body: str) -> str:
    from pygments.formatters import HtmlFormatter

    light, dark = (HtmlFormatter(style=name).get_style_defs(".highlight") for name in ("default", "github-dark"))
    style = f"{light}\n@media (prefers-color-scheme: dark) {{ {dark} }}\n{_text('page.css')}"
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
{MARK}
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<link rel="icon" href="data:,">
<title>{html.escape(title)}</title>
<style>{style}</style>
</head>
<body>
{body}
</body>
</html>
"""


@functools.cache
def _plotly() -> str:
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())


def _text(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")
