"""Imported first by timed benchmarks: pins one core and one thread, since libraries count them when imported."""

import os

os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[name] = "1"


def command(doc: str) -> str:
    """The command line in a script's docstring, without the redirection of its output."""
    return next(line.strip() for line in doc.splitlines() if line.startswith("    ")).split(" >")[0]
