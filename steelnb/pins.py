"""Pins what libraries choose by the processor, so that results are the same bits on every x86-64 one with AVX2.

Finding bars is discrete: the last digit of a pose can decide about one. OpenBLAS and NumPy round otherwise where there
is AVX-512, and sums over several threads depend on their number. The variables stand in ``pins.env`` beside this file,
which `make` reads, too. They must be set before NumPy is imported.
"""

import contextlib
import os
import sys
from collections.abc import MutableMapping

FILE = os.path.join(os.path.dirname(__file__), "pins.env")
NUMPY_ENABLES, NUMPY_DISABLES = "NPY_ENABLE_CPU_FEATURES", "NPY_DISABLE_CPU_FEATURES"
"""NumPy refuses to start with both, and with the first where the processor lacks what it names."""


def pin(environment: MutableMapping[str, str]) -> None:
    """Set the variables that the user has not set; warn where they cannot serve."""
    if os.uname().machine != "x86_64":
        return
    with open(FILE, encoding="utf-8") as file:
        pins = dict(line.strip().split("=", 1) for line in file if "=" in line)
    missing, numpy = missing_features(), sys.modules.get("numpy")
    if missing:
        _warn(f"this processor has no {missing}: the last digits of results will differ from those of newer ones.")
    elif numpy is not None and uses_avx512(numpy):
        _warn("NumPy was imported before steelnb and uses AVX-512: the last digits of results will differ from those of"
              " other processors. Import steelnb first, or set the variables of steelnb/pins.env.")  # fmt: skip
    if missing or NUMPY_DISABLES in environment:
        del pins[NUMPY_ENABLES]
    for name, value in pins.items():
        environment.setdefault(name, value)


def _warn(text: str) -> None:
    import warnings

    warnings.warn(text, stacklevel=4)


def missing_features(description: str = "/proc/cpuinfo") -> str:
    """Names of the features that the first processor of a description lacks; empty where there is no description."""
    try:
        with open(description, encoding="utf-8") as file:
            flags = next((line.split() for line in file if line.startswith("flags")), None)
    except OSError:
        return ""
    return " and no ".join(name.upper() for name in ("avx2", "fma") if flags is not None and name not in flags)


def uses_avx512(numpy: object) -> bool:
    """Whether a NumPy that has been imported chooses code for AVX-512."""
    core = getattr(numpy, "_core", None) or getattr(numpy, "core", None)
    features = getattr(getattr(core, "_multiarray_umath", None), "__cpu_features__", {})
    return bool(features.get("X86_V4") or features.get("AVX512F"))


def machine() -> str:
    """The processor, cores and system that measured times belong to; no host name."""
    import platform

    found: dict[str, str] = {}
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:
        lines = file.read().partition("\n\n")[0].splitlines()
        found = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    version = "-".join(found.get(name, "?") for name in ("cpu family", "model", "stepping"))
    processor = f"{found.get('model name') or platform.machine()} ({version})"
    return f"{processor}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"
