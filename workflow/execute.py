"""The execution of one part: papermill in a worker process, the kernel's environment, and the end of both.

A kernel leaves its parent's process group, and one inside a long call of compiled code hears no gentle signal. So every
process carries a mark in its environment, which workers, kernels and their children inherit, and is killed by it.
"""

import contextlib
import fcntl
import importlib.util
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil

import steelnb.errors
from steelnb.cache import CACHE_VARIABLE
from steelnb.errors import InputError, OutputError, SteelnbError
from steelnb.results import PROGRESS_VARIABLE
from workflow.experiments import Part

RUN_VARIABLE = "STEELNB_RUN"
INTERRUPTED = 130
REQUIRED = ("metrics.json", "table.csv", "provenance.json")
EXECUTED = "executed.ipynb"
KILL_TIMEOUT_S = 10.0
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def environment(folder: Path, mark: str) -> dict[str, str]:
    """Variables that a kernel sees: one thread each, this interpreter, and nothing of the user's own set-up.

    ``folder`` is for files of its own; ``mark`` is for `kill_marked`.
    """
    changed = {name: "1" for name in THREAD_VARIABLES} | {"PYTHONHASHSEED": "0", RUN_VARIABLE: mark}
    changed[PROGRESS_VARIABLE] = str(folder / "progress")
    changed["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    changed["JUPYTER_PATH"] = str(Path(sys.prefix, "share", "jupyter"))
    changed |= {
        name: str(folder / name.lower()) for name in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR")
    }
    matplotlib = importlib.util.find_spec("matplotlib")
    if matplotlib and matplotlib.origin:
        changed["MATPLOTLIBRC"] = str(Path(matplotlib.origin).parent / "mpl-data" / "matplotlibrc")
    for name in ("MPLBACKEND", "PYTHONSTARTUP"):
        os.environ.pop(name, None)
    return os.environ | changed


def kill_marked(mark: str) -> None:
    """Kill every other process that was started under ``mark``, whatever its session, and wait until none is left.

    The tracker of the pool's semaphores is spared: it cleans up after the others, and ends when they have.
    """

    def marked(process: psutil.Process) -> bool:
        try:
            ours = process.environ().get(RUN_VARIABLE, "").startswith(mark) and process.pid != os.getpid()
            return ours and not any("resource_tracker" in word for word in process.cmdline())
        except (psutil.Error, OSError):  # ended meanwhile, or another user's
            return False

    deadline_s = time.monotonic() + KILL_TIMEOUT_S
    while (
        found := [process for process in psutil.process_iter() if marked(process)]
    ) and time.monotonic() < deadline_s:
        for process in found:
            with contextlib.suppress(psutil.Error):
                process.kill()
        psutil.wait_procs(found, timeout=1)


def scratch_folder(scratch: Path, label: str) -> Path:
    """Files of a part while it runs."""
    return scratch / label.replace("/", "~")


def watch(parent: int, mark: str, scratch: Path) -> None:
    """End this worker and its kernel soon after the parent has been killed, which then could not do so itself."""

    def wait() -> None:
        while os.getppid() == parent:
            time.sleep(0.1)
        kill_marked(mark)
        shutil.rmtree(scratch, ignore_errors=True)
        os._exit(1)

    if not any(thread.name == mark for thread in threading.enumerate()):
        threading.Thread(target=wait, name=mark, daemon=True).start()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which then ends this process
        os.dup2(os.open(scratch / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND), 2)  # kernels warn of their own ports


def run_part(part: Part, parent: int, mark: str, scratch: Path, arrays: Path, key: str, store: Path) -> None:
    """Execute a part in ``scratch``, and move its results and its notebook as executed into ``store``.

    Flights and estimates are shared with other parts through the folder ``arrays`` (`steelnb.cache`).
    Raises `InputError` where the notebook refused its input, else `SteelnbError`, in one line with the part's name.
    """
    watch(parent, mark, scratch)
    folder = scratch_folder(scratch, part.label)
    begin_s = time.monotonic()
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "output").mkdir(parents=True)
    own = f"{mark}{part.label}:"
    os.environ |= environment(folder, own) | {CACHE_VARIABLE: str(arrays)}  # of this worker, which the kernel inherits
    error, message = _execute(part, folder)
    kill_marked(own)  # a kernel that died leaves its children behind
    missing = [name for name in REQUIRED if not (folder / "output" / name).is_file()]
    if not error and missing:
        error, message = "NoResults", f"{', '.join(missing)} missing; expected write_results(...)"
    if error:
        failed = store.parent / f"{store.name}.failed.ipynb"
        with contextlib.suppress(FileNotFoundError):
            failed.parent.mkdir(parents=True, exist_ok=True)
            os.replace(folder / EXECUTED, failed)
        kind = InputError if hasattr(steelnb.errors, error) else SteelnbError
        raise kind(" ".join(f"{part.label}: {error}: {message}".split())[:400] + f" (see {failed})")
    if part.key() != key:
        raise SteelnbError(f"{part.label}: notebook or code was edited while it ran; run it again")
    os.replace(folder / EXECUTED, folder / "output" / EXECUTED)
    (folder / "output" / "seconds").write_text(f"{time.monotonic() - begin_s:.1f}\n")
    shutil.rmtree(store, ignore_errors=True)
    store.parent.mkdir(parents=True, exist_ok=True)
    os.replace(folder / "output", store)
    shutil.rmtree(folder, ignore_errors=True)


def _execute(part: Part, folder: Path) -> tuple[str, str]:
    """Name and message of the error that the notebook ended with, empty where there was none."""
    import papermill

    parameters: dict[str, Any] = {**part.parameters, "results_dir": str(folder / "output")}
    # papermill fills in what stands in braces.
    paths = [str(path).replace("{", "{{").replace("}", "}}") for path in (part.notebook, folder / EXECUTED)]
    try:
        papermill.execute_notebook(
            *paths, parameters, kernel_name="python3", language="python", cwd=part.notebook.parent, progress_bar=False
        )
    except papermill.PapermillExecutionError as fault:
        return fault.ename, fault.evalue
    except Exception as fault:
        return type(fault).__name__, str(fault)
    return "", ""


@contextlib.contextmanager
def locked(cache: Path) -> Iterator[None]:
    """Keep other runs out of the cache; the lock goes with the process. Raises `OutputError` if another one has it."""
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with (cache / "lock").open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield
    except BlockingIOError:
        raise OutputError(f"{cache}: in use by another run; wait for its end or stop it") from None
    except OSError as fault:
        raise OutputError(f"{fault.filename or cache}: cannot be written: {fault.strerror}") from None


@contextlib.contextmanager
def stopped(mark: str) -> Iterator[None]:
    """Make SIGINT, SIGTERM and SIGHUP kill what was started under ``mark``, and raise SystemExit.

    SIGINT is taken even where it was ignored, as it is in a script's background jobs; SIGHUP is not (nohup).
    """

    def stop(number: int, frame: object) -> None:
        kill_marked(mark)
        raise SystemExit(INTERRUPTED)

    kept = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                kept[number] = signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
