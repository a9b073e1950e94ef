"""Notebooks → results/<id>/, by pytask (what is out of date, two at once) and papermill."""

import sys

# jsonschema, which papermill imports, compiles a grammar of IRIs for three seconds where this library is found.
sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]
