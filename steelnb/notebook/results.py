"""The files that a notebook writes."""

import contextlib
import glob
import hashlib
import importlib.metadata
import json
import math
import numbers
import platform
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from steelnb.core.determinism import machine
from steelnb.core.errors import OutputError
from steelnb.core.files import new_folder, reading

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

EXPERIMENTS_FILE = Path("notebooks", "runs.toml")
RUNS = "runs.parquet"
"""The table of a study, in its folder."""
PACKAGES = ("steelnb", "numpy", "scipy", "pandas", "numba", "open3d", "open3d-cpu", "pybullet", "evo", "matplotlib")
PICTURES = ("fig_*.png", "structure_*.json")
TABLES = ("table.csv", "bands.csv", "clouds.csv", "curves.csv", "starts.csv", "timing.csv")
REQUIRED = ("metrics.json", "table.csv", "provenance.json")
"""The files that every notebook writes."""
RESULTS = ("metrics.json", "provenance.json", *TABLES, *PICTURES)
"""Patterns of the files that a notebook writes."""
WRITTEN = "files"
"""The list in provenance.json of the files that a notebook wrote."""


def write_results(
    results_dir: str | Path,
    *,
    table: "DataFrame",
    metrics: Mapping[str, float],
    figures: Mapping[str, "Figure"],
    timing: "DataFrame | None" = None,
    further: Mapping[str, "DataFrame"] | None = None,
    files: Mapping[str, Callable[[Path], object]] | None = None,
    provenance: Mapping[str, Any],
) -> None:
    """Write the results of a notebook into the folder ``results_dir``. If that is empty, only show the figures.

    ``table`` becomes table.csv (nine digits), ``metrics`` metrics.json (units in the keys, without numbers that are not
    finite, such as a mean of nothing), each figure fig_<name>.png, each table in ``further`` <name>.csv (four digits; a
    name of `TABLES`), ``timing`` timing.csv with a description of the machine, and ``provenance`` (settings, seeds; no
    times, hosts or paths) provenance.json, with versions and the hash of the lock. ``files`` maps further names, which
    start with ``structure_``, to functions that write them. Equal values give equal bytes. Files are written to a
    temporary folder and then renamed; the `earlier_files` are removed. Raises `OutputError`, and ValueError if a metric
    is no number."""
    if not str(results_dir):
        _show_in_rows(figures)
        return
    flat = {name: number for name, value in metrics.items() if math.isfinite(number := _number(name, value))}
    with new_folder(results_dir, stale=[glob.escape(name) for name in earlier_files(results_dir)]) as folder:
        write_json(folder / "metrics.json", flat)
        table.to_csv(folder / "table.csv", index=False, float_format="%.9g", lineterminator="\n")
        for name, own in (further or {}).items():
            own.to_csv(folder / f"{name}.csv", index=False, float_format="%.4g", lineterminator="\n")
        if timing is not None:
            described = timing if "machine" in timing else timing.assign(machine=machine())
            described.to_csv(folder / "timing.csv", index=False, float_format="%.9g", lineterminator="\n")
        for name, figure in figures.items():
            # Matplotlib would note its own version in the file.
            figure.savefig(folder / f"fig_{name.removeprefix('fig_')}.png", dpi=150, metadata={"Software": None})
        for name, write in (files or {}).items():
            write(folder / name)
        written = sorted(["provenance.json", *(path.name for path in folder.iterdir())])
        write_json(folder / "provenance.json", {**provenance, **environment(), WRITTEN: written})


def earlier_files(results_dir: str | Path) -> list[str]:
    """The names of the files that a notebook wrote into a folder before, as its provenance.json lists them.

    Raises `OutputError` if every run would replace a file that is not listed, such as a table of the user's or one of
    `make reproduce`, and `InputError` if provenance.json cannot be read.
    """
    folder, written = Path(results_dir), list[str]()
    if (path := folder / "provenance.json").exists():
        with reading(path, "the provenance of results"):
            written = [Path(name).name for name in json.loads(path.read_bytes()).get(WRITTEN, ())]
    for name in REQUIRED:
        if (folder / name).exists() and name not in written:
            raise OutputError(f"{folder / name}: not listed as written by a notebook; expected another folder")
    return written


def _show_in_rows(figures: Mapping[str, "Figure"]) -> None:
    """Show all figures, up to four in a row, since JupyterLab scrolls to the last cell after it has run all cells."""
    from IPython.core.pylabtools import print_figure
    from IPython.display import HTML, display

    look = "flex: 1 1 22%; min-width: 0; max-height: 24em; object-fit: contain"
    images = [print_figure(figure, base64=True) for figure in figures.values()]
    shown = "".join(f'<img style="{look}" src="data:image/png;base64,{image}">' for image in images)
    display(HTML(f'<div style="display: flex; flex-wrap: wrap; gap: 1em">{shown}</div>'))


def _number(name: str, value: Any) -> int | float:
    """A metric as a Python number. Raises ValueError if it is none."""
    if not isinstance(value, numbers.Real) or isinstance(value, bool):
        raise ValueError(f"metrics: {name} = {value!r}: expected a number")
    return int(value) if isinstance(value, numbers.Integral) else float(value)


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write a mapping as JSON with sorted keys. NumPy arrays become lists, settings become objects."""
    text = json.dumps(values, sort_keys=True, indent=2, ensure_ascii=False, allow_nan=False, default=_plain)
    path.write_text(text + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """Convert NumPy scalars and arrays and pydantic settings for JSON."""
    for method in ("model_dump", "tolist"):
        if hasattr(value, method):
            return getattr(value, method)()
    raise TypeError(f"provenance: {value!r}: expected numbers, texts, lists, tables or settings")


def find_root(start: Path | None = None) -> Path:
    """The nearest folder from ``start`` (default: the current one) upwards that holds ``notebooks/runs.toml``,
    else the project that contains the package."""
    start, project = (start or Path.cwd()).resolve(), Path(__file__).resolve().parents[2]
    folders = (start, *start.parents)
    return next((folder for folder in folders if (folder / EXPERIMENTS_FILE).is_file()), project)


def file_digest(path: Path) -> str | None:
    """SHA-256 of a file's content, or None if there is no file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


def environment() -> dict[str, Any]:
    """Versions of Python, the main packages and the C library, and the SHA-256 of the project's environment.lock."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    digest = file_digest(find_root() / "environment.lock")
    versions["c-library"] = "-".join(platform.libc_ver())  # its sine and exponential affect rounding
    return {"versions": versions, "environment_lock_sha256": digest}


def pictures(folder: Path) -> list[Path]:
    """The figures and structures in a folder, sorted by name."""
    return sorted(path for pattern in PICTURES for path in folder.glob(pattern))
