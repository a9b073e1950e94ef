"""Runs of a study on a Dask cluster, of this machine or of the user's.

The graph has a task for each flight and, depending on it, a task for each run: Dask simulates a flight once, keeps it
until its last run, and simulates it again if its worker dies. Rows come back to this process, which alone writes them.
"""

import contextlib
import logging
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from steelnb.errors import InputError
from steelnb.settings import ExperimentSettings
from steelnb.study.plan import Run, by_flight, software_digest
from steelnb.study.row import FAILED, OK, Flown, fly, run_on
from steelnb.study.table import Row, append_row, locked, stored_rows, write_tables

if TYPE_CHECKING:
    from distributed import Client

ANSWER_S = 10.0
"""Time for a scheduler to answer, and then to have a worker."""
FRAME_S = 0.01
"""Seconds a frame where no run is known: the mean of results/study/timing.parquet."""


def run_study(
    runs: Sequence[Run],
    folder: Path,
    workers: int | None = None,
    scheduler: str | None = None,
    machine: str = "",
    on_row: Callable[[Row], None] | None = None,
) -> list[Row]:
    """Run what ``folder`` does not hold yet, or holds as failed, and write its tables; gives the rows that failed now.

    Parameters
    ----------
    runs : from `read_plan`.
    folder : place of the tables, see `steelnb.study.table`.
    workers : processes of one thread each on this machine, by default one a core.
    scheduler : address of a Dask cluster of the user's, instead of ``workers``; see `connected`.
    machine : description of the processor, noted beside the measured times.
    on_row : called with the row of each run that has ended.

    Raises `InputError`, for a damaged table too, and `OutputError`. What had ended
    before is stored then, and the next call goes on from there.
    """
    failed: list[Row] = []
    with locked(folder):
        rows = stored_rows(folder)
        missing = [run for run in runs if rows.get(run.key, {}).get("status") != OK]
        if missing:
            with connected(workers, scheduler, len(by_flight(missing))) as client:
                for run, found in compute(client, missing):
                    row = {**run.case, "key": run.key, **found, "machine": machine}
                    append_row(folder, row)
                    rows[run.key] = row
                    if row["status"] == FAILED:
                        failed.append(row)
                    if on_row:
                        on_row(row)
        write_tables(folder, runs, rows)
    return failed


def forecast(runs: Sequence[Run], folder: Path) -> tuple[int, float]:
    """Number of runs that ``folder`` holds, and core seconds that the others take: by runs of the same sensor and
    method, else by a rule of thumb. Nothing is run or written. Raises `InputError`."""
    rows = stored_rows(folder)
    done = {run.key: rows[run.key] for run in runs if rows.get(run.key, {}).get("status") == OK}
    rates = defaultdict(list)
    for row in done.values():
        rates[row["sensor"], row["method"]].append(row.get("seconds", np.nan) / row["duration_s"])
    core_s = 0.0
    for run in runs:
        if run.key not in done:
            rule = [FRAME_S * run.settings.tof.rate_hz]
            known = rates.get((run.case["sensor"], run.case["method"]), rule)
            core_s += run.case["duration_s"] * float(np.nanmedian(known))
    return len(done), core_s


def compute(client: "Client", runs: Sequence[Run]) -> Iterator[tuple[Run, Row]]:
    """Rows of some runs as they end. Raises `InputError` if the scheduler is lost meanwhile."""
    from distributed import CancelledError, as_completed

    flights, software = by_flight(runs), software_digest()
    keyed = {f"run-{run.key}": run for flight in flights for run in flight}
    try:
        flown = client.map(
            _fly, [flight[0].settings for flight in flights], [software] * len(flights),
            key=[f"fly-{flight[0].flight}" for flight in flights], batch_size=1000,
        )  # fmt: skip
        # Runs go before new flights, so that a worker holds few of these.
        futures = client.map(
            run_on, [future for future, flight in zip(flown, flights, strict=True) for _ in flight],
            [run.settings for run in keyed.values()], key=[*keyed], priority=1, batch_size=1000,
        )  # fmt: skip
        ended = as_completed(futures)
        del flown, futures  # what is referred to here stays in the memory of the workers
        for future in ended:
            # A result stays with its worker until it is asked for, and is lost, even while asked for, if that dies.
            found = client.gather([future], errors="skip")
            if found:
                yield keyed[future.key], found[0]
            elif future.status == "error":  # `run_on` raises nothing: the workers that tried it died
                name = type(future.exception()).__name__
                yield keyed[future.key], {"status": FAILED, "error": f"{name}: the workers that tried it died"}
            else:
                raise CancelledError(future.key)
    except (CancelledError, OSError) as fault:
        raise InputError(
            f"the scheduler went away ({type(fault).__name__}); what had ended is stored, and the next call goes on"
        ) from None


def _fly(settings: ExperimentSettings, software: str) -> Flown | str:
    """`fly`, if the worker has the code and the libraries that the keys of the runs stand for."""
    if software_digest() != software:
        return "the worker has another version of steelnb or of a library than the process that started the study"
    return fly(settings)


@contextlib.contextmanager
def connected(workers: int | None, scheduler: str | None, flights: int) -> "Iterator[Client]":
    """Client of a cluster on this machine, which ends with it, or of the user's at the address ``scheduler``.

    Dask executes what it is sent, so whoever can talk to a scheduler or a worker can run code as its owner. The cluster
    on this machine therefore talks over TLS alone, with a certificate that only its processes hold, in memory. One at
    tcp://HOST:PORT is as open as its network; for tls://HOST:PORT, Dask's settings ``distributed.comm.tls`` name the
    certificates.

    No more local workers are started than there are ``flights``. Raises `InputError`.
    """
    if workers is not None and workers < 1:
        raise InputError(f"workers = {workers}: expected at least 1")
    if workers is not None and scheduler is not None:
        raise InputError(f"workers = {workers}: a cluster has the workers that it has; leave out one of the two")
    import cryptography as _  # noqa: F401 for the certificate
    import dask.system
    from distributed import Client, LocalCluster
    from distributed.security import Security

    # Faults are told here, in one line; Dask's own words would come from every process.
    for name in ("distributed", "distributed.client", "distributed.nanny", "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    options = {
        # Dask's own value has malloc give memory back at once, which costs 8 % more processor time.
        "distributed.nanny.pre-spawn-environ": {**threads, "DASK_LOGGING__DISTRIBUTED": "critical"},
        "distributed.worker.profile.enabled": False,
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
    }
    with dask.config.set(options), contextlib.ExitStack() as stack:
        if scheduler is None:
            cluster = LocalCluster(
                n_workers=max(1, min(workers or dask.system.CPU_COUNT, flights)), threads_per_worker=1, processes=True,
                host="127.0.0.1", protocol="tls://", security=Security.temporary(),
                dashboard_address=None, worker_dashboard_address=None,
                scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
                local_directory=stack.enter_context(tempfile.TemporaryDirectory(prefix="steelnb-study-")),
            )  # fmt: skip
            client = stack.enter_context(Client(stack.enter_context(cluster)))
        else:
            try:
                client = stack.enter_context(Client(scheduler, timeout=ANSWER_S))
            except (OSError, ValueError, TypeError, ImportError) as fault:
                reason = " ".join(str(fault).split())[:200]
                raise InputError(
                    f"scheduler {scheduler}: no answer ({reason}); expected a Dask scheduler, e.g. tcp://HOST:8786"
                ) from None
        try:
            client.wait_for_workers(1, timeout=ANSWER_S)
        except TimeoutError:
            raise InputError(
                f"scheduler {scheduler or 'of this machine'}: no worker within {ANSWER_S:g} s; start at least one"
            ) from None
        yield client
