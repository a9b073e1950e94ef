"""Parts → cached outputs: each notebook writes to a new folder, which takes its place when all files are there.

Two run at once. Threads suffice, since each notebook has its own kernel process. The output of each part is kept in
``.cache/workflow/<output folder>/<id>/<part>/``, so an interrupted call resumes there.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import nbformat
import papermill
import psutil
from nbclient import NotebookClient

import steelnb.core.errors
from steelnb.core.cache import CACHE_VARIABLE
from steelnb.core.errors import InputError, SteelnbError
from steelnb.notebook.parameters import FOLDER
from steelnb.notebook.progress import PROGRESS_VARIABLE
from steelnb.notebook.results import REQUIRED, file_digest
from workflow.experiments import BUDGETS, Part, first_parts

EXECUTED, STAMP = "executed.ipynb", "stamp.json"
LATEST = "latest"
"""Name of the cache of the outputs that tests and pages show (`latest_parts`)."""
INTERRUPTED = 130
LINE_PERIOD_S = 30.0
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
OWN = dict.fromkeys(THREADS, "1") | {
    "PYTHONHASHSEED": "0", "PYTHONSTARTUP": "", "MATPLOTLIBRC": os.devnull,
    "MPLBACKEND": "module://matplotlib_inline.backend_inline",
}  # fmt: skip
"""Environment variables of a kernel: one thread, and nothing from the user's own set-up."""


def cache_folder(root: Path, folder: Path) -> Path:
    """The folder that keeps the parts of the results in ``folder``."""
    return root / ".cache" / "workflow" / os.path.relpath(folder, root).replace(os.sep, "~")


def part_folder(cache: Path, part: Part) -> Path:
    """The folder that keeps the results and the executed notebook of a part."""
    return cache / part.id / (part.name or "all")


def stamp(key: str, folder: Path) -> str:
    """What the output in a folder depends on, and what it is. It is up to date if `STAMP` still says the same."""
    files = {name: file_digest(folder / name) for name in (*REQUIRED, EXECUTED)}
    return json.dumps({"key": key, "files": files})


def is_current(folder: Path, key: str) -> bool:
    """Whether a folder holds the output for a ``key``, unchanged."""
    noted = folder / STAMP
    return noted.is_file() and noted.read_text(encoding="utf-8") == stamp(key, folder)


def latest_parts(root: Path) -> list[Part]:
    """The `first_parts`: at the full budget if that is up to date, else at smoke."""
    full, smoke = (first_parts(root, budget) for budget in BUDGETS)
    kept = cache_folder(root, root / BUDGETS["full"])
    return [a if is_current(part_folder(kept, a), a.key()) else b for a, b in zip(full, smoke, strict=True)]


def replace_folder(made: Path, target: Path) -> None:
    """Move a folder to the place of another, if any."""
    shutil.rmtree(target, ignore_errors=True)
    target.parent.mkdir(parents=True, exist_ok=True)
    os.replace(made, target)


def run(parts: Sequence[Part], cache: Path, arrays: Path, jobs: int = 2) -> dict[str, BaseException | None]:
    """Run the parts that are out of date, ``jobs`` at once. Returns the error, or None, of each that ran, by its label.

    Flights and estimates are cached in the folder ``arrays``. SIGINT and SIGTERM end the kernels and this process.
    """
    cache.mkdir(parents=True, exist_ok=True)
    running = {}
    within = tempfile.TemporaryDirectory(prefix="run-", dir=cache)
    with within as scratch, stopped(scratch), ThreadPoolExecutor(jobs) as pool:
        for part in sorted(parts, key=lambda part: -part.experiment.order):
            key, kept, own = part.key(), part_folder(cache, part), Path(scratch, part.label.replace("/", "~"))
            if is_current(kept, key):
                continue
            # The output of another call may serve: some parts are the same at both budgets.
            others = cache.parent.glob(f"*/{kept.relative_to(cache)}")
            if same := next((folder for folder in others if is_current(folder, key)), None):
                shutil.copytree(same, own)
                replace_folder(own, kept)
            else:
                running[part.label] = pool.submit(execute, part, key, own, arrays, kept)
        while wait(running.values(), LINE_PERIOD_S).not_done:
            tell_progress(Path(scratch))
    return {label: future.exception() for label, future in running.items()}


def execute(part: Part, key: str, scratch: Path, arrays: Path, target: Path) -> None:
    """Run the notebook of a part in ``scratch``, and move its output, stamped with the ``key``, to ``target``.

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
        failed = target.with_name(f"{target.name}.failed.ipynb")
        failed.parent.mkdir(parents=True, exist_ok=True)
        nbformat.write(notebook, failed)
        name, message = getattr(fault, "ename", type(fault).__name__), getattr(fault, "evalue", str(fault))
        text = " ".join(f"{part.label}: {part.notebook.name}, cell {begun[-1]}: {name}: {message}".split())
        _tell(f"{part.label}: failed")
        raised = InputError if hasattr(steelnb.core.errors, name) else SteelnbError
        raise raised(f"{text[:400]} (see {failed})") from None
    finally:
        progress.unlink()
    nbformat.write(notebook, output / EXECUTED)
    (output / STAMP).write_text(stamp(key, output), encoding="utf-8")
    replace_folder(output, target)
    _tell(f"{part.label}: done in {time.monotonic() - begin_s:.0f} s")


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


def tell_progress(scratch: Path) -> None:
    """Print a line with the progress of the running notebooks."""
    with contextlib.suppress(OSError):  # one has just ended
        files = scratch.glob("*/progress")
        _tell(", ".join(f"{path.parent.name.replace('~', '/')}: {path.read_text()}" for path in files))


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
