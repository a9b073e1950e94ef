"""A study from its file to its table: run it, say what it would take, and run a sample of it again to compare."""

import hashlib
import json
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from steelnb.errors import FileMissingError, OutputError
from steelnb.project import Project, find_root
from steelnb.reproduce import CheckReport, Status
from steelnb.results import committed_bytes, differing, machine
from steelnb.study.cluster import Advance, connected, local_workers, run_study
from steelnb.study.cost import Costs, worker_bytes
from steelnb.study.plan import CASE, Run, by_flight, environment_digest, make_runs, read_blocks
from steelnb.study.row import OK
from steelnb.study.store import CURVES, RUNS, TIMES, Store, holding, parse_table

STUDY_FILE = Path("notebooks", "study.toml")
LOCK = "environment.lock"
RESULTS = Path("results", "study")
SAMPLE = 6
"""How many runs `check` runs again."""


@dataclass(frozen=True)
class StudyReport:
    """What a study did, or would do: runs in all, of which some were there before and some failed, now, with the
    labels and last lines of these; ``notes`` on damaged files, and the folder of the table."""

    runs: int
    kept: int
    failed: list[str]
    notes: list[str]
    folder: Path


@dataclass(frozen=True)
class Forecast:
    """What a study would do: ``runs`` on ``flights``, ``kept`` of which are there already, ``known`` runs to judge by,
    and the seconds, workers and bytes a worker that the rest would take."""

    runs: int
    flights: int
    kept: int
    known: int
    seconds: float
    workers: int
    worker_bytes: float
    notes: list[str]


def read_study_file(path: Path | None = None) -> list[Run]:
    """The runs of a study's file (default: the project's). Raises `SteelnbError`."""
    root = find_root()
    path = path or root / STUDY_FILE
    return make_runs(read_blocks(path), environment_digest(root / LOCK))


def run(
    path: Path | None = None,
    out: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    on_progress: Callable[[Status], None] | None = None,
) -> StudyReport:
    """Run what is missing of a study, and write its table; see `study.store` for what ``out`` then holds.

    A local cluster of ``workers`` processes, by default one a core, or that at the address ``scheduler``. Raises
    `SteelnbError`; what had ended before is in the folder then, and the next call goes on from there.
    """
    runs, folder = read_study_file(path), _folder(out)
    show = on_progress or (lambda status: None)
    with holding(folder):
        store = Store(folder)
        kept = len(store.done() & {run.key for run in runs})
        described = machine() if scheduler is None else "a cluster of the user's"
        failed = run_study(runs, store, described, workers, scheduler, lambda advance: show(_status(advance)))
        store.compact(runs)
    return StudyReport(len(runs), kept, [_line(row) for row in failed], store.notes, folder)


def forecast(
    path: Path | None = None, out: Path | None = None, workers: int | None = None, scheduler: str | None = None
) -> Forecast:
    """What `run` would do; nothing is run or written. Raises `SteelnbError`."""
    runs, store = read_study_file(path), Store(_folder(out), aside=False)
    done = store.done()
    missing = [run for run in runs if run.key not in done]
    if scheduler is None:
        workers = local_workers(workers, len(by_flight(missing)))
    else:
        with connected(workers, scheduler, 1) as client:
            workers = len(client.scheduler_info(n_workers=-1)["workers"])
    seconds = Costs(store.rows).total_s(missing) / workers
    return Forecast(
        runs=len(runs),
        flights=len(by_flight(runs)),
        kept=len(runs) - len(missing),
        known=len(done),
        seconds=seconds,
        workers=workers,
        worker_bytes=worker_bytes(missing),
        notes=store.notes,
    )


def check(
    asked: bool, workers: int = 2, on_progress: Callable[[Status], None] | None = None, root: Path | None = None
) -> CheckReport | None:
    """Run `SAMPLE` runs of the committed study again and compare; None where no study is committed and none ``asked``.

    The sample is always the same: the runs whose names have the smallest hashes. A run of the study's file that the
    table does not have, or has as failed, is a difference too. Raises `SteelnbError`.
    """
    project = Project(root)
    name = (RESULTS / RUNS).as_posix()
    try:
        rows = parse_table(committed_bytes(project.root, name)).to_pylist()
    except FileMissingError:
        if asked:
            raise FileMissingError(f"{project.root / name}: nothing to compare with; run `steelnb study`") from None
        return None
    except ValueError as fault:
        raise FileMissingError(f"{project.root / name}: {fault}; expected the table of a study") from None
    runs = make_runs(read_blocks(project.root / STUDY_FILE), environment_digest(project.root / LOCK))
    committed = {tuple(row[each] for each in CASE): row for row in rows if row["status"] == OK}
    pairs: list[tuple[str, str, Any, Any]] = [
        ("status", run.label, None, "a run of the study's file")
        for run in runs
        if tuple(run.case.values()) not in committed
    ]
    sample = sample_of([run for run in runs if tuple(run.case.values()) in committed], SAMPLE)
    scratch = project.cache / "check" / "study"
    show = on_progress or (lambda status: None)
    with holding(scratch):
        shutil.rmtree(scratch / "parts", ignore_errors=True)
        store = Store(scratch)
        run_study(sample, store, machine(), workers, on_advance=lambda advance: show(_status(advance)))
        again = store.compact(sample).to_pylist()
    count = 0
    for row in again:
        case = tuple(row[each] for each in CASE)
        before = committed[case]
        names = [each for each in {**before, **row} if each not in (*CASE, *TIMES, "key")]
        where = " ".join(str(value) for value in case if value != "")
        pairs += [(each, where, *_comparable(before.get(each), row.get(each), each)) for each in sorted(names)]
        count += len(names)
    return CheckReport(differing("study", pairs, project.check), count, 1, scratch)


def sample_of(runs: Sequence[Run], count: int) -> list[Run]:
    """Some of the runs, as if at random, but the same ones whatever the code is."""
    return sorted(runs, key=lambda run: hashlib.sha256(json.dumps(list(run.case.values())).encode()).digest())[:count]


def _comparable(before: Any, now: Any, name: str) -> tuple[Any, Any]:
    """Two values as `differing` wants them; a curve as its largest difference from the committed one, of 0."""
    if name not in CURVES or before is None or now is None or len(before) != len(now):
        return before, now
    scale = max(float(np.abs(before).max(initial=0.0)), 1e-9)
    apart = float(np.abs(np.subtract(now, before)).max(initial=0.0)) / scale
    # Curves are kept as float32, whose last digit may round the other way.
    return 0.0, 0.0 if apart < 1e-6 else apart


def _folder(out: Path | None) -> Path:
    folder = (out or find_root() / RESULTS).absolute()
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: cannot be written: not a folder")
    return folder


def _line(row: dict[str, Any]) -> str:
    case = " ".join(str(row[name]) for name in CASE if row[name] != "")
    return f"{case}: {row['error'].splitlines()[-1]}"


def _status(advance: Advance) -> Status:
    running = (f"{advance.workers} workers", f"{advance.failed} failed")
    remaining_s = None if advance.remaining_s is None else math.ceil(advance.remaining_s)
    return Status(advance.done, advance.total, running, advance.fraction, remaining_s, advance.event)
