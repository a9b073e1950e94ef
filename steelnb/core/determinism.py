"""Environment variables that make results bit-identical on every x86-64 processor with AVX2.

OpenBLAS and NumPy round differently with AVX-512, and sums over threads depend on the number of threads. The last digit
of a pose can decide whether a bar is found. The variables are in ``pins.env`` beside this file, which `make` also
reads. They must be set before NumPy is imported.
"""

import contextlib
import os
import sys
from collections.abc import MutableMapping

FILE = os.path.join(os.path.dirname(__file__), "pins.env")
NUMPY_ENABLES, NUMPY_DISABLES = "NPY_ENABLE_CPU_FEATURES", "NPY_DISABLE_CPU_FEATURES"
"""NumPy refuses to start if both are set, or if the processor lacks a feature that the first one names."""


def pin(environment: MutableMapping[str, str]) -> None:
    """Set the variables that the user has not set. Warn if they have no effect."""
    if os.uname().machine != "x86_64":
        return
    with open(FILE, encoding="utf-8") as file:
        pins = dict(line.strip().split("=", 1) for line in file if "=" in line)
    missing, numpy = missing_features(), sys.modules.get("numpy")
    if missing:
        _warn(f"this processor has no {missing}: results will differ in the last digits from those of newer ones.")
    elif numpy is not None and uses_avx512(numpy):
        _warn("NumPy was imported before steelnb and uses AVX-512: results will differ in the last digits from those of"
              " other processors. Import steelnb first, or set the variables of steelnb/core/pins.env.")  # fmt: skip
    if missing or NUMPY_DISABLES in environment:
        del pins[NUMPY_ENABLES]
    for name, value in pins.items():
        environment.setdefault(name, value)


def _warn(text: str) -> None:
    import warnings

    warnings.warn(text, stacklevel=4)


def missing_features(description: str = "/proc/cpuinfo") -> str:
    """Names of the required features missing from a processor's description; empty if that file is missing."""
    try:
        with open(description, encoding="utf-8") as file:
            flags = next((line.split() for line in file if line.startswith("flags")), None)
    except OSError:
        return ""
    return " and no ".join(name.upper() for name in ("avx2", "fma") if flags is not None and name not in flags)


def uses_avx512(numpy: object) -> bool:
    """Whether the imported NumPy uses AVX-512."""
    core = getattr(numpy, "_core", None) or getattr(numpy, "core", None)
    features = getattr(getattr(core, "_multiarray_umath", None), "__cpu_features__", {})
    # NumPy 2.4 and newer: AVX512F says what the processor has, X86_V4 what NumPy may use.
    return bool(features.get("X86_V4", features.get("AVX512F", False)))


def machine() -> str:
    """Processor, cores and system, to state beside measured times; without the host name."""
    import platform

    info: dict[str, str] = {}
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:
        lines = file.read().partition("\n\n")[0].splitlines()
        info = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    version = "-".join(info.get(name, "?") for name in ("cpu family", "model", "stepping"))
    processor = f"{info.get('model name') or platform.machine()} ({version})"
    return f"{processor}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"
