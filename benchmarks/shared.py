"""Imported first by timed benchmarks: one core and one thread, which libraries count when they are imported."""

import os

os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[name] = "1"


def command(doc: str) -> str:
    """The call that a script's docstring names, without the file that its output goes to."""
    return next(line.strip() for line in doc.splitlines() if line.startswith("    ")).split(" >")[0]
