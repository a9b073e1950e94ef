"""Run the notebooks, each in a process of its own, keep what is up to date, and compare with what is committed.

Below ``.cache/reproduce/`` of the project lie, for each kind of run (full, smoke, custom, check): ``parts/``, the
results of every part and its notebook as executed, with the key they belong to, from which an interrupted run resumes
and a gallery is made; ``notebooks/`` as executed, to read a failure in; and ``written.json``, the digests of what was
put into the result folders.
"""

import contextlib
import fcntl
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import steelnb.errors
from steelnb.errors import FileMissingError, NotebookError, OutputError, SettingsError, SteelnbError
from steelnb.project import RESULT_FOLDERS, Experiment, Part, Project
from steelnb.results import (
    Difference,
    Progress,
    committed_text,
    compare,
    digests,
    estimate,
    merge,
    write_results,
)
from steelnb.worker import TICK_S, environment, kill_marked, read_json, write_json

__all__ = ["Progress", "Report", "State", "Status", "check", "executed", "run", "states", "write_results"]

COMPARED = ("metrics.json", "table.csv")
REQUIRED = (*COMPARED, "provenance.json")
EXECUTED = "executed.ipynb"


class NotebooksFailedError(NotebookError):
    """Notebooks that raised, one line each in ``failures``; ``exit_code`` is 2 where bad input was the only cause."""

    def __init__(self, failures: Iterable[str], exit_code: int) -> None:
        self.failures, self.exit_code = list(failures), exit_code
        super().__init__("; ".join(self.failures))


@dataclass(frozen=True)
class Status:
    """How far a run has come: parts done and running, ``fraction`` 0 to 1, ``remaining_s`` None if unknown, and
    ``event``, a line where something has just happened."""

    done: int
    total: int
    running: tuple[str, ...]
    fraction: float
    remaining_s: float | None
    event: str


@dataclass(frozen=True)
class Report:
    """Labels of the parts that were run and of those kept, and the result folders written (none if up to date)."""

    ran: list[str]
    kept: list[str]
    written: list[Path]


@dataclass(frozen=True)
class CheckReport:
    """What differs from what is committed, excused differences among it; counts of what was compared, and the folder
    that holds the new results."""

    differences: list[Difference]
    metrics: int
    experiments: int
    folder: Path


@dataclass(frozen=True)
class State:
    """An experiment, its number of parts, and ``up to date``, ``out of date`` or ``never run`` (in this clone)."""

    experiment: Experiment
    parts: int
    state: str


OnProgress = Callable[[Status], None]


def run(
    ids: Iterable[str] = (),
    budget: str = "full",
    parameters: Mapping[str, Any] | None = None,
    output: Path | None = None,
    jobs: int = 2,
    *,
    force: bool = False,
    on_progress: OnProgress | None = None,
    root: Path | None = None,
) -> Report:
    """Run the notebooks of the experiments named (default: all that are not apart); leave ``<output>/<id>/`` for each.

    ``output`` is by default ``results`` or, for the budget smoke, ``results-smoke`` in the project; ``parameters``
    (name → value, dotted names for single settings) want an output of their own. Everything is checked before a
    notebook starts. Parts and folders that are up to date are left alone unless ``force``. Raises `SteelnbError`;
    notebooks that raise end in `NotebooksFailedError` after the others are done; KeyboardInterrupt on SIGINT, SIGTERM
    and SIGHUP.
    """
    project, given = Project(root), dict(parameters or {})
    parts = [
        (experiment, project.parts(experiment, budget, given))
        for experiment in project.select(ids, apart=budget == "smoke")
    ]
    folder = project.output_folder(budget, given, output)
    plans = [_Plan(experiment, budget, some, folder / experiment.id) for experiment, some in parts]
    return _Runner(project, "custom" if given else budget, jobs, on_progress).run(plans, force)


def check(
    ids: Iterable[str] = (),
    budget: str = "full",
    jobs: int = 2,
    *,
    rerun: bool = True,
    on_progress: OnProgress | None = None,
    root: Path | None = None,
) -> CheckReport:
    """Run the experiments again into a scratch folder, reading no cache, and compare with what is committed.

    With ``rerun`` False, the result folder as it stands is compared: right after `run` in a fresh clone it is as good.
    Without git, or where nothing is committed, the files in the result folder are compared. Raises `FileMissingError`
    where there are none, before a notebook starts, and what `run` raises.
    """
    project = Project(root)
    scratch = project.cache / "check" if rerun else project.root / RESULT_FOLDERS[budget]
    plans = [
        _Plan(experiment, budget, project.parts(experiment, budget), scratch / experiment.id)
        for experiment in project.select(ids, apart=budget == "smoke")
    ]
    committed = {
        plan.folder: {
            name: committed_text(project.root, f"{RESULT_FOLDERS[budget]}/{plan.experiment.id}/{name}")
            for name in COMPARED
        }
        for plan in plans
    }
    if rerun:
        _Runner(project, "check", jobs, on_progress).run(plans, force=True)
    differences: list[Difference] = []
    for folder, before in committed.items():
        missing = [folder / name for name in COMPARED if not (folder / name).is_file()]
        if missing:
            raise FileMissingError(f"{missing[0]}: nothing to compare; run `steelnb reproduce` first")
        now = {name: (folder / name).read_text(encoding="utf-8") for name in COMPARED}
        differences += compare(folder.name, before, now, project.check)
    metrics = sum(len(json.loads(before["metrics.json"])) for before in committed.values())
    return CheckReport(differences, metrics, len(plans), scratch)


def states(root: Path | None = None) -> list[State]:
    """The state of the full results of every experiment. Raises `SteelnbError`."""
    project = Project(root)
    runner, folder = _Runner(project, "full"), project.root / RESULT_FOLDERS["full"]
    plans = [
        _Plan(experiment, "full", project.parts(experiment, "full"), folder / experiment.id)
        for experiment in project.select()
    ]
    return [State(plan.experiment, len(plan.parts), runner.state(plan)) for plan in plans]


def executed(ids: Iterable[str] = (), budget: str = "full", root: Path | None = None) -> list[tuple[Part, Path | None]]:
    """Every part of the experiments named (default: all), with its notebook as executed, None where it is not up to
    date. Raises `SteelnbError`."""
    project = Project(root)
    runner = _Runner(project, budget)
    found: list[tuple[Part, Path | None]] = []
    for experiment in project.select(ids):
        for part in project.parts(experiment, budget):
            path = runner.store(part) / EXECUTED
            found.append((part, path if runner.record(part).get("key") == part.key and path.is_file() else None))
    return found


@dataclass(frozen=True)
class _Plan:
    """One experiment: its parts in order, and the folder for their merged results."""

    experiment: Experiment
    budget: str
    parts: list[Part]
    folder: Path


@dataclass
class _Job:
    """A part that a worker process is to run, is running or has run, in a scratch folder of its own."""

    part: Part
    folder: Path
    expected_s: float | None
    process: subprocess.Popen[bytes] | None = None
    started_s: float = 0.0
    elapsed_s: float = 0.0
    fraction: float = 0.0

    @property
    def mark(self) -> str:
        """What the environment of the worker, of its kernel and of all their children holds."""
        return f"{self.folder.parent.name}:{self.folder.name}:"


class _Runner:
    """Runs the parts of some plans, a few at once. ``slot`` is the kind of run, which has a cache of its own."""

    def __init__(self, project: Project, slot: str, workers: int = 1, on_progress: OnProgress | None = None) -> None:
        if workers < 1:
            raise SettingsError(f"jobs = {workers}: expected at least 1")
        self.project, self.cache, self.slot, self.workers = project, project.cache, slot, workers
        self.on_progress = on_progress or (lambda status: None)
        self.written = read_json(self.cache / "written.json")
        self.scratch = self.cache / "scratch" / f"{os.getpid()}-{time.time_ns()}"
        self.failures: dict[str, tuple[str, bool]] = {}

    def store(self, part: Part) -> Path:
        """Where the results of a part lie, with a record of their key and of the seconds they took."""
        return self.cache / "parts" / self.slot / part.experiment / (part.name or "all")

    def record(self, part: Part) -> dict[str, Any]:
        return read_json(self.store(part) / "record.json")

    def state(self, plan: _Plan) -> str:
        """Whether the result folder holds what the parts, as they are now, gave."""
        written = self.written.get(os.path.relpath(plan.folder, self.project.root))
        current = {"keys": [part.key for part in plan.parts], "files": digests(plan.folder)}
        return "never run" if not written else "up to date" if written == current else "out of date"

    def run(self, plans: list[_Plan], force: bool) -> Report:
        """Run what is not up to date, longest first, and merge each experiment as soon as its last part is done."""
        parts = [(plan, part) for plan in plans for part in plan.parts]
        stale = [plan for plan in plans if force or self.state(plan) != "up to date"]
        kept = [
            part.label
            for plan, part in parts
            if plan not in stale or (not force and self.record(part).get("key") == part.key)
        ]
        jobs = [
            _Job(part, self.scratch / str(index), self.record(part).get("seconds", plan.experiment.expected_s))
            for index, (plan, part) in enumerate(parts)
            if part.label not in kept
        ]
        written: list[Path] = []
        if stale:
            try:
                with _lock(self.cache), _signals() as interrupted:
                    written = self._run(stale, jobs, interrupted)
            except OSError as fault:
                raise OutputError(f"{fault.filename or self.cache}: {fault.strerror or fault}") from None
        if self.failures:
            lines, bad_inputs = zip(*self.failures.values(), strict=True)
            raise NotebooksFailedError(lines, 2 if all(bad_inputs) else 1)
        return Report(
            [job.part.label for job in jobs], kept, sorted(written, key=[plan.folder for plan in plans].index)
        )

    def _run(self, stale: list[_Plan], jobs: list[_Job], interrupted: threading.Event) -> list[Path]:
        """Run the jobs; gives the folders written. However it ends, no process and no scratch folder stays."""
        shutil.rmtree(self.scratch.parent, ignore_errors=True)  # of a run that was killed
        waiting = sorted(jobs, key=lambda job: -(job.expected_s or math.inf))
        running: list[_Job] = []
        written: list[Path] = []
        try:
            while True:
                for plan in [plan for plan in stale if not _holds(waiting, plan) and not _holds(running, plan)]:
                    stale.remove(plan)
                    if not any(part.label in self.failures for part in plan.parts):
                        self._merge(plan)
                        written.append(plan.folder)
                if not waiting and not running:
                    return written
                if interrupted.is_set():
                    raise KeyboardInterrupt
                while waiting and len(running) < self.workers:
                    running.append(waiting.pop(0))
                    self._start(running[-1])
                    self._tell(jobs, running, f"{running[-1].part.label}: started")
                time.sleep(TICK_S)
                self._tell(jobs, running)
                for job in [job for job in running if job.process and job.process.poll() is not None]:
                    event = self._finish(job)
                    running.remove(job)
                    self._tell(jobs, running, event)
        finally:
            kill_marked(f"{self.scratch.name}:")
            for job in running:
                if job.process:
                    job.process.wait()
            shutil.rmtree(self.scratch, ignore_errors=True)

    def _start(self, job: _Job) -> None:
        output = job.folder / "part" / "output"
        output.parent.mkdir(parents=True)
        order = {
            "parent": os.getpid(),
            "mark": job.mark,
            "notebook": str(job.part.notebook),
            "parameters": {**job.part.parameters, "results_dir": str(output)},
        }
        write_json(job.folder / "order.json", order)
        with (job.folder / "log.txt").open("wb") as log:
            job.process = subprocess.Popen(
                [sys.executable, "-m", "steelnb.worker", str(job.folder)],
                env=environment(job.folder, job.mark),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,  # Ctrl-C shall reach this process alone, which then ends the others
            )
        job.started_s = time.monotonic()

    def _finish(self, job: _Job) -> str:
        """Keep what a worker that has ended leaves; gives the line that says so."""
        part, output = job.part, job.folder / "part" / "output"
        kill_marked(job.mark)  # a worker that died leaves its kernel behind
        job.fraction = 1.0
        executed = self.cache / "notebooks" / self.slot / part.experiment / f"{part.name or 'all'}.ipynb"
        with contextlib.suppress(FileNotFoundError):
            executed.parent.mkdir(parents=True, exist_ok=True)
            os.replace(job.folder / "executed.ipynb", executed)
        outcome = read_json(job.folder / "outcome.json")
        missing = [name for name in REQUIRED if not (output / name).is_file()]
        if not outcome:
            log = (job.folder / "log.txt").read_text(encoding="utf-8", errors="replace").split("\n")
            last = next((line for line in reversed(log) if line.strip()), "no word in its log")
            code = job.process.returncode if job.process else None
            outcome = {"error": "WorkerDied", "message": f"exit code {code}, {last}"}
        elif not outcome["error"] and missing:
            outcome = {"error": "NoResults", "message": f"{', '.join(missing)} missing; expected write_results(...)"}
        if outcome["error"]:
            message = " ".join(f"{outcome['error']}: {outcome['message']}".split())[:300]
            bad_input = hasattr(steelnb.errors, outcome["error"])
            self.failures[part.label] = (f"{part.label}: {message} (see {executed})", bad_input)
            return f"{part.label}: failed: {message}"
        key, note = "", ""
        with contextlib.suppress(SteelnbError):
            key = self.project.key(part.notebook, part.parameters, part.inputs)
        if key != part.key:  # edited meanwhile: nobody can tell what ran, so it belongs to no key
            key, note = "", "; notebook or code was edited meanwhile, so the next call runs it again"
        shutil.copyfile(executed, job.folder / "part" / EXECUTED)
        write_json(job.folder / "part" / "record.json", {"key": key, "seconds": round(job.elapsed_s, 3)})
        shutil.rmtree(self.store(part), ignore_errors=True)
        self.store(part).parent.mkdir(parents=True, exist_ok=True)
        os.replace(job.folder / "part", self.store(part))
        return f"{part.label}: done in {job.elapsed_s:.0f} s{note}"

    def _merge(self, plan: _Plan) -> None:
        experiment = plan.experiment
        about = {"experiment": experiment.id, "notebook": experiment.notebook, "budget": plan.budget}
        merge({part.name: self.store(part) / "output" for part in plan.parts}, plan.folder, about)
        # What a run of another process has noted meanwhile stays.
        self.written = read_json(self.cache / "written.json")
        keys = [self.record(part).get("key") for part in plan.parts]
        name = os.path.relpath(plan.folder, self.project.root)
        self.written[name] = {"keys": keys, "files": digests(plan.folder)}
        write_json(self.cache / "written.json", self.written)

    def _tell(self, jobs: list[_Job], running: list[_Job], event: str = "") -> None:
        for job in running:
            job.elapsed_s = time.monotonic() - job.started_s
            # A file that is just being written reads as empty.
            with contextlib.suppress(OSError, ValueError):
                job.fraction = max(job.fraction, min(float((job.folder / "progress").read_text()), 1.0))
        fraction, left_s = estimate([(job.expected_s, job.elapsed_s, job.fraction) for job in jobs], self.workers)
        done = sum(job.process is not None for job in jobs) - len(running)
        self.on_progress(Status(done, len(jobs), tuple(job.part.label for job in running), fraction, left_s, event))


def _holds(jobs: list[_Job], plan: _Plan) -> bool:
    return any(job.part in plan.parts for job in jobs)


@contextlib.contextmanager
def _lock(cache: Path) -> Iterator[None]:
    """Keep other runs out of the cache; the lock goes with the process. Raises `OutputError` if another one has it."""
    cache.mkdir(parents=True, exist_ok=True)
    with (cache / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(f"{cache}: in use by another run of steelnb; wait for its end or stop it") from None
        yield


@contextlib.contextmanager
def _signals() -> Iterator[threading.Event]:
    """Turn SIGINT, SIGTERM and SIGHUP into an event, so that none of them can cut a rename in two.

    SIGINT is taken even where it was ignored, as it is in a script's background jobs; SIGHUP is not (nohup).
    """
    event, kept = threading.Event(), {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                kept[number] = signal.signal(number, lambda *_: event.set())
    try:
        yield event
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
