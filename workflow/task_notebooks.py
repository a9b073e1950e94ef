"""The tasks: each part of an experiment is executed, and its results are merged as soon as the last part is done.

Below ``.cache/workflow/<kind of run>/`` lie ``parts/<id>/<part>/``, results and notebook as executed, from which an
interrupted run resumes and the pages are made, and pytask's lock file.
"""

import os
import shutil
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import pytask

from workflow.execute import EXECUTED, REQUIRED, RUN_VARIABLE, kill_marked, locked, run_part, scratch_folder, stopped
from workflow.experiments import Experiment, Part, digest
from workflow.merge import digests, merge

LINE_PERIOD_S = 30.0


@dataclass
class Folder:
    """A result folder, whose state is the content of its files (of timing.csv only that it is there)."""

    name: str
    folder: Path
    attributes: dict[Any, Any] = field(default_factory=dict)

    @property
    def signature(self) -> str:
        return digest(self.name)

    def state(self) -> str | None:
        whole = all((self.folder / name).is_file() for name in REQUIRED)
        return digest(digests(self.folder), (self.folder / EXECUTED).is_file()) if whole else None

    def load(self, is_product: bool = False) -> Path:
        return self.folder

    def save(self, value: Any) -> None:
        raise NotImplementedError(f"{self.name}: written by its task")


class Value(pytask.PythonNode):
    """A value that a task depends on, told from others by its name."""

    @property
    def signature(self) -> str:
        return digest(self.name)


class Task(pytask.TaskWithoutPath):
    """A task whose own code is no part of its state: editing the workflow re-runs no notebook."""

    def state(self) -> str | None:
        return "1"


@dataclass(frozen=True)
class Plan:
    """An experiment, its parts in order, and the folder for their merged results."""

    experiment: Experiment
    budget: str
    parts: Sequence[Part]
    folder: Path


@dataclass
class Report:
    """Labels of the parts that were run, the result folders written, and the error of each task that failed."""

    ran: list[str] = field(default_factory=list)
    written: list[Path] = field(default_factory=list)
    failures: list[BaseException | None] = field(default_factory=list)


def part_folder(cache: Path, part: Part) -> Path:
    """Results of a part and its notebook as executed, below the cache of a kind of run."""
    return cache / "parts" / part.experiment.id / (part.name or "all")


def make_tasks(plans: Sequence[Plan], cache: Path, scratch: Path, mark: str, force: bool = False) -> list[Task]:
    """A task for each part, which runs in ``scratch``, and one for each experiment; with ``force``, none of them reads
    arrays of former runs."""
    tasks = []
    for plan in plans:
        stores = {}
        for part in plan.parts:
            store = stores[part.name or "all"] = Folder(f"part {part.label}", part_folder(cache, part))
            key = Value(name=f"key {part.label}", value=part.key(), hash=True)
            arrays = scratch / "arrays" if force else part.root / ".cache"
            run = partial(run_part, part, os.getpid(), mark, scratch, arrays)
            tasks.append(Task(name=part.label, function=run, depends_on={"key": key}, produces={"store": store}))
        about = {"experiment": plan.experiment.id, "notebook": plan.experiment.notebook, "budget": plan.budget}
        name = os.path.relpath(plan.folder, cache)
        given = Value(name=f"about {name}", value=about, hash=partial(digest, list(stores)))
        depends_on, produces = {"parts": stores, "about": given}, {"target": Folder(name, plan.folder)}
        tasks.append(Task(name=f"merge {name}", function=merge, depends_on=depends_on, produces=produces))
    return tasks


def run(plans: Sequence[Plan], cache: Path, jobs: int = 2, force: bool = False) -> Report:
    """Run what is out of date, two parts at once, and merge. Raises `OutputError` where another run is under way.

    SIGINT, SIGTERM and SIGHUP end all workers and kernels and raise SystemExit; files are whole whenever that happens.
    """
    name = f"{os.getpid()}-{time.time_ns()}"
    # Workers of a run that was killed remove its folder when they have ended, which may be after this one began.
    mark, scratch = f"{name}:", cache / f"scratch-{name}"
    with locked(cache), stopped(mark):
        for left in cache.glob("scratch-*"):
            shutil.rmtree(left, ignore_errors=True)
        scratch.mkdir()
        os.environ[RUN_VARIABLE] = mark
        try:
            return _build(make_tasks(plans, cache, scratch, mark, force), Events(plans, scratch), cache, jobs, force)
        finally:
            del os.environ[RUN_VARIABLE]
            kill_marked(mark)
            shutil.rmtree(scratch, ignore_errors=True)


def _build(tasks: Sequence[Task], events: "Events", cache: Path, jobs: int, force: bool) -> Report:
    """Hand the tasks to pytask, with its own output kept back."""
    # pytask's function for programs takes no plugins, its command line does: so the call is that of the command.
    from _pytask.cli import DEFAULTS_FROM_CLI

    manager = pytask.get_plugin_manager()
    pytask.storage.store(manager)
    manager.register(events)
    config = cache / "pyproject.toml"
    config.write_text("[tool.pytask.ini_options]\n", encoding="utf-8")
    settings = {"command": "build", "tasks": list(tasks), "paths": [], "config": config, "root": cache, "force": force}
    settings |= {"n_workers": jobs, "parallel_backend": "loky", "verbose": 0, "capture": "no", "disable_warnings": True}
    pytask.console.file = StringIO()
    with events.every_half_minute():
        session = pytask.build(**{**DEFAULTS_FROM_CLI, **settings})
    if session.exit_code != pytask.ExitCode.OK and not events.report.failures:
        raise RuntimeError(f"pytask: {session.exit_code}: {pytask.console.file.getvalue()}")
    return events.report


class Events:
    """A plugin for pytask: merges first, a line on stderr at every event and every half minute, and a report."""

    def __init__(self, plans: Sequence[Plan], scratch: Path) -> None:
        self.parts = [part.label for plan in plans for part in plan.parts]
        self.scratch, self.report = scratch, Report()
        self.done = 0
        self.begin_s: dict[str, float] = {}

    @pytask.hookimpl(tryfirst=True)
    def pytask_execute_build(self, session: pytask.Session) -> None:
        """Merges first, then parts in the order of the notebooks: later ones show runs of earlier ones again."""
        order = {name: -float(k) for k, name in enumerate(self.parts, start=1)}
        session.scheduler.priorities = {  # type: ignore[union-attr]
            task.signature: order.get(task.name, 1.0) for task in session.tasks
        }

    @pytask.hookimpl(tryfirst=True)
    def pytask_execute_task(self, task: Task) -> None:
        if task.name in self.parts:
            self.begin_s[task.name] = time.monotonic()
            self._tell(f"{task.name}: started")

    @pytask.hookimpl(tryfirst=True)
    def pytask_execute_task_log_end(self, report: pytask.ExecutionReport) -> None:
        name, begin_s = report.task.name, self.begin_s.pop(report.task.name, time.monotonic())
        self.done += name in self.parts
        if report.outcome == pytask.TaskOutcome.FAIL and report.exc_info:
            self.report.failures.append(report.exc_info[1])
            self._tell(f"{name}: failed: {report.exc_info[1]}")
        elif report.outcome == pytask.TaskOutcome.SUCCESS and name in self.parts:
            self.report.ran.append(name)
            self._tell(f"{name}: done in {time.monotonic() - begin_s:.0f} s")
        elif report.outcome == pytask.TaskOutcome.SUCCESS:
            self.report.written.append(report.task.produces["target"].folder)  # type: ignore

    def _tell(self, event: str) -> None:
        print(f"[{self.done}/{len(self.parts)}] {event}", file=sys.stderr, flush=True)

    @contextmanager
    def every_half_minute(self) -> Iterator[None]:
        """While this lasts, say how far the running notebooks have come."""
        ended = threading.Event()

        def tell() -> None:
            while not ended.wait(LINE_PERIOD_S):
                if running := [f"{name} {self._fraction(name):.0%}" for name in [*self.begin_s]]:
                    self._tell("running " + ", ".join(running))

        threading.Thread(target=tell, daemon=True).start()
        try:
            yield
        finally:
            ended.set()

    def _fraction(self, name: str) -> float:
        with suppress(OSError, ValueError):  # not written yet, or just being written
            return float((scratch_folder(self.scratch, name) / "progress").read_text())
        return 0.0
