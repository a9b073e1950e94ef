"""What an experiment leaves behind: writing, merging and comparing results, and telling how far a notebook has come."""

import contextlib
import csv
import fnmatch
import hashlib
import importlib.metadata
import io
import json
import math
import numbers
import os
import platform
import shutil
import subprocess
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from steelnb.errors import FileMissingError, OutputError
from steelnb.project import CheckSettings, find_root, lock_digest

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from steelnb.fusion.structure import Structure

PROGRESS_VARIABLE = "STEELNB_PROGRESS_FILE"
PROGRESS_PERIOD_S = 0.2
ABSOLUTE_FLOOR = 1e-12
PACKAGES = ("steelnb", "numpy", "scipy", "pandas", "numba", "open3d", "open3d-cpu", "pybullet", "evo", "matplotlib")
Item = TypeVar("Item")


def write_results(
    results_dir: str | Path,
    *,
    table: "DataFrame",
    metrics: Mapping[str, float],
    figures: Mapping[str, "Figure"],
    timing: "DataFrame | None" = None,
    structures: "Mapping[str, Structure] | None" = None,
    provenance: Mapping[str, Any],
) -> None:
    """Write what a notebook found into the folder ``results_dir``; write nothing if that is empty.

    ``table`` becomes table.csv (nine digits), ``metrics`` metrics.json (finite numbers, units in the keys), each figure
    fig_<name>.png, ``timing`` timing.csv with the machine's description, ``provenance`` (settings, seeds; no times,
    hosts or paths) provenance.json, to which versions and the hash of the lock are added, and each structure
    structure_<name>.json and .glb (no .glb for one without bars). The same values give the same bytes. Files are
    written beside and then renamed. Raises `OutputError`, and ValueError for a metric not finite.
    """
    if not str(results_dir):
        return
    flat = {name: _finite(name, value) for name, value in metrics.items()}
    with beside(Path(results_dir)) as folder:
        _write_json(folder / "metrics.json", flat)
        _write_json(folder / "provenance.json", {**provenance, **environment()})
        table.to_csv(folder / "table.csv", index=False, float_format="%.9g", lineterminator="\n")
        if timing is not None:
            described = timing if "machine" in timing else timing.assign(machine=machine())
            described.to_csv(folder / "timing.csv", index=False, float_format="%.9g", lineterminator="\n")
        for name, figure in figures.items():
            # Matplotlib would note its own version in the file.
            figure.savefig(folder / f"fig_{name.removeprefix('fig_')}.png", dpi=150, metadata={"Software": None})
        for name, structure in (structures or {}).items():
            from steelnb.exports import export_structure

            for ending in ("json", "glb") if len(structure) else ("json",):
                export_structure(structure, folder / f"structure_{name}.{ending}")


def _finite(name: str, value: Any) -> int | float:
    """A metric as a Python number; ValueError if it is none or not finite."""
    if not isinstance(value, numbers.Real) or isinstance(value, bool) or not math.isfinite(value):
        raise ValueError(f"metrics: {name} = {value!r}: expected a finite number")
    return int(value) if isinstance(value, numbers.Integral) else float(value)


def _write_json(path: Path, values: Mapping[str, Any]) -> None:
    text = json.dumps(values, sort_keys=True, indent=2, ensure_ascii=False, allow_nan=False, default=_plain)
    path.write_text(text + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """NumPy scalars and arrays and pydantic settings for JSON."""
    for method in ("model_dump", "tolist"):
        if hasattr(value, method):
            return getattr(value, method)()
    raise TypeError(f"provenance: {value!r}: expected numbers, texts, lists, tables or settings")


def environment() -> dict[str, Any]:
    """Versions of Python and the main packages, and the SHA-256 of the project's environment.lock."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    try:
        digest = lock_digest(find_root())
    except FileMissingError:
        digest = None
    return {"versions": versions, "environment_lock_sha256": digest}


def machine() -> str:
    """The processor, cores and system that measured times belong to; no host name."""
    model = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
    return f"{model}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"


@contextlib.contextmanager
def beside(target: Path) -> Iterator[Path]:
    """A folder beside ``target`` to write into; at the end its files replace the results in ``target``.

    Files in ``target`` that are no results stay. On an error nothing in ``target`` changes. Raises `OutputError`.
    """
    target = target.absolute()
    folder = target.with_name(f".{target.name}.new")
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        yield folder
        if not target.exists():
            os.replace(folder, target)
            return
        kept = {path.name for path in folder.iterdir()}
        for path in [*folder.iterdir()]:
            os.replace(path, target / path.name)
        for path in result_files(target):
            if path.name not in kept:
                path.unlink()
    except OSError as fault:
        raise OutputError(f"{target}: cannot be written: {fault.strerror or fault}") from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def result_files(folder: Path) -> list[Path]:
    """The files in a folder that `write_results` or `merge` wrote, sorted by name."""
    names = [folder / name for name in ("metrics.json", "provenance.json", "table.csv", "timing.csv")]
    return sorted([path for path in names if path.is_file()] + pictures(folder))


def pictures(folder: Path) -> list[Path]:
    """The figures and structures in a folder."""
    return [path for pattern in ("fig_*.png", "structure_*.json", "structure_*.glb") for path in folder.glob(pattern)]


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of each result file; of timing.csv only that it is there, since measured times always differ."""
    return {
        path.name: "" if path.name == "timing.csv" else hashlib.sha256(path.read_bytes()).hexdigest()
        for path in result_files(folder)
    }


def merge(parts: Mapping[str, Path], target: Path, about: Mapping[str, Any]) -> None:
    """Make one result of the results of the parts (name → folder, in order). Raises `OutputError`.

    Tables are joined, metrics are prefixed ``<part>.``, figures and structures suffixed ``_<part>``, and ``about`` is
    added to provenance.json. The single part of an experiment has an empty name and leaves no prefix.
    """
    metrics: dict[str, Any] = {}
    provenance: dict[str, Any] = {}
    with beside(target) as folder:
        for name, source in parts.items():
            values = json.loads((source / "metrics.json").read_text(encoding="utf-8"))
            metrics.update({f"{name}.{key}" if name else key: value for key, value in values.items()})
            provenance[name or "all"] = json.loads((source / "provenance.json").read_text(encoding="utf-8"))
            for path in pictures(source):
                shutil.copyfile(path, folder / (f"{path.stem}_{name}{path.suffix}" if name else path.name))
        for file in ("table.csv", "timing.csv"):
            tables = [source / file for source in parts.values() if (source / file).is_file()]
            if tables:
                _join_tables(tables, folder / file)
        _write_json(folder / "metrics.json", metrics)
        _write_json(folder / "provenance.json", {**about, "parts": provenance})


def _join_tables(sources: Sequence[Path], target: Path) -> None:
    """Join CSV files below one header, which has every column of any of them; the text of the cells is kept."""
    tables = [read_table(path.read_text(encoding="utf-8")) for path in sources]
    header = list(dict.fromkeys(column for columns, _ in tables for column in columns))
    with target.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, header, lineterminator="\n")
        writer.writeheader()
        for _, rows in tables:
            writer.writerows(rows)


def read_table(text: str) -> tuple[list[str], list[dict[str, str]]]:
    """Columns and rows of a CSV text, every cell as text."""
    reader = csv.DictReader(io.StringIO(text, newline=""))
    return list(reader.fieldnames or []), list(reader)


@dataclass(frozen=True)
class Difference:
    """A value that is not what was committed. ``name`` is ``<id>.<metric or column>``; ``reason`` excuses it."""

    name: str
    where: str
    committed: str
    now: str
    reason: str = ""


def compare(
    experiment: str, committed: Mapping[str, str], now: Mapping[str, str], settings: CheckSettings
) -> list[Difference]:
    """Every difference between two results, given as the texts of metrics.json and table.csv.

    Numbers agree within the settings' tolerance, relative (1e-12 absolute), texts if they are equal; a key, row or
    column that only one side has is a difference.
    """
    before, after = json.loads(committed["metrics.json"]), json.loads(now["metrics.json"])
    pairs = [(name, "", before.get(name), after.get(name)) for name in sorted({*before, *after})]
    (columns_before, rows_before), (columns_after, rows_after) = (read_table(m["table.csv"]) for m in (committed, now))
    if len(rows_before) != len(rows_after):
        pairs.append(("table.csv", "rows", len(rows_before), len(rows_after)))
    for index, (row_before, row_after) in enumerate(zip(rows_before, rows_after, strict=False), start=1):
        for column in dict.fromkeys([*columns_before, *columns_after]):
            pairs.append((column, f"row {index}", row_before.get(column), row_after.get(column)))
    return differing(experiment, pairs, settings)


def differing(experiment: str, pairs: Iterable[tuple[str, str, Any, Any]], settings: CheckSettings) -> list[Difference]:
    """The differences among values given as (name, where, committed, now), None for a missing one."""
    found = []
    for name, where, old, new in pairs:
        if not _agree(old, new, settings.relative_tolerance):
            full = f"{experiment}.{name}"
            before_text, after_text = ("missing" if value is None else str(value) for value in (old, new))
            reasons = (reason for pattern, reason in settings.exceptions.items() if fnmatch.fnmatchcase(full, pattern))
            found.append(Difference(full, where, before_text, after_text, next(reasons, "")))
    return found


def _agree(before: Any, after: Any, tolerance: float) -> bool:
    try:
        first, second = float(before), float(after)
    except (TypeError, ValueError):
        return bool(before == after)
    return before == after or math.isclose(first, second, rel_tol=tolerance, abs_tol=ABSOLUTE_FLOOR)


def committed_text(root: Path, path: str) -> str:
    """The text of a file of the project in the last commit, else in the tree. Raises `FileMissingError`."""
    return committed_bytes(root, path).decode()


def committed_bytes(root: Path, path: str) -> bytes:
    """The content of a file of the project in the last commit, else in the tree. Raises `FileMissingError`."""
    with contextlib.suppress(OSError):
        shown = subprocess.run(["git", "show", f"HEAD:./{path}"], cwd=root, capture_output=True, check=False)
        if shown.returncode == 0:
            return shown.stdout
    try:
        return (root / path).read_bytes()
    except OSError:
        raise FileMissingError(f"{root / path}: nothing to compare with; run `steelnb reproduce` first") from None


def estimate(parts: Sequence[tuple[float | None, float, float]], workers: int) -> tuple[float, float | None]:
    """Fraction done and seconds left (None if unknown) of parts given as (expected seconds, elapsed seconds, fraction).

    A part that has come some way is extrapolated; one of which nothing is known counts as the mean of the others.
    """
    totals = [
        elapsed / fraction if fraction > 0.05 else max(expected, elapsed) if expected else None
        for expected, elapsed, fraction in parts
    ]
    known = [total for total in totals if total]
    if not known:
        return sum(fraction for _, _, fraction in parts) / max(len(parts), 1), None
    mean = sum(known) / len(known)
    spent = [elapsed for _, elapsed, _ in parts]
    left = [max((total or mean) - elapsed, 0.0) for total, elapsed in zip(totals, spent, strict=True)]
    return sum(spent) / max(sum(spent) + sum(left), 1e-9), max(sum(left) / workers, max(left))


class Progress:
    """How far a notebook has come, over ``total`` runs of equal length; one object a notebook.

    `update` takes the fraction of the current run, and is also what calling the object does, so that it can be handed
    to a function as its callback; `step` ends a run; `each` does so over a sequence. In JupyterLab it is a bar; below
    `steelnb reproduce`, which names a file in ``STEELNB_PROGRESS_FILE``, the fraction of the whole is written there.
    """

    def __init__(self, total: int = 1, description: str = "") -> None:
        self._total, self._done, self._shown_s = max(total, 1), 0, -math.inf
        self._file = os.environ.get(PROGRESS_VARIABLE)
        self._bar: Any = None
        if not self._file:
            from tqdm.auto import tqdm

            form = "{desc}: {percentage:3.0f}% |{bar}| {elapsed} < {remaining}"
            self._bar = tqdm(total=1.0, desc=description or "progress", bar_format=form)

    def update(self, fraction: float) -> None:
        """Say how much of the current run is done, 0 to 1. Shown at most five times a second."""
        whole = min((self._done + min(max(fraction, 0.0), 1.0)) / self._total, 1.0)
        now_s = time.monotonic()
        if whole < 1 and now_s - self._shown_s < PROGRESS_PERIOD_S:
            return
        self._shown_s = now_s
        if self._file:
            # The folder vanishes when the run is interrupted; that is no fault of the notebook's.
            with contextlib.suppress(OSError):
                Path(self._file).write_text(f"{whole:.4f}", encoding="utf-8")
        else:
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
