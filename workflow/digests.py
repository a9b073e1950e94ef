"""Digests of short flights. If they differ between x86-64 processors with AVX2, a difference in rounding has crept in.

`tests/digests.json` holds those of the last commit, and `tests/test_digests.py` compares them. `python -m workflow
digests --write` rewrites the file. A digest is the first 16 hexadecimal digits of a SHA-256.

`make bits` computes them as other processors would. Libraries select their code for the processor. OpenBLAS obeys
``OPENBLAS_CORETYPE`` and Numba ``NUMBA_CPU_NAME``. All of them, including Embree and the C library, follow what the
processor reports about itself, which QEMU's user mode emulates.
"""

import hashlib
import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from steelnb import experiment
from steelnb.core.errors import InputError, OutputError, SteelnbError
from steelnb.core.files import reading
from steelnb.core.types import Array, Flight
from steelnb.fusion.reconstruct import reconstruct
from steelnb.hough import detect_segments_with
from steelnb.hough.lines import detect_lines
from steelnb.odometry import correct, faces
from steelnb.odometry.segments import shared_segments
from steelnb.points import preprocess_scan
from steelnb.settings import METHODS, ExperimentSettings, FaceSettings, SegmentSettings, StructureSettings

PATH = Path("tests", "digests.json")
WRITE = "python -m workflow digests --write"
PACKAGES = ("numpy", "scipy", "numba", "llvmlite", "open3d-cpu", "opencv-python-headless", "pybullet", "imufusion")
EMULATOR = "qemu-x86_64"
EMULATED = ("EPYC-Milan", "Haswell", "Skylake-Server")
GENERIC = {"NUMBA_CPU_NAME": "generic"}
"""For emulated runs: kernels for a generic processor, which are compiled natively, since emulation is slow."""
VARIANTS: tuple[dict[str, str], ...] = (
    {}, GENERIC, {"OPENBLAS_CORETYPE": "Zen"}, {"OPENBLAS_CORETYPE": "Haswell"}, {"NUMBA_CPU_NAME": "znver3"},
    {"NUMBA_CPU_NAME": "haswell"},
)  # fmt: skip

SETTINGS: dict[str, Any] = {
    "flights": {
        "report": ["vertical", "orbit"],
        "starling2": ["zigzag", "loops"],
        "starling2-honest": ["zigzag", "loops"],
    },
    "start_s": {"vertical": 24.5, "orbit": 9.5},  # of the scans: earlier, the tower is out of sight
    "noise": "random-walk+yaw-random-walk",
    "seed": 7,
    "scans": 12,
    "scans_of_faces": 75,  # beyond the first adjustment, at 10 s
    "overrides": {},
}
SHORT = SETTINGS | {
    "flights": {"starling2": ["loops"]},
    "scans": 8,
    "scans_of_faces": 12,
    "overrides": {"tof.columns": 90, "tof.rows": 120},
    "refit_s": 0.8,
}
"""A set that is short enough to be emulated and still covers each method."""


def digest(*arrays: Any) -> str:
    """Digest of the bytes, shapes and types of arrays."""
    found = hashlib.sha256()
    for array in map(np.asarray, arrays):
        found.update(f"{array.shape}{array.dtype.str}".encode())
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:16]


def compute(settings: Mapping[str, Any]) -> dict[str, str]:
    """Name and digest of everything computed from every flight of the settings."""
    flights = [(sensor, flight) for sensor, flights in settings["flights"].items() for flight in flights]
    return {name: found for pair in flights for name, found in digests(settings, *pair)}


def digests(
    settings: Mapping[str, Any], sensor: str, trajectory: str, methods: Iterable[str] = METHODS
) -> Iterator[tuple[str, str]]:
    """Name and digest of everything computed from one flight, in the order in which it is computed. A structure follows
    if ``smoothed`` is among the methods."""
    start_s = settings["start_s"].get(trajectory, 0.0)
    in_the_air = {} if start_s else {"flight.still_s": 0.0}

    def configured(method: str) -> ExperimentSettings:
        return ExperimentSettings.preset(
            trajectory,  # type: ignore[arg-type]
            settings["noise"], method, sensor, settings["seed"], start_s + 15.0,
            settings["overrides"] | {"tof.start_s": start_s, **in_the_air},
        )  # fmt: skip

    whole, truth = experiment.simulate(configured("orb"))
    flight, name = whole.first(settings["scans"]), f"{sensor}/{trajectory}"
    yield f"{name}/flight", digest(truth.trajectory.T_world_drone)
    yield f"{name}/scans", digest(*(scan.points for scan in whole.scans))
    yield f"{name}/prior", digest(whole.prior.T_world_drone)
    if whole.images is not None:
        stamp_s, (first, last) = whole.images.stamp_s, flight.prior.stamp_s[[0, -1]]
        taken = np.flatnonzero((stamp_s >= first - 1e-6) & (stamp_s <= last + 1e-6))
        images = [whole.images.images[k] for k in taken.tolist()]
        flight = replace(flight, images=replace(whole.images, stamp_s=stamp_s[taken], images=images))
        yield f"{name}/images", digest(*images)
    by_segments = configured("least_squares").odometry
    assert isinstance(by_segments, SegmentSettings)
    yield from _bars(name, flight, by_segments)
    smoothed, faces.REFIT_S = None, settings.get("refit_s", faces.REFIT_S)
    with shared_segments():
        for method in methods:
            chosen, odometry = flight, configured(method).odometry
            if isinstance(odometry, FaceSettings) and not odometry.smooth:
                chosen = whole.first(settings["scans_of_faces"])
            found = correct(chosen, odometry)
            smoothed = found.corrected if method == "smoothed" else smoothed
            yield f"{name}/{method}", digest(found.corrected.T_world_drone)
    if smoothed is None:
        return
    structure = reconstruct(flight.scans, smoothed.T_world_drone, flight.T_drone_sensor, StructureSettings())
    yield f"{name}/structure bars", digest(structure.segments.start, structure.segments.end, structure.width_m)
    yield f"{name}/structure joints", digest(structure.joint, structure.tie)


def _bars(name: str, flight: Flight, settings: SegmentSettings) -> Iterator[tuple[str, str]]:
    k = len(flight) - 1
    points: Array = preprocess_scan(
        flight.scans[k], flight.prior.T_world_drone[k], flight.T_drone_sensor, settings.preprocess
    )
    enough = len(points) >= settings.hough.min_votes
    lines = detect_lines(points, settings.hough.dx_m, min_votes=settings.hough.min_votes) if enough else None
    yield f"{name}/lines", digest(*([lines.anchor, lines.direction] if lines else []))
    segments = detect_segments_with(points, settings.hough) if enough else None
    yield f"{name}/segments", digest(*([segments.start, segments.end] if segments else []))


def made_with() -> dict[str, Any]:
    """The settings and the versions that digests belong to."""
    return {"settings": SETTINGS, "versions": {name: importlib.metadata.version(name) for name in PACKAGES}}


def read(root: Path) -> dict[str, str]:
    """The committed digests. Raises `InputError` if there are none, or if they were made with other settings or
    versions."""
    with reading(root / PATH, f"digests, which `{WRITE}` writes"):
        found = json.loads((root / PATH).read_text(encoding="utf-8"))
        kept = dict(found.pop("digests"))
    if found != made_with():
        raise InputError(f"{PATH}: made with {found}, here {made_with()}; `{WRITE}` writes it anew")
    return kept


def write(root: Path, found: Mapping[str, str]) -> None:
    """Rewrite the file of the committed digests."""
    text = json.dumps({**made_with(), "digests": dict(found)}, indent=1)
    (root / PATH).write_text(text + "\n", encoding="utf-8")


def changed(old: Mapping[str, str], new: Mapping[str, str]) -> list[str]:
    """Names whose digests differ, or that only one side has, in the order of the new ones."""
    return [name for name in {**new, **old} if old.get(name) != new.get(name)]


def bits(root: Path) -> bool:
    """Compute the digests for every variant, two at once, print a table, and return whether all of them agree.

    Raises `OutputError` if the emulator is missing, and `SteelnbError` if a run fails.
    """
    if shutil.which(EMULATOR) is None:
        raise OutputError(f"{EMULATOR} not found: install it by `apt-get install qemu-user`")
    whole, short = read(root), elsewhere(root, True, {})
    elsewhere(root, True, GENERIC)  # compiles the kernels of the emulated runs
    print("| computed by | digests | differ | the first that does |\n|---|---|---|---|", flush=True)
    equal = True
    with ThreadPoolExecutor(2) as pool:
        runs = [(cpu, short, pool.submit(elsewhere, root, True, GENERIC, cpu)) for cpu in EMULATED]
        runs += [(_name(each), whole, pool.submit(elsewhere, root, False, each)) for each in VARIANTS]
        for name, expected, run in runs:
            differ = changed(expected, run.result())
            print(f"| {name} | {len(expected)} | {len(differ)} | {''.join(differ[:1])} |", flush=True)
            equal = equal and not differ
    return equal


def elsewhere(root: Path, short: bool, variables: Mapping[str, str], cpu: str = "") -> dict[str, str]:
    """The digests from a separate process with these environment variables, on the emulated ``cpu``, if any."""
    environment = {**os.environ, **variables, "NUMBA_CACHE_DIR": str(root / ".cache" / "bits" / _name(variables))}
    command = [sys.executable, "-m", "workflow", "digests", "--short" if short else "--full"]
    emulator = [EMULATOR, "-cpu", cpu] if cpu else []
    done = subprocess.run([*emulator, *command], cwd=root, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SteelnbError(f"{cpu or _name(variables)}: {(done.stderr.strip() or 'no message').splitlines()[-1]}")
    found: dict[str, str] = json.loads(done.stdout.splitlines()[-1])
    return found


def _name(variables: Mapping[str, str]) -> str:
    return ", ".join(f"{name}={value}" for name, value in variables.items()) or "this processor"
