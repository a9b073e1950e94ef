"""Notebooks → results/<id>/, by pytask (tasks, what is out of date, two at once) and papermill (execution).

pytask instead of Snakemake: a trial showed that it can do all that is asked of it. Its states are ours (`Folder`, `Key`
in `task_notebooks.py`), so that what is out of date goes by the keys of `steelnb.keys`; its lock file survives
kill -9; its plugin hooks name what runs. Two things it does not do are done here: ending kernels when it is
interrupted (`execute.py`), and refusing a second call at the same time.
"""
