"""`make check`: some runs of the study run again, and are compared with results/study/."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from steelnb.keys import digest
from steelnb.study import cluster
from steelnb.study.plan import CASE, Run
from steelnb.study.row import OK
from steelnb.study.table import CURVES, RUNS, TIMES, read_rows
from workflow.check import agree


def check_sample(runs: Sequence[Run], folder: Path, count: int = 6, workers: int = 2) -> list[str]:
    """Run a sample of a study again: a line for each value that differs from the table in ``folder``.

    The sample does not depend on the code: those runs whose names have the smallest digests. A run that the table lacks
    or holds as failed is a difference too. Raises what `read_study` and `run_study` raise.
    """
    stored = {tuple(row[name] for name in CASE): row for row in read_rows(folder / RUNS) if row["status"] == OK}
    found = [f"{run.label}: not in {folder / RUNS}" for run in runs if tuple(run.case.values()) not in stored]
    there = [run for run in runs if tuple(run.case.values()) in stored]
    sample = sorted(there, key=lambda run: digest([*run.case.values()]))[:count]
    with tempfile.TemporaryDirectory() as scratch:
        cluster.run_study(sample, Path(scratch), workers)
        again = {row["key"]: row for row in read_rows(Path(scratch, RUNS))}
    for run in sample:
        before, now = stored[tuple(run.case.values())], again[run.key]
        for name in sorted({*before, *now} - {"key", *TIMES}):
            if not _same(name, before.get(name), now.get(name)):
                values = "" if name in CURVES else f" was {before.get(name)}, is {now.get(name)}"
                found.append(f"{run.label}: {name}{values}")
    return found


def _same(name: str, old: Any, new: Any, tolerance: float = 1e-6) -> bool:
    """Whether a value is the same; in curves the tolerance is relative to the largest value."""
    if name in CURVES and old and new and len(old) == len(new):
        return bool(np.allclose(old, new, rtol=0.0, atol=tolerance * max(np.abs(old).max(), 1e-9)))
    return agree(str(old), str(new), tolerance)
