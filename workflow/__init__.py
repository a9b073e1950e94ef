"""Notebooks → results/<id>/, by pytask (tasks, what is out of date, two at once) and papermill (execution).

pytask instead of Snakemake: a trial showed that it can do all that is asked of it. Its states are ours (`Folder`, `Key`
in `task_notebooks.py`), so that what is out of date goes by the keys of `workflow.experiments`; its lock file survives
kill -9; its plugin hooks name what runs. Two things it does not do are done here: ending kernels when it is
interrupted (`execute.py`), and refusing a second call at the same time.
"""

import sys

# jsonschema compiles the grammar of IRIs as it is imported, which takes each worker longer than the rest of papermill,
# for a format that no notebook has; where this library is missing, it leaves that format unchecked.
sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]
