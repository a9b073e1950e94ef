"""Sphinx: ten pages and the notebooks as executed, to read offline."""

import re
from pathlib import Path

from docutils import nodes
from docutils.utils.math import latex2mathml
from sphinx.application import Sphinx

import steelnb

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
myst_enable_extensions = ["colon_fence", "dollarmath"]
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
html_sidebars = {"**": []}  # no page has pages below it
html_math_renderer = "mathml"
html_theme_options = {"navbar_align": "left", "show_prev_next": True, "navigation_depth": 2}


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


def offer_files(app: Sphinx, page: str, source: list[str]) -> None:
    """Links to pages of the repository that are none of these, such as those of benchmarks, offer the file."""
    source[0] = re.sub(r"\[([^]]+)\]\((\.\./[^)#]+\.md)\)", r"{download}`\1 <\2>`", source[0])


def visit_math(writer, node: nodes.math) -> None:  # type: ignore[no-untyped-def]
    """Equations as MathML, which browsers show without a script from elsewhere."""
    writer.body.append(latex2mathml.tex2mathml(node.astext()))
    raise nodes.SkipNode


def visit_math_block(writer, node: nodes.math_block) -> None:  # type: ignore[no-untyped-def]
    writer.body.append(f'<div class="math">{latex2mathml.tex2mathml(node.astext(), as_block=True)}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    app.connect("source-read", offer_files)
    app.connect("autodoc-process-docstring", list_parameters, priority=100)  # before napoleon
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_math_block, None))
