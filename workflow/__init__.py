"""Run notebooks into results/<id>/, with pytask (only what is out of date, two at once) and papermill."""

import sys

# If this library is found, jsonschema, which papermill imports, takes three seconds to compile a grammar of IRIs.
sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]
