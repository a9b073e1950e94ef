"""What more than one benchmark needs."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.types import Array


def command(doc: str) -> str:
    """The call that a script's docstring names, without the file that its output goes to."""
    return next(line.strip() for line in doc.splitlines() if line.startswith("    ")).split(" >")[0]


def in_own_process(script: str, *arguments: str) -> dict[str, Any]:
    """What a script prints as JSON in its last line, run in a process of its own: its memory is then its own. Raises
    SystemExit with the last line of its errors."""
    done = subprocess.run([sys.executable, script, *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(arguments)}: {done.stderr.strip().splitlines()[-1]}")
    return dict(json.loads(done.stdout.splitlines()[-1]))


def peak_bytes() -> int:
    """Peak memory of this process. Not that of getrusage, which a process inherits from the one that started it."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])


def aligned_m(found: Array, true: Array) -> Array:
    """Distances ``(K,)`` that a turn about z and a shift of the whole path leave, positions ``(K, 3)``, metres."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum())
    return np.asarray(np.linalg.norm(Rotation.from_rotvec([0, 0, turn]).apply(a) - b, axis=1))
