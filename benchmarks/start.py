"""How long a user waits for the first result of a command or a notebook.

    .venv/bin/python benchmarks/start.py

Prints the table of start.md, on an idle machine. ``as set up``: files are in memory. ``from disk``: they are not, as
after a restart; needs Linux and root. ``no bytecode``: nothing of Python is compiled, as after ``pip install
--no-compile`` where ``PYTHONDONTWRITEBYTECODE`` is set. ``no kernels``: none is compiled, as without ``make setup``.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

TRIES = 3
BIN, NOTEBOOK = Path(sys.executable).parent, Path("notebooks", "00_explore.ipynb").resolve()
PAPERMILL = [str(BIN / "papermill"), "--no-progress-bar", str(NOTEBOOK)]
TASKS: dict[str, list[str]] = {
    "`import steelnb`": [sys.executable, "-c", "import steelnb"],
    "`import steelnb.registration`": [sys.executable, "-c", "import steelnb.registration"],
    "`steelnb --help`": [str(BIN / "steelnb"), "--help"],
    "`steelnb run`, 30 scans": [str(BIN / "steelnb"), "run", "flight.mcap", "-o", "run", "--force"],
    "`steelnb segment`, their map": [str(BIN / "steelnb"), "segment", "run/map.ply", "-o", "bars", "--force"],
    "a misspelt parameter is refused": [*PAPERMILL, "out.ipynb", "-p", "trajektory", "loops"],
    "notebook 00, all cells": [*PAPERMILL, "out.ipynb"],
}
WITHOUT_KERNELS = "`steelnb run`, 30 scans"
"""The task that is tried without kernels, too."""


def seconds(task: str, condition: str, folder: Path) -> float:
    """Wall time of one call in an empty place for what the condition lacks."""
    environment, lacking = dict(os.environ), tempfile.TemporaryDirectory(dir=folder)
    if condition == "no bytecode":
        environment |= {"PYTHONPYCACHEPREFIX": lacking.name, "PYTHONDONTWRITEBYTECODE": "1"}
    elif condition == "no kernels":
        environment["NUMBA_CACHE_DIR"] = lacking.name
    elif condition == "from disk":
        os.sync()
        Path("/proc/sys/vm/drop_caches").write_text("3", encoding="ascii")
    began = time.perf_counter()
    done = subprocess.run(TASKS[task], cwd=folder, env=environment, capture_output=True, text=True, check=False)
    taken = time.perf_counter() - began
    if (done.returncode == 0) == ("refused" in task):
        raise SystemExit(f"{task}: exit code {done.returncode}\n{done.stderr[-2000:]}")
    return taken


if __name__ == "__main__":
    conditions = ["as set up", *(["from disk"] if os.access("/proc/sys/vm/drop_caches", os.W_OK) else [])]
    conditions += ["no bytecode", "no kernels"]
    print(f"| seconds | {' | '.join(conditions)} |\n|---|{'---|' * len(conditions)}")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        record = [str(BIN / "steelnb"), "record", "flight.mcap", "--duration", "6"]
        subprocess.run(record, cwd=folder, check=True, capture_output=True)
        for task in TASKS:
            cells = []
            for condition in conditions:
                if condition == "no kernels" and task != WITHOUT_KERNELS:
                    cells.append("")
                    continue
                cells.append(f"{statistics.median(seconds(task, condition, folder) for _ in range(TRIES)):.1f}")
            print(f"| {task} | {' | '.join(cells)} |", flush=True)
