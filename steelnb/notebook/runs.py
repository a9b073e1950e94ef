"""The engine that runs experiments: flights are simulated once for equal worlds, in this process, on the cores of a
machine, or on a cluster.

Notebooks call `run_all` for the results themselves, the study (`steelnb.notebook.study`) for rows of a table, and the
panel of notebook 00 keeps a flight in `Flights`.
"""

from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any, TypeVar

from joblib import Parallel, delayed

from steelnb import experiment
from steelnb.core.cache import SOURCES
from steelnb.core.errors import InputError
from steelnb.core.types import Array, Flight
from steelnb.odometry import shared_segments
from steelnb.settings import ExperimentSettings
from steelnb.simulation import Tower, Truth, build_tower, fly
from steelnb.simulation.drift import drifting

T = TypeVar("T")


class Flights:
    """Simulated flights; the last one is kept, for other drifts and methods in the same world."""

    def __init__(self) -> None:
        self._world: object = None
        self._flown: tuple[Flight, Truth] | None = None

    def __call__(
        self, settings: ExperimentSettings, on_progress: experiment.OnProgress | None = None
    ) -> tuple[Flight, Truth]:
        """The flight of the settings with their drift, and the truth. Raises `CollisionError`."""
        world = experiment.world(settings)
        if self._flown is None or world != self._world:
            self._flown = experiment.simulate(settings, on_progress)
            self._world = world
        flight, truth = self._flown
        return experiment.redrift(settings, flight, truth), truth


Task = Callable[[ExperimentSettings, Flights, experiment.OnProgress | None], T]
"""What is computed for one run: called with its settings, the flights and a callback for progress, it returns a result
or a row."""


def result_of(
    settings: ExperimentSettings, flights: Flights, on_progress: experiment.OnProgress | None = None
) -> experiment.Result:
    """The result of a run: the task of `run_all` if no other is given."""
    return experiment.estimate(settings, *flights(settings), on_progress)


def run_all(
    cases: Iterable[ExperimentSettings],
    on_progress: experiment.OnProgress | None = None,
    task: Task[Any] = result_of,
    jobs: int | None = 1,
    timed: bool = False,
) -> list[Any]:
    """Run the ``task`` for each case, and return what it returns, in order: by default, `experiment.Result`.

    Equal cases run once and share their result. Cases in one world share a flight, and their odometries the segments of
    its scans; if ``timed``, each finds its own, so that its time is its own. ``jobs``: number of worlds at once, -1 for
    one per core, None for that of `joblib.parallel_config`. ``on_progress`` is called after each world and, with one
    job, also during it.
    Raises `CollisionError`, and `InputError` without a case or a job, or if a worker has other code or libraries than
    this process.
    """
    given = [(case.model_dump_json(), case) for case in cases]
    number = {key: k for k, key in enumerate(dict(given))}
    cases = list(dict(given).values())
    worlds: dict[object, list[int]] = {}
    for k, case in enumerate(cases):
        worlds.setdefault(experiment.world(case), []).append(k)
    if not worlds or jobs == 0:
        raise InputError(
            f"{len(worlds)} flights, jobs = {jobs}: expected at least one of each; jobs = -1: one per core"
        )
    jobs = jobs if jobs is None else min(jobs, len(worlds))
    found: dict[int, Any] = {}

    def within(share: float) -> None:
        if on_progress:
            on_progress((len(found) + share) / len(cases))

    tell = within if jobs == 1 else None
    work = (
        delayed(_in_one_world)([cases[k] for k in members], task, timed, SOURCES, tell) for members in worlds.values()
    )
    made = Parallel(n_jobs=jobs, batch_size=1, pre_dispatch="n_jobs", return_as="generator")(work)
    for members, results in zip(worlds.values(), made, strict=True):
        found.update(zip(members, results, strict=True))
        within(0.0)
    return [found[number[key]] for key, _ in given]


def _in_one_world(
    cases: Sequence[ExperimentSettings], task: Task[T], timed: bool, sources: str, tell: experiment.OnProgress | None
) -> list[T]:
    """Results of the task for cases in one world. ``sources``: of the process that started this one."""
    if sources != SOURCES:
        raise InputError("a worker has another version of steelnb or of a library than the process that started it")
    flights, found = Flights(), []
    with nullcontext() if timed else shared_segments():
        for done, case in enumerate(cases):
            found.append(task(case, flights, tell and partial(_told, tell, done)))
    return found


def _told(tell: experiment.OnProgress, done: int, share: float) -> None:
    tell(done + share)


def flight_paths(settings: ExperimentSettings) -> tuple[Tower, dict[str, Array]]:
    """The tower, and the positions ``(N, 3)`` of a flight past it: the true ones (``truth``) and the drifting ones
    (``none``). No scans are simulated. Raises `CollisionError`."""
    tower = build_tower(settings.tower)
    truth, _ = fly(tower, settings.flight, settings.seed)
    return tower, {"truth": truth.position, "none": drifting(truth, settings.noise, settings.seed).position}
