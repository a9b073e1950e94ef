"""One pytask task per part: its notebook writes to a new folder, which is renamed when it is done.

Two run at once. Threads suffice, since each notebook has its own kernel process. The output of each part is kept in
``.cache/workflow/<output folder>/<id>/<part>/``. Results are merged from there, and an interrupted call resumes there.
"""

import contextlib
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import nbformat
import pandas as pd
import papermill
import psutil
import pytask
from nbclient import NotebookClient

import steelnb.core.errors
from steelnb.core.cache import CACHE_VARIABLE
from steelnb.core.errors import InputError, SteelnbError
from steelnb.core.files import new_folder
from steelnb.notebook.parameters import FOLDER
from steelnb.notebook.progress import PROGRESS_VARIABLE
from steelnb.notebook.results import RESULTS, TABLES, find_root, pictures, write_json
from workflow.experiments import Part, read_experiments

EXECUTED = "executed.ipynb"
REQUIRED = ("metrics.json", "table.csv", "provenance.json")
INTERRUPTED = 130
LINE_PERIOD_S = 30.0
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
OWN = dict.fromkeys(THREADS, "1") | {
    "PYTHONHASHSEED": "0", "PYTHONSTARTUP": "", "MATPLOTLIBRC": os.devnull,
    "MPLBACKEND": "module://matplotlib_inline.backend_inline",
}  # fmt: skip
"""Environment variables of a kernel: one thread, and nothing from the user's own set-up."""
BEGIN, END = "<!-- table -->", "<!-- /table -->"
BANDS = ("segmentation-odometry-draws", "cloud-odometry-draws")
"""Experiments whose bands docs/report.md shows."""


def cache_folder(root: Path, folder: Path) -> Path:
    """The folder that keeps the parts of the results in ``folder``."""
    return root / ".cache" / "workflow" / os.path.relpath(folder, root).replace(os.sep, "~")


def part_folder(cache: Path, part: Part) -> Path:
    """The folder that keeps the results and the executed notebook of a part."""
    return cache / part.id / (part.name or "all")


def write(parts: Sequence[Part], folder: Path, cache: Path, arrays: Path, budget: str, jobs: int) -> int:
    """Run what is out of date, write ``folder/<id>/``, and print what was written or failed. Returns the exit code."""
    faults = run(parts, cache, arrays, jobs)
    for id, some in itertools.groupby(parts, lambda part: part.id):
        own = list(some)
        ran = [part.label for part in own if part.label in faults]
        if not any(faults[label] for label in ran):
            merge(own, cache, folder / id, budget)
            if ran:
                print(f"{os.path.relpath(folder / id)}/ written")
    write_overview(find_root(), folder)
    failures = [fault for fault in faults.values() if fault]
    for fault in failures:
        print("error:", " ".join(str(fault).split()), file=sys.stderr)
    if not faults:
        print("everything is up to date")
    return 0 if not failures else 2 if all(isinstance(fault, InputError) for fault in failures) else 1


def run(parts: Sequence[Part], cache: Path, arrays: Path, jobs: int = 2) -> dict[str, BaseException | None]:
    """Run the parts that are out of date, ``jobs`` at once. Returns the error, or None, of each that ran, by its label.

    Flights and estimates are cached in the folder ``arrays``. SIGINT and SIGTERM end the kernels and this process.
    """
    cache.mkdir(parents=True, exist_ok=True)
    config = cache / "pyproject.toml"
    config.write_text("[tool.pytask.ini_options]\n", encoding="utf-8")
    pytask.console.quiet = True
    with tempfile.TemporaryDirectory(prefix="run-", dir=cache) as scratch, stopped(scratch), telling(Path(scratch)):
        tasks = [make_task(part, cache, Path(scratch), arrays) for part in parts]
        threads: dict[str, Any] = {"n_workers": jobs, "parallel_backend": "threads"}
        session = pytask.build(tasks=tasks, config=config, capture="no", disable_warnings=True, **threads)
    if session.exit_code not in (pytask.ExitCode.OK, pytask.ExitCode.FAILED):
        raise RuntimeError(f"pytask: {session.exit_code}")
    ran = (pytask.TaskOutcome.SUCCESS, pytask.TaskOutcome.FAIL)
    reports = [report for report in session.execution_reports if report.outcome in ran]
    return {report.task.name: report.exc_info and report.exc_info[1] for report in reports}


def make_task(part: Part, cache: Path, scratch: Path, arrays: Path) -> pytask.TaskWithoutPath:
    """The task of a part, which runs again if its key or its output changes."""
    folder = part_folder(cache, part)

    def task(key: str) -> None:
        execute(part, scratch / part.label.replace("/", "~"), arrays, folder)

    key, name, order = part.key(), part.label, part.experiment.order
    about = pytask.NodeInfo(arg_name="key", path=(), task_path=None, task_name=name, value=key)  # tells keys apart
    return pytask.TaskWithoutPath(
        name=name, function=task,
        produces={"left": {file: pytask.PathNode(path=folder / file) for file in (*REQUIRED, EXECUTED)}},
        depends_on={"key": pytask.PythonNode(name=name, value=key, hash=True, node_info=about)},
        markers=[pytask.Mark("try_first" if order > 0 else "try_last", (), {})] if order else [],
    )  # fmt: skip


def execute(part: Part, scratch: Path, arrays: Path, target: Path) -> None:
    """Run the notebook of a part in ``scratch``, and move its output to ``target``, a folder that pytask has created.

    Raises `InputError` if the notebook refused its input, else `SteelnbError`, in one line that names the cell.
    """
    begin_s, output, progress = time.monotonic(), scratch / "output", scratch / "progress"
    output.mkdir(parents=True)
    progress.write_text("0%")
    _tell(f"{part.label}: started")
    given = {**part.parameters, FOLDER: str(output)}
    notebook = papermill.execute_notebook(
        nbformat.read(part.notebook, 4), None, given, prepare_only=True, kernel_name="python3", language="python"
    )
    begun = [0]  # papermill adds a cell with the parameters, so indices count from one
    client = NotebookClient(
        notebook, timeout=None, kernel_name="python3", resources={"metadata": {"path": str(part.notebook.parent)}},
        on_cell_start=lambda cell, cell_index: begun.append(cell_index),
    )  # fmt: skip
    own = {"IPYTHONDIR": str(scratch / "ipython"), CACHE_VARIABLE: str(arrays), PROGRESS_VARIABLE: str(progress)}
    try:
        client.execute(env=os.environ | OWN | own, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        if missing := [name for name in REQUIRED if not (output / name).is_file()]:
            raise SteelnbError(f"{', '.join(missing)} missing; expected write_results(...)")
    except Exception as fault:
        failed = f"{target}.failed.ipynb"
        nbformat.write(notebook, failed)
        name, message = getattr(fault, "ename", type(fault).__name__), getattr(fault, "evalue", str(fault))
        text = " ".join(f"{part.label}: {part.notebook.name}, cell {begun[-1]}: {name}: {message}".split())
        _tell(f"{part.label}: failed")
        raised = InputError if hasattr(steelnb.core.errors, name) else SteelnbError
        raise raised(f"{text[:400]} (see {failed})") from None
    finally:
        progress.unlink()
    nbformat.write(notebook, output / EXECUTED)
    shutil.rmtree(target)
    os.replace(output, target)
    _tell(f"{part.label}: done in {time.monotonic() - begin_s:.0f} s")


def merge(parts: Sequence[Part], cache: Path, target: Path, budget: str) -> None:
    """Merge the results of the parts of an experiment. Raises `OutputError`.

    Tables are concatenated. Metrics get the prefix ``<part>.``, figures and structures the suffix ``_<part>``; a part
    without a name adds neither.
    """
    metrics: dict[str, Any] = {}
    provenance: dict[str, Any] = {}
    folders = {part.name: part_folder(cache, part) for part in parts}
    with new_folder(target, stale=RESULTS) as folder:
        for part, kept in folders.items():
            values = json.loads((kept / "metrics.json").read_text(encoding="utf-8"))
            metrics |= {f"{part}.{name}" if part else name: value for name, value in values.items()}
            provenance[kept.name] = json.loads((kept / "provenance.json").read_text(encoding="utf-8"))
            for path in pictures(kept):
                shutil.copyfile(path, folder / (f"{path.stem}_{part}{path.suffix}" if part else path.name))
        for name in TABLES:
            tables = [kept / name for kept in folders.values() if (kept / name).is_file()]
            if tables:  # the text of the cells is kept
                joined = pd.concat([pd.read_csv(table, dtype=str, keep_default_na=False) for table in tables])
                joined.to_csv(folder / name, index=False, lineterminator="\n")
        about = {"experiment": parts[0].id, "notebook": parts[0].notebook.name, "budget": budget}
        write_json(folder / "metrics.json", metrics)
        write_json(folder / "provenance.json", {**about, "parts": provenance})


def write_overview(root: Path, folder: Path) -> None:
    """Write one row per experiment with results below ``folder`` into its README.md, and the report's plots beside
    their
    bands into docs/report.md, if these pages are there."""
    rows = ["| Experiment | Notebook | Figures | Numbers |", "|---|---|---|---|"]
    for id, each in read_experiments(root).items():
        if (folder / id / "metrics.json").is_file():
            figures = [path.stem for path in sorted((folder / id).glob("*.png"))]
            shown = " ".join(f'<img src="{id}/{name}.png" width="240" alt="{name}">' for name in figures)
            title = f"**{each.title}.** {each.about}" + f" The report's figures: {each.figures}." * bool(each.figures)
            notebook = f"[{each.notebook[:2]}](../notebooks/{each.notebook})"
            rows.append(f"| {title} | {notebook} | {shown} | [metrics]({id}/metrics.json), [table]({id}/table.csv) |")
    _fill(folder / "README.md", rows)
    if folder == root / "results":
        bands = [folder / id / "bands.csv" for id in BANDS]
        _fill(root / "docs" / "report.md", _report_rows([pd.read_csv(path) for path in bands if path.is_file()]))


def _report_rows(bands: Sequence[pd.DataFrame]) -> list[str]:
    """The rows of docs/report.md, from tables of `batch.band_table`."""
    head = "| plot | the report: mean / max / end | ours: mean (10 to 90 %) / max / end | below | shape | agrees |"
    rows = [head, "|---|---|---|---|---|---|"]
    for row in itertools.chain.from_iterable(table.itertuples() for table in bands):
        band = f"{row.mean_m:.3f} ({row.mean_low_m:.3f} to {row.mean_high_m:.3f})"
        rows.append(
            f"| {row.plot} | {row.report_mean_m:.3f} / {row.report_max_m:.3f} / {row.report_final_m:.3f}"
            f" | {band} / {row.max_m:.3f} / {row.final_m:.3f} | {row.share_below:.0%} | {row.correlation:.2f}"
            f" | {'yes' if row.as_in_the_report else 'no'} |"
        )
    return rows


def _fill(page: Path, rows: Sequence[str]) -> None:
    """Write rows between the marks of a page, if it is there."""
    if page.is_file():
        before, _, rest = page.read_text(encoding="utf-8").partition(BEGIN)
        page.write_text("\n".join([before + BEGIN, "", *rows, "", END + rest.partition(END)[2]]), encoding="utf-8")


@contextlib.contextmanager
def stopped(scratch: str) -> Iterator[None]:
    """Let SIGINT and SIGTERM kill all child processes and end this process at once.

    A kernel in a long call of compiled code does not handle SIGINT, and the threads would wait for it.
    """

    def stop(number: int, frame: object) -> None:
        for process in psutil.Process().children(recursive=True):
            with contextlib.suppress(psutil.Error):
                process.kill()
        shutil.rmtree(scratch, ignore_errors=True)
        _tell("interrupted; nothing is half-written, and the next call goes on from here")
        os._exit(INTERRUPTED)

    kept = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def telling(scratch: Path) -> Iterator[None]:
    """Inside this context, print the progress of the running notebooks every half minute."""
    ended = threading.Event()

    def tell() -> None:
        while not ended.wait(LINE_PERIOD_S):
            with contextlib.suppress(OSError):  # one has just ended
                running = scratch.glob("*/progress")
                _tell(", ".join(f"{path.parent.name.replace('~', '/')}: {path.read_text()}" for path in running))

    threading.Thread(target=tell, daemon=True).start()
    try:
        yield
    finally:
        ended.set()


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
