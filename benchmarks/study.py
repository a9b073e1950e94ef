"""What a study of many runs costs beside plain calls, with one worker and two, and as it grows. Run by hand:

    OMP_NUM_THREADS=1 .venv/bin/python benchmarks/study.py > benchmarks/study.md

`--quick` does the same with a twentieth of the runs, to see that it works. Seconds belong to the machine named, which
should do nothing else; on another only the ratios hold.
"""

import itertools
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import psutil

from shared import command
from steelnb.report.results import machine
from steelnb.study.cluster import compute, connected
from steelnb.study.plan import Block, Run, by_flight, make_run
from steelnb.study.row import fly, run_on
from steelnb.study.table import ROWS, append_row, locked, write_tables

METHODS = ["average", "icp", "gicp", "best"]
FLIGHTS = 100_000
CLUSTER_CORES = 256


def main() -> None:
    quick = "--quick" in sys.argv
    few = make(["report-4cm"], METHODS, "1-2" if quick else "1-4", 10.0 if quick else 40.0)
    print(f"# A study of many runs\n\n{machine()}. `{command(__doc__)}`"
          f"{' --quick: a trial, no measurement' if quick else ''}\n")  # fmt: skip
    with memory() as peaks_one, cluster(1) as run_one:
        # In turn, so that both have the same share of whatever else the machine does.
        pairs = [(timed(lambda: plain(few)), timed(lambda: run_one(few))) for _ in range(1 if quick else 3)]
    one = statistics.median(study for _, study in pairs)
    with cluster(2) as run_two:
        two = statistics.median(timed(lambda: run_two(few)) for _ in pairs)
    overhead = statistics.median(study / calls - 1 for calls, study in pairs)
    print("| | measured | goal |\n|---|---|---|")
    print(f"| runs a minute, one worker | {60 * len(few) / one:.1f} | |")
    print(f"| runs a minute, two workers | {60 * len(few) / two:.1f}, {one / two:.2f} × | ≥ 1.8 × |")
    print(f"| one worker, over plain calls | {100 * overhead:+.1f} % | ≤ 5 % |", flush=True)

    sizes = (10, 100) if quick else (100, 2000)
    each = {}
    with memory() as peaks_many, cluster(2) as run_many:
        for size in sizes:
            many = make(["report-4cm"], ["icp", "icp-3dof", "best", "average"], f"1-{size // 4}", 5.0, ["zigzag"])
            begin = time.process_time()
            each[size] = timed(partial(run_many, many)) / len(many)
            own_s = (time.process_time() - begin) / len(many)  # of client and scheduler, which are this process
    print(f"| seconds a run, {sizes[0]} runs of 5 s | {each[sizes[0]]:.3f} | |")
    print(f"| seconds a run, {sizes[1]} runs of 5 s | {each[sizes[1]]:.3f}, "
          f"{each[sizes[1]] / each[sizes[0]]:.2f} × | ≤ 1.1 × |")  # fmt: skip
    large = make(["starling2"], ["best"], "1-2" if quick else "1-6", 20.0 if quick else 200.0, ["zigzag"])
    with memory() as peaks_large, cluster(2) as run_large:
        seconds = timed(lambda: run_large(large))
    for label, peaks in (
        (f"{len(few)} runs of {few[0].settings.flight.duration_s:g} s, sensor report-4cm", peaks_one),
        (f"{sum(sizes)} runs of 5 s, sensor report-4cm", peaks_many),
        (f"{len(large)} runs of {large[0].settings.flight.duration_s:g} s, sensor starling2", peaks_large),
    ):
        middle = len(peaks) // 2
        first, second = (max(some, default=0.0) for some in (peaks[:middle], peaks[middle:]))
        print(
            f"| memory of a worker (GB), {label}: first half, second half | {first:.2f}, {second:.2f} | ≤ 1.5, flat |"
        )

    flights = len(by_flight(few))
    per_flight = one / flights * 200.0 / few[0].settings.flight.duration_s
    per_large = 2 * seconds / len(large) * 200.0 / large[0].settings.flight.duration_s
    hours = {name: FLIGHTS * cost / 3600 for name, cost in (("report-4cm", per_flight), ("starling2", per_large))}
    print(f"""
Times are those of the calls, after every worker has imported and compiled what it needs. The runs by plain calls are
`fly` and `run_on` of `steelnb.study.row` in this process.

## {FLIGHTS:,} flights

A flight of 200 s with the sensor report-4cm and {len(few) // flights} runs on it ({", ".join(METHODS)} under two
noises) costs {per_flight:.0f} core seconds here, one with the sensor starling2 and `best` alone {per_large:.0f}:
{FLIGHTS:,} of them are {hours["report-4cm"]:,.0f} and {hours["starling2"]:,.0f} core hours, that is
{hours["report-4cm"] / CLUSTER_CORES:.0f} and {hours["starling2"] / CLUSTER_CORES:.0f} hours on a cluster of
{CLUSTER_CORES} such cores. Flights share nothing, and the process that started the study writes
about {row_bytes():.0f} kB a run, so more cores help until that process is busy all the time: it handles a run in
about {1e3 * own_s:.0f} ms, enough for {per_flight / (len(few) / flights) / own_s:,.0f} workers with
such runs.""")


def make(
    sensors: list[Any],
    methods: list[Any],
    seeds: str,
    duration_s: float,
    trajectories: Sequence[Any] = ("zigzag", "loops"),
) -> list[Run]:
    """The runs of a block, with two noises where there are two trajectories."""
    noises = ["random-walk", "constant-drift"][: len(trajectories)]
    block = Block.model_validate({
        "seeds": seeds, "trajectories": [*trajectories], "noises": noises, "sensors": sensors, "methods": methods,
        "duration_s": duration_s,
    })  # fmt: skip
    return [make_run(*each) for each in block.settings()]


@contextmanager
def cluster(workers: int) -> Iterator[Callable[[Sequence[Run]], None]]:
    """A function that runs some runs on a local cluster, each call with tables of its own; the workers are warm."""
    with tempfile.TemporaryDirectory() as scratch, connected(workers, None, workers) as client:
        client.wait_for_workers(workers)
        count = itertools.count()

        def run(runs: Sequence[Run]) -> None:
            folder, rows = Path(scratch, str(next(count))), {}
            with locked(folder):
                for each, found in compute(client, runs):
                    assert found["status"] == "ok", found["error"]
                    rows[each.key] = {**each.case, "key": each.key, **found}
                    append_row(folder, rows[each.key])
                write_tables(folder, runs, rows)

        for _ in range(2):  # a short flight for every worker, twice as they may share them unevenly
            run(make(["report-4cm"], METHODS, f"9001-{9000 + 2 * workers}", 3.0))
        yield run


def plain(runs: Sequence[Run]) -> None:
    """The same runs without Dask and without a store."""
    for flight in by_flight(runs):
        flown = fly(flight[0].settings)
        for run in flight:
            run_on(flown, run.settings)


def timed(call: Callable[[], Any]) -> float:
    """Seconds of a call."""
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


@contextmanager
def memory() -> Iterator[list[float]]:
    """The largest resident set of a child process (GB), sampled twice a second until the end."""
    samples: list[float] = []
    end = threading.Event()

    def watch() -> None:
        while not end.wait(0.5):
            sizes = []
            for child in psutil.Process().children(recursive=True):
                try:
                    sizes.append(child.memory_info().rss / 1e9)
                except psutil.Error:
                    continue
            samples.append(max(sizes, default=0.0))

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield samples
    finally:
        end.set()
        thread.join()


def row_bytes() -> float:
    """Kilobytes that are written of one run of 200 s."""
    run = make(["report-4cm"], ["icp"], "1-1", 200.0, ["zigzag"])[0]
    with tempfile.TemporaryDirectory() as folder, locked(Path(folder)):
        append_row(Path(folder), {**run.case, "key": run.key, **run_on(fly(run.settings), run.settings)})
        return Path(folder, ROWS).stat().st_size / 1e3


if __name__ == "__main__":
    main()
