"""Run the notebooks, each in a process of its own, keep what is up to date, and compare with what is committed.

Below ``.cache/reproduce/`` of the project lie, for each kind of run (full, smoke, custom, check): ``parts/``, the
results of every part with the key they belong to, from which an interrupted run resumes; ``notebooks/`` as executed, to
read a failure in; and ``written.json``, the digests of what was put into the result folders.
"""

import contextlib
import importlib.util
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
from steelnb.errors import NotebookError, OutputError, SettingsError
from steelnb.project import RESULT_FOLDERS, Experiment, Part, Project
from steelnb.results import (
    PROGRESS_VARIABLE,
    Difference,
    Progress,
    committed_text,
    compare,
    digests,
    merge,
    write_results,
)

__all__ = ["Progress", "Report", "State", "Status", "check", "run", "states", "write_results"]

TICK_S = 0.1
RUN_VARIABLE = "STEELNB_RUN"
COMPARED = ("metrics.json", "table.csv")


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
    """Run the notebooks of the experiments named (default: all) and leave ``<output>/<id>/`` for each.

    ``output`` is by default ``results`` or, for the budget smoke, ``results-smoke`` in the project; ``parameters`` (name
    → value, dotted names for single settings) want an output of their own. Everything is checked before a notebook
    starts. Parts and folders that are up to date are left alone unless ``force``. Raises `SteelnbError`; notebooks that
    raise end in `NotebooksFailedError` after the others are done; KeyboardInterrupt on SIGINT, SIGTERM and SIGHUP.
    """
    project, given = Project(root), dict(parameters or {})
    parts = [(experiment, project.parts(experiment, budget, given)) for experiment in project.select(ids)]
    folder = project.output_folder(budget, given, output)
    plans = [_Plan(experiment, budget, some, folder / experiment.id) for experiment, some in parts]
    return _Runner(project, "custom" if given else budget, jobs, on_progress).run(plans, force)


def check(
    ids: Iterable[str] = (),
    budget: str = "full",
    jobs: int = 2,
    *,
    on_progress: OnProgress | None = None,
    root: Path | None = None,
) -> CheckReport:
    """Run the experiments again into a scratch folder, reading no cache, and compare with what is committed.

    Without git, or where nothing is committed, the files in the result folder are compared. Raises `FileMissingError`
    where there are none, before a notebook starts, and what `run` raises.
    """
    project = Project(root)
    scratch = project.cache / "check"
    plans = [
        _Plan(experiment, budget, project.parts(experiment, budget), scratch / experiment.id)
        for experiment in project.select(ids)
    ]
    committed = {
        plan.folder: {
            name: committed_text(project.root, f"{RESULT_FOLDERS[budget]}/{plan.experiment.id}/{name}")
            for name in COMPARED
        }
        for plan in plans
    }
    _Runner(project, "check", jobs, on_progress).run(plans, force=True)
    differences: list[Difference] = []
    for folder, before in committed.items():
        now = {name: (folder / name).read_text(encoding="utf-8") for name in COMPARED}
        differences += compare(folder.name, before, now, project.check)
    metrics = sum(len(json.loads(before["metrics.json"])) for before in committed.values())
    return CheckReport(differences, metrics, len(plans), scratch)


def states(root: Path | None = None) -> list[State]:
    """The state of the full results of every experiment. Raises `SteelnbError`."""
    project = Project(root)
    runner, found = _Runner(project, "full", 1, None), []
    for experiment in project.select():
        folder = project.root / RESULT_FOLDERS["full"] / experiment.id
        plan = _Plan(experiment, "full", project.parts(experiment, "full"), folder)
        never = runner.name(folder) not in runner.written
        state = "never run" if never else "up to date" if runner.is_current(plan) else "out of date"
        found.append(State(experiment, len(plan.parts), state))
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
    """A part that a worker process is running, in a scratch folder of its own."""

    part: Part
    folder: Path
    process: subprocess.Popen[bytes]
    started_s: float
    fraction: float = 0.0


class _Runner:
    """Runs the parts of some plans, a few at once. ``slot`` is the kind of run, which has a cache of its own."""

    def __init__(self, project: Project, slot: str, jobs: int, on_progress: OnProgress | None) -> None:
        if jobs < 1:
            raise SettingsError(f"jobs = {jobs}: expected at least 1")
        self.project, self.slot, self.jobs = project, slot, jobs
        self.on_progress = on_progress or (lambda status: None)
        self.written = _read_json(project.cache / "written.json")
        self.mark = f"{os.getpid()}-{time.time_ns()}"
        self.scratch = project.cache / "scratch" / self.mark
        self.running: list[_Job] = []
        self.failures: dict[str, tuple[str, bool]] = {}
        self.seconds: dict[str, float] = {}  # of each part: measured, else as far as known from earlier

    def name(self, folder: Path) -> str:
        """A result folder relative to the project, so that a clone can be moved."""
        return os.path.relpath(folder, self.project.root)

    def store(self, part: Part) -> Path:
        """Where the results of a part lie, with a record of their key and of the seconds they took."""
        return self.project.cache / "parts" / self.slot / part.experiment / (part.name or "all")

    def is_done(self, part: Part) -> bool:
        return bool(_read_json(self.store(part) / "record.json").get("key") == part.key)

    def is_current(self, plan: _Plan) -> bool:
        return bool(self.written.get(self.name(plan.folder)) == self._describe(plan))

    def _describe(self, plan: _Plan) -> dict[str, Any]:
        return {"keys": [part.key for part in plan.parts], "files": digests(plan.folder)}

    def run(self, plans: list[_Plan], force: bool) -> Report:
        """Run what is not up to date, longest first, and merge each experiment as soon as its last part is done."""
        if not force and all(self.is_current(plan) and all(map(self.is_done, plan.parts)) for plan in plans):
            return Report([], [part.label for plan in plans for part in plan.parts], [])
        try:
            with _lock(self.project.cache), _signals() as interrupted:
                return self._run(plans, force, interrupted)
        except OSError as fault:
            raise OutputError(f"{fault.filename or self.project.cache}: {fault.strerror or fault}") from None

    def _run(self, plans: list[_Plan], force: bool, interrupted: threading.Event) -> Report:
        shutil.rmtree(self.scratch.parent, ignore_errors=True)  # of a run that was killed
        self.written = _read_json(self.project.cache / "written.json")
        parts = [part for plan in plans for part in plan.parts]
        waiting = [part for part in parts if force or not self.is_done(part)]
        ran, written = [part.label for part in waiting], []
        for plan in plans:
            for part in plan.parts:
                known = _read_json(self.store(part) / "record.json").get("seconds", plan.experiment.expected_s)
                self.seconds.update({part.label: known} if known else {})
        waiting.sort(key=lambda part: -self.seconds.get(part.label, math.inf))
        unmerged = list(plans)
        try:
            while True:
                while waiting and len(self.running) < self.jobs:
                    self._start(waiting.pop(0))
                    self._tell(waiting, ran, f"{self.running[-1].part.label}: started")
                for job in [job for job in self.running if job.process.poll() is not None]:
                    self.running.remove(job)
                    self._tell(waiting, ran, self._finish(job))
                busy = {part.experiment for part in (*waiting, *(job.part for job in self.running))}
                for plan in [plan for plan in unmerged if plan.experiment.id not in busy]:
                    unmerged.remove(plan)
                    failed = any(part.label in self.failures for part in plan.parts)
                    if not failed and (force or not self.is_current(plan)):
                        self._merge(plan)
                        written.append(plan.folder)
                if not unmerged:
                    break
                if interrupted.is_set():
                    raise KeyboardInterrupt
                time.sleep(TICK_S)
                self._tell(waiting, ran, "")
        finally:
            self._stop()
        if self.failures:
            lines, bad_inputs = zip(*self.failures.values(), strict=True)
            raise NotebooksFailedError(lines, 2 if all(bad_inputs) else 1)
        return Report(ran, [part.label for part in parts if part.label not in ran], written)

    def _start(self, part: Part) -> None:
        folder = self.scratch / f"{time.monotonic_ns()}"
        (folder / "part").mkdir(parents=True)
        job = {
            "parent": os.getpid(),
            "mark": f"{self.mark}:{folder.name}:",
            "notebook": str(part.notebook),
            "parameters": {**part.parameters, "results_dir": str(folder / "part" / "output")},
        }
        (folder / "job.json").write_text(json.dumps(job), encoding="utf-8")
        with (folder / "log.txt").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "steelnb.reproduce", str(folder)],
                env=_environment(folder, job["mark"]),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,  # a Ctrl-C reaches this process alone, which then ends the others
            )
        self.running.append(_Job(part, folder, process, time.monotonic()))

    def _finish(self, job: _Job) -> str:
        """Keep what a worker that has ended leaves; gives the line that says so."""
        part, seconds = job.part, time.monotonic() - job.started_s
        kill_marked(f"{self.mark}:{job.folder.name}:")  # a worker that died has left its kernel behind
        executed = self.project.cache / "notebooks" / self.slot / part.experiment / f"{part.name or 'all'}.ipynb"
        with contextlib.suppress(FileNotFoundError):
            executed.parent.mkdir(parents=True, exist_ok=True)
            os.replace(job.folder / "executed.ipynb", executed)
        outcome = _read_json(job.folder / "outcome.json")
        missing = [name for name in REQUIRED if not (job.folder / "part" / "output" / name).is_file()]
        if not outcome:
            log = (job.folder / "log.txt").read_text(encoding="utf-8", errors="replace").split("\n")
            last = next((line for line in reversed(log) if line.strip()), "")
            outcome = {"error": "WorkerDied", "message": f"exit code {job.process.returncode} {last}"}
        elif not outcome["error"] and missing:
            outcome = {"error": "NoResults", "message": f"{', '.join(missing)} not written; expected write_results"}
        if outcome["error"]:
            message = " ".join(f"{outcome['error']}: {outcome['message']}".split())[:300]
            bad_input = issubclass(getattr(steelnb.errors, outcome["error"], Exception), steelnb.errors.SteelnbError)
            self.failures[part.label] = (f"{part.label}: {message} (see {executed})", bad_input)
            return f"{part.label}: failed"
        self.seconds[part.label] = seconds
        _write_json(job.folder / "part" / "record.json", {"key": part.key, "seconds": round(seconds, 3)})
        shutil.rmtree(self.store(part), ignore_errors=True)
        self.store(part).parent.mkdir(parents=True, exist_ok=True)
        os.replace(job.folder / "part", self.store(part))
        return f"{part.label}: done in {seconds:.0f} s"

    def _merge(self, plan: _Plan) -> None:
        experiment = plan.experiment
        about = {"experiment": experiment.id, "notebook": experiment.notebook, "budget": plan.budget}
        merge({part.name: self.store(part) / "output" for part in plan.parts}, plan.folder, about)
        self.written[self.name(plan.folder)] = self._describe(plan)
        _write_json(self.project.cache / "written.json", self.written)

    def _tell(self, waiting: list[Part], ran: list[str], event: str) -> None:
        """Report fraction and time left, from each part's own fraction and from what it took earlier."""
        now_s = time.monotonic()
        total_s = dict.fromkeys(ran, math.nan) | {label: self.seconds[label] for label in ran if label in self.seconds}
        left_s = {part.label: total_s[part.label] for part in waiting}
        for job in self.running:
            label, elapsed_s = job.part.label, now_s - job.started_s
            with contextlib.suppress(OSError, ValueError):
                job.fraction = max(job.fraction, float((job.folder / "progress").read_text()))
            if job.fraction > 0.05:
                total_s[label] = elapsed_s / job.fraction
            left_s[label] = max(total_s[label] - elapsed_s, 0.0) if total_s[label] == total_s[label] else math.nan
        known = [seconds for seconds in total_s.values() if not math.isnan(seconds)]
        mean_s = sum(known) / len(known) if known else math.nan
        left = {label: mean_s if math.isnan(seconds) else seconds for label, seconds in left_s.items()}
        remaining_s = max(sum(left.values()) / self.jobs, max(left.values(), default=0.0))
        whole = sum(mean_s if math.isnan(seconds) else seconds for seconds in total_s.values())
        done = len(ran) - len(left_s)
        by_count = (done + sum(job.fraction for job in self.running)) / max(len(ran), 1)
        fraction = 1 - sum(left.values()) / whole if whole > 0 else by_count
        labels = tuple(job.part.label for job in self.running)
        self.on_progress(
            Status(done, len(ran), labels, fraction, None if math.isnan(remaining_s) else remaining_s, event)
        )

    def _stop(self) -> None:
        """End every process this run has started, and remove their scratch folders."""
        for job in self.running:
            job.process.kill()
            job.process.wait()
        kill_marked(f"{self.mark}:")
        shutil.rmtree(self.scratch, ignore_errors=True)
