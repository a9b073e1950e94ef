"""The runs of a study as a Dask graph, on this machine or on a cluster, written as they come in.

The graph has a task a flight and, depending on it, a task a run: a flight and its scans are made once, stay in the
memory of the worker that made them, and are forgotten there with their last run. If that worker dies, Dask makes the
flight again elsewhere. The rows come back to this process, which alone writes: a cluster need not share a folder, and a
killed worker costs the run that it was at. Flights are handed out as others end, one more than there are workers: so a
worker has its next flight waiting and seldom two in memory, and the scheduler's load does not grow with the study.
"""

import contextlib
import logging
import queue
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from steelnb.config import ExperimentSettings
from steelnb.errors import SchedulerError, SettingsError
from steelnb.study.cost import Costs
from steelnb.study.plan import Run, by_flight, code_digest
from steelnb.study.row import FAILED, Fault, Flown, failed, fly, run_on
from steelnb.study.store import Store

if TYPE_CHECKING:
    from distributed import Client, Future

PERIOD_S = 0.5
ANSWER_S = 10.0
"""How long a scheduler may take to answer, and then to have a worker."""
FETCH_S = 2.0
"""How long to wait for a row that a worker has, before other rows have their turn."""


@dataclass(frozen=True)
class Advance:
    """How far a study has come: runs done (``failed`` of them), runs in all, workers now, ``fraction`` 0 to 1 of the
    expected time, seconds left (None if unknown), and ``event``, a line where something has just happened."""

    done: int
    failed: int
    total: int
    workers: int
    fraction: float
    remaining_s: float | None
    event: str = ""


OnAdvance = Callable[[Advance], None]


def fly_task(settings: ExperimentSettings, code: str) -> Flown | Fault:
    """`fly` on a worker that has the code that the runs' keys are of."""
    if code_digest() != code:
        return Fault("the worker has another version of steelnb than the one that started the study")
    return fly(settings)


def run_study(
    runs: Sequence[Run],
    store: Store,
    machine: str = "",
    workers: int | None = None,
    scheduler: str | None = None,
    on_advance: OnAdvance | None = None,
) -> list[dict[str, Any]]:
    """Run what is not in the store yet, and add every run to it as it ends; gives the rows of those that failed.

    A local cluster of ``workers`` processes (default: one a core) with one thread each, or the one at the address
    ``scheduler``. ``machine`` is noted beside the times. Raises `SchedulerError`, and `OutputError` if a row cannot be
    written.
    """
    done = store.done()
    missing = [run for run in runs if run.key not in done]
    if not missing:
        return []
    with connected(workers, scheduler, len(by_flight(missing))) as client:
        return Study(client, missing, store, machine, on_advance).run()


class Study:
    """Some runs on the workers of a client, none of them in the store yet; see `run_study`."""

    def __init__(
        self,
        client: "Client",
        runs: Sequence[Run],
        store: Store,
        machine: str = "",
        on_advance: OnAdvance | None = None,
    ) -> None:
        self.client, self.store, self.machine = client, store, machine
        self.on_advance = on_advance or (lambda advance: None)
        self.waiting = deque(by_flight(runs))
        self.left = {flight[0].flight: len(flight) for flight in self.waiting}
        self.landed: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self.open: dict[Any, tuple[Future, Run]] = {}
        costs = Costs(store.rows)
        self.expected_s = {
            run.key: costs.run_s(run) + costs.flight_s(run) / len(flight) for flight in self.waiting for run in flight
        }
        self.total, self.total_s = len(runs), sum(self.expected_s.values())
        self.done_s, self.done, self.failed = 0.0, 0, list[dict[str, Any]]()
        self.first_s, self.first_done_s = 0.0, 0.0
        self._counted, self._counted_s = 0, -PERIOD_S

    def run(self) -> list[dict[str, Any]]:
        """Run them all; gives the rows of those that failed."""
        flying = 0
        while self.waiting or self.open:
            workers = self._workers()
            while self.waiting and flying <= max(workers, 1):
                self._submit(self.waiting.popleft())
                flying += 1
            self._tell(workers)
            batch = self._landed()
            for run, row in batch:
                self.left[run.flight] -= 1
                flying -= self.left[run.flight] == 0
                self._count(run, row, workers)
            if batch and not self.first_done_s:
                self.first_s, self.first_done_s = time.monotonic(), self.done_s
        return self.failed

    def _workers(self) -> int:
        """How many workers there are; they come and go."""
        if time.monotonic() - self._counted_s >= PERIOD_S:
            with _lost("in the middle of the study", self.done):
                self._counted = len(self.client.scheduler_info(n_workers=-1)["workers"])
            self._counted_s = time.monotonic()
        return self._counted

    def _submit(self, flight: list[Run]) -> None:
        """A task for the flight, and one for each run on it; results of an earlier attempt are not asked for."""
        attempt = f"{time.time_ns():x}"
        with _lost("while it was given work", self.done):
            flown = self.client.submit(
                fly_task, flight[0].settings, code_digest(), key=f"flight-{flight[0].flight}-{attempt}", pure=False
            )
            for run in flight:
                future = self.client.submit(run_on, flown, run.settings, key=f"run-{run.key}-{attempt}", pure=False)
                self.open[future.key] = future, run
                future.add_done_callback(self.landed.put)

    def _landed(self) -> list[tuple[Run, dict[str, Any]]]:
        """The runs that have ended, already in the store; none if nothing ends in a while."""
        futures: list[Future] = []
        with contextlib.suppress(queue.Empty):
            futures.append(self.landed.get(timeout=PERIOD_S))
            while True:
                futures.append(self.landed.get_nowait())
        if self.client.status != "running":
            raise SchedulerError(_away("in the middle of the study", self.done))
        if not futures:
            return []
        with _lost("in the middle of the study", self.done):
            found = [pair for pair in map(self._row, futures) if pair]
        if found:
            self.store.add([row for _, row in found])
        return found

    def _row(self, future: "Future") -> tuple[Run, dict[str, Any]] | None:
        """The row of a run that has ended; None if its worker died with it, so that it is being run again."""
        try:
            if future.status == "error":
                # A run that raises gives a row of its own; this is Dask's word that its workers died, again and again.
                fault = type(future.exception(timeout=FETCH_S)).__name__
                row = failed(f"{fault}: the workers that tried it died")
            else:
                row = future.result(timeout=FETCH_S)
        except TimeoutError:
            future.add_done_callback(self.landed.put)
            return None
        _, run = self.open.pop(future.key)
        return run, {**run.case, "key": run.key, **row, "machine": self.machine}

    def _count(self, run: Run, row: dict[str, Any], workers: int) -> None:
        self.done += 1
        self.done_s += self.expected_s[run.key]
        if row["status"] == FAILED:
            self.failed.append(row)
            self._tell(workers, f"{run.label}: failed: {row['error'].splitlines()[-1]}")

    def _tell(self, workers: int, event: str = "") -> None:
        left_s, since_s = self.total_s - self.done_s, self.done_s - self.first_done_s
        # Counted from the first runs on, which come late, after imports and compilation; until a few more have ended,
        # what is expected is the better guess.
        pace = 1 / max(workers, 1)
        if self.first_done_s and since_s > 0.02 * self.total_s:
            pace = (time.monotonic() - self.first_s) / since_s
        remaining_s = left_s * pace if workers else None
        fraction = self.done_s / self.total_s
        self.on_advance(Advance(self.done, len(self.failed), self.total, workers, fraction, remaining_s, event))


@contextlib.contextmanager
def connected(workers: int | None, scheduler: str | None, flights: int) -> "Iterator[Client]":
    """A client of the cluster at an address, or of one of this machine's own, which ends with it.

    No more local workers than ``flights``: one flight is one worker's. Raises `SchedulerError` or `SettingsError`.
    """
    if workers is not None and scheduler is not None:
        raise SettingsError(f"workers = {workers}: a cluster has the workers that it has; leave out one of the two")
    import dask
    from distributed import Client, LocalCluster

    # What Dask has to tell is told here, in one line; its own words would come from every process.
    for name in ("distributed", "distributed.client", "distributed.nanny", "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    # Left out: Dask tells malloc to give memory back at once, which costs runs with small scans 8 % more processor time
    # in page faults, and samples the stack a hundred times a second.
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    chosen = {
        "distributed.nanny.pre-spawn-environ": {**threads, "DASK_LOGGING__DISTRIBUTED": "critical"},
        "distributed.worker.profile.enabled": False,
        "distributed.comm.timeouts.connect": f"{ANSWER_S:g}s",
    }
    with dask.config.set(chosen), contextlib.ExitStack() as stack:
        if scheduler is None:
            cluster = LocalCluster(
                n_workers=local_workers(workers, flights), threads_per_worker=1, processes=True,
                host="127.0.0.1", dashboard_address=None, worker_dashboard_address=None,
                # Without a dashboard there still is a page of health, for which any free port will do.
                scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
            )  # fmt: skip
            client = stack.enter_context(Client(stack.enter_context(cluster)))
        else:
            try:
                client = stack.enter_context(Client(scheduler, timeout=ANSWER_S))
            except (OSError, ValueError, ImportError) as fault:
                reason = " ".join(str(fault).split())[:200]
                raise SchedulerError(
                    f"scheduler {scheduler}: no answer ({reason}); expected a Dask scheduler, e.g. tcp://HOST:8786"
                ) from None
        try:
            client.wait_for_workers(1, timeout=ANSWER_S)
        except TimeoutError:
            where = scheduler or "of this machine"
            raise SchedulerError(f"scheduler {where}: no worker within {ANSWER_S:g} s; start at least one") from None
        yield client


def local_workers(workers: int | None, flights: int) -> int:
    """How many workers a cluster of this machine's own has: one a core, if not told. Raises `SettingsError`."""
    import dask.system

    if workers is not None and workers < 1:
        raise SettingsError(f"workers = {workers}: expected at least 1")
    return max(1, min(workers or dask.system.CPU_COUNT, flights))


@contextlib.contextmanager
def _lost(when: str, done: int) -> Iterator[None]:
    """Turn what Dask raises once its scheduler is gone into a `SchedulerError`."""
    import concurrent.futures

    from distributed.comm.core import CommClosedError

    try:
        yield
    except (CommClosedError, concurrent.futures.CancelledError, TimeoutError, OSError, RuntimeError) as fault:
        raise SchedulerError(_away(f"{when} ({type(fault).__name__})", done)) from None


def _away(when: str, done: int) -> str:
    return f"the scheduler went away {when}; {done} runs of this call are stored, and the next call goes on from there"
