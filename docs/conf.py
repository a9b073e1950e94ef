"""Sphinx: the method explained, how-to pages, the notebooks as executed, and the API, to read offline."""

import os
import re
from pathlib import Path

from docutils import nodes
from docutils.utils.math import latex2mathml
from sphinx.application import Sphinx

import steelnb

ROOT = Path(__file__).parents[1]
DOCS = Path(__file__).parent

project = "steelnb"
author = "The steelnb authors"
version = release = steelnb.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
root_doc = "index"

# Notebooks come from the workflow, executed; see workflow/pages.py.
nb_execution_mode = "off"
nb_output_stderr = "remove"
nb_merge_streams = True
myst_enable_extensions = ["colon_fence", "dollarmath", "html_image"]
myst_heading_anchors = 3
suppress_warnings = ["mystnb.unknown_mime_type"]

default_role = "code"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_default_options = {"exclude-members": "model_config"}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True

html_theme = "pydata_sphinx_theme"
html_title = "steelnb"
html_static_path = ["_static"]
html_css_files = ["steelnb.css"]
html_js_files = ["plotly.min.js", "resize.js"] if (DOCS / "_static/plotly.min.js").exists() else []
html_show_sourcelink = False
# Pages without pages below them.
html_sidebars: dict[str, list[str]] = {
    page: [] for page in ("index", "start", "results", "architecture", "contributing", "changelog")
}
html_math_renderer = "mathml"
html_theme_options = {"navbar_align": "left", "show_prev_next": True, "navigation_depth": 2}

# Pages that stand elsewhere in the repository, for readers of its files: target below docs/ → source.
BROUGHT = {
    "results.md": "results/README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
    "benchmarks/index.md": "benchmarks/README.md",
    **{f"benchmarks/{path.name}": f"benchmarks/{path.name}" for path in (ROOT / "benchmarks").glob("[!R]*.md")},
}
TOCTREE = "\n\n```{toctree}\n:hidden:\n:glob:\n*\n```\n"


def bring(target: str, source: str) -> None:
    """Copy a page. Links lead to the pages that are brought too, and to pictures and tables; others become text."""
    pages = {ROOT / origin: DOCS / page for page, origin in BROUGHT.items()}

    def led(link: re.Match[str]) -> str:
        text, name, anchor = link[1], link[2], link[3] or ""
        if name.startswith(("http:", "https:")):
            return link[0]
        file = (ROOT / source).parent.joinpath(name).resolve()
        file = pages.get(file, file)
        if file.suffix not in {".md", ".png", ".csv"}:
            return text
        return f"[{text}]({os.path.relpath(file, (DOCS / target).parent)}{anchor})"

    page = re.sub(r"\[([^]]*)\]\(([^)#\s]+)(#[^)]*)?\)", led, (ROOT / source).read_text(encoding="utf-8"))
    page = page.replace('<img src="', f'<img src="{os.path.relpath((ROOT / source).parent, (DOCS / target).parent)}/')
    page += TOCTREE if target.endswith("index.md") else ""
    (DOCS / target).parent.mkdir(exist_ok=True)
    if not (DOCS / target).exists() or (DOCS / target).read_text(encoding="utf-8") != page:
        (DOCS / target).write_text(page, encoding="utf-8")


def list_parameters(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Parameters as napoleon reads them: descriptions on lines of their own, and two blank lines after the last.

    It takes what follows a colon for a type, and a paragraph after a single blank line for another parameter.
    """
    if "Parameters" not in lines:
        return
    begin = lines.index("Parameters") + 2
    after = (k for k in range(begin, len(lines) - 1) if not lines[k] and lines[k + 1][:1].strip())
    end = next(after, len(lines))
    listed = [re.sub(r"^(\w[\w, ]*?) ?: ", r"\1\n    ", line) for line in lines[begin:end]]
    lines[begin:end] = [*"\n".join(listed).split("\n"), ""]


def visit_math(writer, node: nodes.math) -> None:  # type: ignore[no-untyped-def]
    """Equations as MathML, which browsers show without a script from elsewhere."""
    writer.body.append(latex2mathml.tex2mathml(node.astext()))
    raise nodes.SkipNode


def visit_math_block(writer, node: nodes.math_block) -> None:  # type: ignore[no-untyped-def]
    writer.body.append(f'<div class="math">{latex2mathml.tex2mathml(node.astext(), as_block=True)}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    for target, source in BROUGHT.items():
        bring(target, source)
    app.connect("autodoc-process-docstring", list_parameters, priority=100)  # before napoleon
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_math_block, None))
