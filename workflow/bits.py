"""`make bits`: the digests as other processors would compute them, in one table.

Libraries choose their code by the processor: OpenBLAS by ``OPENBLAS_CORETYPE``, Numba by ``NUMBA_CPU_NAME``, and all of
them, Embree and the C library included, by what the processor says of itself, which QEMU's user mode emulates. Emulated
runs load kernels that were compiled for no processor in particular, since compiling is slow there.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from steelnb.errors import OutputError, SteelnbError
from workflow.digests import changed

EMULATOR = "qemu-x86_64"
EMULATED = ("EPYC-Milan", "Haswell", "Skylake-Server")


class Row(NamedTuple):
    """One way to compute: variables of the environment, and the emulated processor, "" for none."""

    name: str
    variables: Mapping[str, str]
    emulated: str = ""


NATIVE = Row("this processor", {})
GENERIC = Row("NUMBA_CPU_NAME=generic", {"NUMBA_CPU_NAME": "generic"})
VARIANTS = (
    GENERIC,
    *(Row(f"OPENBLAS_CORETYPE={name}", {"OPENBLAS_CORETYPE": name}) for name in ("Zen", "Haswell")),
    *(Row(f"NUMBA_CPU_NAME={name}", {"NUMBA_CPU_NAME": name}) for name in ("znver3", "haswell")),
)


def compute(root: Path, row: Row, short: bool) -> dict[str, str]:
    """The digests of a row, in a process of its own. Raises `SteelnbError` where it fails."""
    folder = root / ".cache" / "bits"
    folder.mkdir(parents=True, exist_ok=True)
    result = folder / f"{row.name.replace('=', '-').replace(' ', '-')}{'-short' if short else ''}.json"
    result.unlink(missing_ok=True)
    variables = {**os.environ, **row.variables}
    compiled = row.variables.get("NUMBA_CPU_NAME")
    if compiled:
        variables["NUMBA_CACHE_DIR"] = str(folder / f"numba-{compiled}")
    command = [sys.executable, "-m", "workflow", "digests", "--json", str(result), *(["--short"] if short else [])]
    if row.emulated:
        command = [EMULATOR, "-cpu", row.emulated, *command]
    done = subprocess.run(command, cwd=root, env=variables, capture_output=True, text=True)
    if done.returncode or not result.exists():
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise SteelnbError(f"{row.name}: exit code {done.returncode}: {last}")
    found: dict[str, str] = json.loads(result.read_text(encoding="utf-8"))
    return found


def compare(root: Path, committed: Mapping[str, str]) -> bool:
    """Compute every row, two at once, print the table, and say whether all digests agree.

    Raises `OutputError` where the emulator is missing.
    """
    if shutil.which(EMULATOR) is None:
        raise OutputError(f"{EMULATOR} not found: install it by `apt-get install qemu-user`")
    print("| computed by | digests | differ | the first that does | minutes |\n|---|---|---|---|---|", flush=True)
    with ThreadPoolExecutor(2) as pool:
        short = pool.submit(_timed, root, NATIVE, True)
        generic = pool.submit(_timed, root, GENERIC, True)
        generic.result()  # its kernels are those of the emulated rows
        emulated = [pool.submit(_timed, root, Row(f"qemu {name}", GENERIC.variables, name), True) for name in EMULATED]
        rest = [pool.submit(_timed, root, row, False) for row in (NATIVE, *VARIANTS)]
        equal = [_say("this processor, short set", short, short.result()[0])]
        equal += [
            _say(f"qemu {name}, short set", run, short.result()[0])
            for name, run in zip(EMULATED, emulated, strict=True)
        ]
        equal += [_say(row.name, run, committed) for row, run in zip((NATIVE, *VARIANTS), rest, strict=True)]
    return all(equal)


def _timed(root: Path, row: Row, short: bool) -> tuple[dict[str, str], float]:
    begin = time.monotonic()
    return compute(root, row, short), (time.monotonic() - begin) / 60


def _say(name: str, run: "Future[tuple[dict[str, str], float]]", expected: Mapping[str, str]) -> bool:
    """Print the line of a row as soon as it is there; whether its digests are those expected."""
    found, minutes = run.result()
    differ = changed(expected, found)
    print(f"| {name} | {len(found)} | {len(differ)} | {differ[0] if differ else ''} | {minutes:.1f} |", flush=True)
    return not differ
