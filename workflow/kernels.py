"""The kernels that notebooks, commands and tests need, compiled once, into the package's folder of compiled code."""

import gc
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed

from steelnb.core.kernels import COMPILING, kernel_folder
from steelnb.fusion.cloud_bars import bars_of_cloud
from steelnb.fusion.sections.fit import fit_sections
from steelnb.fusion.sections.histogram import HISTOGRAM
from steelnb.fusion.sections.shapes import THICKNESS
from steelnb.hough.alternatives import find_bars_by
from steelnb.settings import METHODS
from workflow.digests import SHORT, digests

ADJUSTING = ("faces", "smoothed")
"""Methods that need half of all kernels."""
OTHERS = tuple(name for name in METHODS if name not in ADJUSTING)


def compile_kernels() -> None:
    """Fly and search with every method, which compiles what is missing, and print how many kernels that were."""
    began, before = time.monotonic(), set(_compiled())
    print(COMPILING, file=sys.stderr, flush=True)
    # In this order, the two processes seldom need the same kernel at the same time, which both would compile.
    jobs = [
        delayed(_fly)("starling2", "loops", ADJUSTING), delayed(_fit)(), delayed(_fly)("starling2", "loops", OTHERS),
        delayed(_search)(), delayed(_fly)("starling2-honest", "zigzag", METHODS),
        delayed(_fly)("report", "orbit", METHODS),
    ]  # fmt: skip
    # The collector would spend a sixth of the time on the compiler's objects, which are still in use.
    Parallel(n_jobs=2, batch_size=1, initializer=gc.disable)(jobs)
    made, seconds = set(_compiled()) - before, time.monotonic() - began
    size = sum(file.stat().st_size for file in made)
    print(f"{len(made)} kernels compiled in {seconds:.0f} s: {size / 1e6:.0f} MB in {kernel_folder()}")


def _compiled() -> Iterable[Path]:
    return Path(kernel_folder()).rglob("*.nbc")


def _fly(sensor: str, trajectory: str, methods: Iterable[str]) -> None:
    settings = SHORT if sensor != "report" else {**SHORT, "overrides": {}}
    for _ in digests(settings, sensor, trajectory, methods):
        pass


def _fit() -> None:
    """Sections of no bars: the largest kernel, which takes a third of all time."""
    fit_sections(np.zeros((0, *HISTOGRAM)), np.zeros(0), THICKNESS)


def _search() -> None:
    """Whole clouds, by all methods."""
    random = np.random.default_rng(0)
    along = random.uniform(0, 3, (3, 3000))
    bars = np.concatenate([np.outer(each, axis) for each, axis in zip(along, np.eye(3), strict=True)])
    points = bars + random.normal(scale=0.01, size=bars.shape)
    bars_of_cloud(points)
    for method in ("hough", "ransac-lines"):
        find_bars_by(method, points)
