"""Run notebooks into results/<id>/ with papermill: only what is out of date, two at once."""

import sys

# If this library is found, jsonschema, which papermill imports, takes three seconds to compile a grammar of IRIs.
sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]
