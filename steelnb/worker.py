"""The process that runs one notebook: what it sees, what it does, and how it is ended with all its children."""

import contextlib
import importlib.util
import json
import os
import shutil
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from steelnb.results import PROGRESS_VARIABLE

TICK_S = 0.1
RUN_VARIABLE = "STEELNB_RUN"
KILL_TIMEOUT_S = 10.0
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def environment(folder: Path, mark: str) -> dict[str, str]:
    """What a worker and its kernel see: one thread each, this interpreter, and nothing of the user's own set-up.

    ``folder`` is the worker's own; ``mark`` is what `kill_marked` will know it by.
    """
    changed = {name: "1" for name in THREAD_VARIABLES}
    changed |= {"PYTHONHASHSEED": "0", RUN_VARIABLE: mark, PROGRESS_VARIABLE: str(folder / "progress")}
    changed["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    changed["JUPYTER_PATH"] = str(Path(sys.prefix, "share", "jupyter"))
    changed |= {
        name: str(folder / name.lower()) for name in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR")
    }
    matplotlib = importlib.util.find_spec("matplotlib")
    if matplotlib and matplotlib.origin:
        changed["MATPLOTLIBRC"] = str(Path(matplotlib.origin).parent / "mpl-data" / "matplotlibrc")
    return {name: value for name, value in os.environ.items() if name not in ("MPLBACKEND", "PYTHONSTARTUP")} | changed


def kill_marked(mark: str) -> None:
    """Kill every process that was started under ``mark``, whatever session it is in, and wait until none is left.

    Workers, kernels and their children inherit the environment, whereas a kernel leaves its parent's process group, and
    one inside a long call of compiled code hears no gentler signal.
    """
    import psutil

    def marked(process: psutil.Process) -> bool:
        try:
            return bool(process.pid != os.getpid() and process.environ().get(RUN_VARIABLE, "").startswith(mark))
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


def _work(folder: Path) -> None:
    """What a worker process does: execute the notebook that ``folder``/order.json names, and leave outcome.json."""
    order = read_json(folder / "order.json")

    def watch() -> None:
        """End kernel and worker soon after the parent has been killed, which then could not do so itself."""
        while os.getppid() == order["parent"]:
            time.sleep(TICK_S)
        kill_marked(order["mark"])
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    import papermill

    notebook, executed = (
        str(path).replace("{", "{{").replace("}", "}}") for path in (order["notebook"], folder / "executed.ipynb")
    )
    error, message = "", ""
    try:
        papermill.execute_notebook(
            notebook,
            executed,
            order["parameters"],
            kernel_name="python3",
            language="python",
            cwd=Path(order["notebook"]).parent,
            progress_bar=False,
        )
    except papermill.PapermillExecutionError as fault:
        error, message = fault.ename, fault.evalue
    except Exception as fault:
        error, message = type(fault).__name__, str(fault)
    write_json(folder / "outcome.json", {"error": error, "message": message})


def read_json(path: Path) -> dict[str, Any]:
    """A table from a file; an empty one where it is missing or broken, as after a power cut."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    fresh = path.with_suffix(".new")
    fresh.write_text(json.dumps(values), encoding="utf-8")
    os.replace(fresh, path)


if __name__ == "__main__":
    _work(Path(sys.argv[1]))
