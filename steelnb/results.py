"""The files that a notebook leaves, and the progress that it shows."""

import base64
import contextlib
import hashlib
import importlib.metadata
import io
import json
import math
import numbers
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from steelnb.files import new_folder
from steelnb.pins import machine

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

EXPERIMENTS_FILE = Path("notebooks", "runs.toml")
PROGRESS_VARIABLE = "STEELNB_PROGRESS_FILE"
PROGRESS_PERIOD_S = 0.2
PACKAGES = ("steelnb", "numpy", "scipy", "pandas", "numba", "open3d", "open3d-cpu", "pybullet", "evo", "matplotlib")
PICTURES = ("fig_*.png", "structure_*.json")
RESULTS = ("metrics.json", "provenance.json", "table.csv", "timing.csv", *PICTURES)
"""Patterns of the files that a notebook leaves; those of an earlier run go when it is run again."""
Item = TypeVar("Item")


def write_results(
    results_dir: str | Path,
    *,
    table: "DataFrame",
    metrics: Mapping[str, float],
    figures: Mapping[str, "Figure"],
    timing: "DataFrame | None" = None,
    files: Mapping[str, Callable[[Path], object]] | None = None,
    provenance: Mapping[str, Any],
) -> None:
    """Write the results of a notebook into the folder ``results_dir``; if that is empty, only show its figures.

    ``table`` becomes table.csv (nine digits), ``metrics`` metrics.json (finite numbers, units in the keys), each figure
    fig_<name>.png, ``timing`` timing.csv with the machine's description, ``provenance`` (settings, seeds; no times,
    hosts or paths) provenance.json, to which versions and the hash of the lock are added. ``files`` are others, by
    name, each with the function that writes it; names start with ``structure_``. The same values give the same bytes.
    Files are written beside and then renamed. Raises `OutputError`, and ValueError for a metric not finite.
    """
    if not str(results_dir):
        _show_in_a_row(figures)
        return
    flat = {name: _finite(name, value) for name, value in metrics.items()}
    with new_folder(results_dir, stale=RESULTS) as folder:
        write_json(folder / "metrics.json", flat)
        write_json(folder / "provenance.json", {**provenance, **environment()})
        table.to_csv(folder / "table.csv", index=False, float_format="%.9g", lineterminator="\n")
        if timing is not None:
            described = timing if "machine" in timing else timing.assign(machine=machine())
            described.to_csv(folder / "timing.csv", index=False, float_format="%.9g", lineterminator="\n")
        for name, figure in figures.items():
            # Matplotlib would note its own version in the file.
            figure.savefig(folder / f"fig_{name.removeprefix('fig_')}.png", dpi=150, metadata={"Software": None})
        for name, write in (files or {}).items():
            write(folder / name)


def _show_in_a_row(figures: Mapping[str, "Figure"]) -> None:
    """Show all figures side by side: JupyterLab is scrolled to the last cell once all cells were run."""
    from IPython.display import HTML, display

    look, images = "min-width: 0; max-height: 24em; object-fit: contain", []
    for figure in figures.values():
        png = io.BytesIO()
        figure.savefig(png, format="png", dpi=90)
        images.append(f'<img style="{look}" src="data:image/png;base64,{base64.b64encode(png.getvalue()).decode()}">')
    display(HTML(f'<div style="display: flex; gap: 1em">{"".join(images)}</div>'))


def _finite(name: str, value: Any) -> int | float:
    """A metric as a Python number; ValueError if it is none or not finite."""
    if not isinstance(value, numbers.Real) or isinstance(value, bool) or not math.isfinite(value):
        raise ValueError(f"metrics: {name} = {value!r}: expected a finite number")
    return int(value) if isinstance(value, numbers.Integral) else float(value)


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """A table as JSON, its keys sorted, NumPy arrays and settings as lists and tables."""
    text = json.dumps(values, sort_keys=True, indent=2, ensure_ascii=False, allow_nan=False, default=_plain)
    path.write_text(text + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """NumPy scalars and arrays and pydantic settings for JSON."""
    for method in ("model_dump", "tolist"):
        if hasattr(value, method):
            return getattr(value, method)()
    raise TypeError(f"provenance: {value!r}: expected numbers, texts, lists, tables or settings")


def find_root(start: Path | None = None) -> Path:
    """The nearest folder from ``start`` (default: the current one) upwards that holds ``notebooks/runs.toml``,
    else the project that the package lies in."""
    start, project = (start or Path.cwd()).resolve(), Path(__file__).resolve().parents[1]
    folders = (start, *start.parents)
    return next((folder for folder in folders if (folder / EXPERIMENTS_FILE).is_file()), project)


def file_digest(path: Path) -> str | None:
    """SHA-256 of a file's content, or None where there is no file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


def environment() -> dict[str, Any]:
    """Versions of Python, the main packages and the C library, and the SHA-256 of the project's environment.lock."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    digest = file_digest(find_root() / "environment.lock")
    versions["c-library"] = "-".join(platform.libc_ver())  # its sine and exponential round, too
    return {"versions": versions, "environment_lock_sha256": digest}


def pictures(folder: Path) -> list[Path]:
    """The figures and structures in a folder, sorted by name."""
    return sorted(path for pattern in PICTURES for path in folder.glob(pattern))


class Progress:
    """How far a notebook has come, over ``total`` runs of equal length; one object a notebook.

    `update` takes the fraction of the current run, as does a call of the object, which can be handed to a function as
    its callback; `step` ends a run; `each` does so over a sequence. In JupyterLab it is a bar; the workflow names a
    file in ``STEELNB_PROGRESS_FILE``, to which the percentage of the whole is written.
    """

    def __init__(self, total: int = 1, description: str = "progress") -> None:
        from tqdm.auto import tqdm

        self._total, self._done, self._shown_s = max(total, 1), 0, -math.inf
        self._file = os.environ.get(PROGRESS_VARIABLE)
        form = "{desc}: {percentage:3.0f}% |{bar}| {elapsed} < {remaining}"
        self._bar: Any = tqdm(total=1.0, desc=description, bar_format=form, disable=self._file is not None)

    def update(self, fraction: float) -> None:
        """Say how much of the current run is done, 0 to 1. Shown at most five times a second."""
        whole = min((self._done + min(max(fraction, 0.0), 1.0)) / self._total, 1.0)
        now_s = time.monotonic()
        if whole < 1 and now_s - self._shown_s < PROGRESS_PERIOD_S:
            return
        self._shown_s = now_s
        if self._file:
            Path(self._file).write_text(f"{whole:.0%}", encoding="utf-8")
        self._bar.n = whole
        self._bar.refresh()
        if whole == 1:
            self._bar.close()

    __call__ = update

    def step(self) -> None:
        """End the current run; the next begins."""
        self._done += 1
        self.update(0.0)

    def each(self, items: Iterable[Item]) -> Iterator[Item]:
        """Give the items one by one, a run each."""
        for item in items:
            yield item
            self.step()
