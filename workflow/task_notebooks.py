"""A pytask task for each part: its notebook runs into a new folder, which is renamed when it is done.

Two run at once, in threads, since each has a kernel, a process of its own. ``.cache/workflow/<output folder>/`` holds
what each part has left in ``<id>/<part>/``: results are put together from there, and an interrupted call resumes there.
"""

import contextlib
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

import psutil
import pytask

import steelnb.errors
from steelnb.cache import CACHE_VARIABLE
from steelnb.errors import InputError, SteelnbError
from steelnb.files import new_folder
from steelnb.parameters import FOLDER
from steelnb.results import PROGRESS_VARIABLE, RESULTS, pictures, write_json
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
"""Variables of a kernel: one thread, and nothing of the user's own set-up."""
BEGIN, END = "<!-- table -->", "<!-- /table -->"


def run(parts: Sequence[Part], cache: Path, arrays: Path, jobs: int = 2) -> dict[str, BaseException | None]:
    """Run the parts that are out of date, ``jobs`` at once, and give the errors of all that were run by their labels.

    Flights and estimates are kept in the folder ``arrays``. SIGINT and SIGTERM end the kernels and this process.
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
    return {
        report.task.name: report.exc_info and report.exc_info[1]
        for report in session.execution_reports
        if report.outcome in (pytask.TaskOutcome.SUCCESS, pytask.TaskOutcome.FAIL)
    }


def part_folder(cache: Path, part: Part) -> Path:
    """Where the results of a part and its notebook as executed are kept."""
    return cache / part.id / (part.name or "all")


def make_task(part: Part, cache: Path, scratch: Path, arrays: Path) -> pytask.TaskWithoutPath:
    """The task of a part, which runs again when its key or what it has left changes."""
    folder = part_folder(cache, part)

    def task(key: str) -> None:
        execute(part, scratch / part.label.replace("/", "~"), arrays, folder)

    key, name = part.key(), part.label
    about = pytask.NodeInfo(arg_name="key", path=(), task_path=None, task_name=name, value=key)  # tells keys apart
    left = {file: pytask.PathNode(path=folder / file) for file in (*REQUIRED, EXECUTED)}
    return pytask.TaskWithoutPath(
        name=name, function=task, produces={"left": left},
        depends_on={"key": pytask.PythonNode(name=name, value=key, hash=True, node_info=about)},
        markers=[pytask.Mark("try_first", (), {})] if part.experiment.long else [],
    )  # fmt: skip


def execute(part: Part, scratch: Path, arrays: Path, target: Path) -> None:
    """Run the notebook of a part in ``scratch``, and rename what it left to ``target``.

    pytask has made the folder ``target``. Raises `InputError` where the notebook refused its input, else
    `SteelnbError`, in one line that names the cell.
    """
    import nbformat
    import papermill
    from nbclient import NotebookClient

    begin_s, output, progress = time.monotonic(), scratch / "output", scratch / "progress"
    output.mkdir(parents=True)
    progress.write_text("0%")
    _tell(f"{part.label}: started")
    given = {**part.parameters, FOLDER: str(output)}
    notebook = papermill.execute_notebook(
        nbformat.read(part.notebook, 4), None, given, prepare_only=True, kernel_name="python3", language="python"
    )
    begun: list[int] = []  # the cell of the parameters comes on top, so that these count from one
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
        where = f"{part.label}: {part.notebook.name}, cell {begun[-1] if begun else 0}"
        text = " ".join(f"{where}: {name}: {message}".split())[:400] + f" (see {failed})"
        _tell(f"{part.label}: failed")
        raise (InputError if hasattr(steelnb.errors, name) else SteelnbError)(text) from None
    finally:
        progress.unlink()
    nbformat.write(notebook, output / EXECUTED)
    shutil.rmtree(target)
    os.replace(output, target)
    _tell(f"{part.label}: done in {time.monotonic() - begin_s:.0f} s")


def merge(parts: Sequence[Part], cache: Path, target: Path, budget: str) -> None:
    """Put the results of the parts of an experiment together. Raises `OutputError`.

    Tables are joined, the names of metrics prefixed ``<part>.``, those of figures and structures suffixed ``_<part>``;
    a part without a name leaves no trace.
    """
    import pandas as pd

    metrics: dict[str, Any] = {}
    provenance: dict[str, Any] = {}
    with new_folder(target, stale=RESULTS) as folder:
        for part in parts:
            kept, prefix, suffix = (
                part_folder(cache, part),
                part.name and f"{part.name}.",
                part.name and f"_{part.name}",
            )
            values = json.loads((kept / "metrics.json").read_text(encoding="utf-8"))
            metrics |= {prefix + name: value for name, value in values.items()}
            provenance[kept.name] = json.loads((kept / "provenance.json").read_text(encoding="utf-8"))
            for path in pictures(kept):
                shutil.copyfile(path, folder / path.with_stem(path.stem + suffix).name)
        for name in ("table.csv", "timing.csv"):
            tables = [path for part in parts if (path := part_folder(cache, part) / name).is_file()]
            if tables:  # the text of the cells is kept
                joined = pd.concat([pd.read_csv(table, dtype=str, keep_default_na=False) for table in tables])
                joined.to_csv(folder / name, index=False, lineterminator="\n")
        about = {"experiment": parts[0].id, "notebook": parts[0].experiment.notebook, "budget": budget}
        write_json(folder / "metrics.json", metrics)
        write_json(folder / "provenance.json", {**about, "parts": provenance})


def write_overview(root: Path, folder: Path) -> None:
    """Write a row for each experiment that has results below ``folder`` between the marks of its README.md, if any."""
    rows = ["| Experiment | Notebook | Figures | Numbers |", "|---|---|---|---|"]
    for id, each in read_experiments(root).items():
        if (folder / id / "metrics.json").is_file():
            figures = [path.stem for path in sorted((folder / id).glob("*.png"))]
            shown = " ".join(f'<img src="{id}/{name}.png" width="240" alt="{name}">' for name in figures)
            title = f"**{each.title}.** {each.about}" + f" The report's figures: {each.figures}." * bool(each.figures)
            notebook = f"[{each.notebook[:2]}](../notebooks/{each.notebook})"
            rows.append(f"| {title} | {notebook} | {shown} | [metrics]({id}/metrics.json), [table]({id}/table.csv) |")
    readme = folder / "README.md"
    if readme.is_file():
        before, _, rest = readme.read_text(encoding="utf-8").partition(BEGIN)
        text = "\n".join([before + BEGIN, "", *rows, "", END + rest.partition(END)[2]])
        readme.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def stopped(scratch: str) -> Iterator[None]:
    """Let SIGINT and SIGTERM end all that was started here, and this process, at once.

    A kernel in a long call of compiled code does not handle SIGINT, and the threads would wait for it.
    """

    def stop(number: int, frame: object) -> None:
        for process in psutil.Process().children(recursive=True):
            with contextlib.suppress(psutil.Error):
                process.kill()
        shutil.rmtree(scratch, ignore_errors=True)
        _tell("interrupted; nothing is half-written, and the next call goes on from here")
        os._exit(INTERRUPTED)

    main = threading.current_thread() is threading.main_thread()
    kept = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM) if main}
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def telling(scratch: Path) -> Iterator[None]:
    """While this lasts, say every half minute how far the running notebooks have come."""
    ended = threading.Event()

    def tell() -> None:
        while not ended.wait(LINE_PERIOD_S):
            with contextlib.suppress(OSError):  # one has just ended
                _tell(
                    ", ".join(
                        f"{path.parent.name.replace('~', '/')}: {path.read_text()}"
                        for path in scratch.glob("*/progress")
                    )
                )

    threading.Thread(target=tell, daemon=True).start()
    try:
        yield
    finally:
        ended.set()


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
