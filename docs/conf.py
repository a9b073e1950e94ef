"""Sphinx: the notebooks as executed, and the API from docstrings, to read offline."""

import steelnb

project = "steelnb"
author = "The steelnb authors"
version = release = steelnb.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_design"]
exclude_patterns = ["_build"]
root_doc = "index"

# Notebooks come from the workflow, executed; see workflow/pages.py.
nb_execution_mode = "off"
nb_output_stderr = "remove"
nb_merge_streams = True
myst_enable_extensions = ["colon_fence"]
suppress_warnings = ["mystnb.unknown_mime_type"]

default_role = "code"
autodoc_typehints = "description"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True

html_theme = "pydata_sphinx_theme"
html_title = "steelnb"
html_static_path = ["_static"]
html_js_files = ["plotly.min.js"]
html_show_sourcelink = False
html_theme_options = {"navbar_align": "left", "show_prev_next": True, "navigation_depth": 2}
