"""Cached outputs of parts → results/<id>/, and the overviews in results/README.md and docs/report.md."""

import itertools
import json
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from steelnb.core.errors import InputError
from steelnb.core.files import new_folder
from steelnb.notebook.results import RESULTS, TABLES, WRITTEN, find_root, pictures, write_json
from workflow.experiments import Part, read_experiments
from workflow.run_notebooks import part_folder, run

BEGIN, END = "<!-- table -->", "<!-- /table -->"
BANDS = ("segmentation-odometry-draws", "cloud-odometry-draws")
"""Experiments whose bands docs/report.md shows."""


def write(parts: Sequence[Part], folder: Path, cache: Path, arrays: Path, budget: str, jobs: int) -> int:
    """Run what is out of date, write ``folder/<id>/``, and print what was written or failed. Returns the exit code."""
    faults = run(parts, cache, arrays, jobs)
    for id, some in itertools.groupby(parts, lambda part: part.id):
        own = list(some)
        ran = [part.label for part in own if part.label in faults]
        if not any(faults[label] for label in ran):
            merge(own, cache, folder / id, budget)
            if ran:
                print(f"{os.path.relpath(folder / id)}/ written")
    write_overview(find_root(), folder)
    failures = [fault for fault in faults.values() if fault]
    for fault in failures:
        print("error:", " ".join(str(fault).split()), file=sys.stderr)
    if not faults:
        print("everything is up to date")
    return 0 if not failures else 2 if all(isinstance(fault, InputError) for fault in failures) else 1


def merge(parts: Sequence[Part], cache: Path, target: Path, budget: str) -> None:
    """Merge the results of the parts of an experiment. Raises `OutputError`.

    Tables are concatenated. Metrics get the prefix ``<part>.``, figures and structures the suffix ``_<part>``; a part
    without a name adds neither.
    """
    metrics: dict[str, Any] = {}
    provenance: dict[str, Any] = {}
    folders = {part.name: part_folder(cache, part) for part in parts}
    with new_folder(target, stale=RESULTS) as folder:
        for part, kept in folders.items():
            values = json.loads((kept / "metrics.json").read_text(encoding="utf-8"))
            metrics |= {f"{part}.{name}" if part else name: value for name, value in values.items()}
            provenance[kept.name] = json.loads((kept / "provenance.json").read_text(encoding="utf-8"))
            provenance[kept.name].pop(WRITTEN, None)  # pictures have other names here
            for path in pictures(kept):
                shutil.copyfile(path, folder / (f"{path.stem}_{part}{path.suffix}" if part else path.name))
        for name in TABLES:
            tables = [kept / name for kept in folders.values() if (kept / name).is_file()]
            if tables:  # the text of the cells is kept
                joined = pd.concat([pd.read_csv(table, dtype=str, keep_default_na=False) for table in tables])
                joined.to_csv(folder / name, index=False, lineterminator="\n")
        about = {"experiment": parts[0].id, "notebook": parts[0].notebook.name, "budget": budget}
        write_json(folder / "metrics.json", metrics)
        write_json(folder / "provenance.json", {**about, "parts": provenance})


def write_overview(root: Path, folder: Path) -> None:
    """Write one row per experiment with results below ``folder`` into its README.md, and the report's plots beside
    their bands into docs/report.md, if these pages are there."""
    rows = ["| Experiment | Notebook | Figures | Numbers |", "|---|---|---|---|"]
    for id, each in read_experiments(root).items():
        if (folder / id / "metrics.json").is_file():
            figures = [path.stem for path in sorted((folder / id).glob("*.png"))]
            shown = " ".join(
                f'<img src="{id}/{name}.png" width="240" alt="{each.title}: {name.removeprefix("fig_")}">'
                for name in figures
            )
            title = f"**{each.title}.** {each.about}" + f" The report's figures: {each.figures}." * bool(each.figures)
            notebook = f"[{each.notebook[:2]}](../notebooks/{each.notebook})"
            rows.append(f"| {title} | {notebook} | {shown} | [metrics]({id}/metrics.json), [table]({id}/table.csv) |")
    _fill(folder / "README.md", rows)
    if folder == root / "results":
        flown = [folder / id for id in BANDS if (folder / id / "bands.csv").is_file()]
        _fill(root / "docs" / "report.md", _report_rows(flown))


def _report_rows(folders: Sequence[Path]) -> list[str]:
    """The rows of docs/report.md, from folders with tables of `notebook.report.band_table`. Metrics have all digits of
    their numbers."""
    head = "| plot | the report: mean / max / end | ours: mean (10 to 90 %) / max / end | below | shape | agrees |"
    rows = [head, "|---|---|---|---|---|---|"]
    for folder in folders:
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        for row in pd.read_csv(folder / "bands.csv").itertuples():
            part = row.plot.split()[1]  # metrics name 3.3's flight as the matrix does, `orbit`
            names = f"{part}-{row.sensor}.band.{row.method}.", f"{row.noise}-{row.sensor}.band.{row.plot}."
            value = {k.rpartition(".")[2]: value for k, value in metrics.items() if k.startswith(names)}
            numbers = (
                "{report_mean_m:.3f} / {report_max_m:.3f} / {report_final_m:.3f} | {mean_m:.3f} ({mean_low_m:.3f} to "
                "{mean_high_m:.3f}) / {max_m:.3f} / {final_m:.3f} | {share_below:.0%} | {correlation:.2f}"
            ).format_map(value)
            rows.append(f"| {row.plot} | {numbers} | {'yes' if row.as_in_the_report else 'no'} |")
    return rows


def _fill(page: Path, rows: Sequence[str]) -> None:
    """Write rows between the marks of a page, if it is there."""
    if page.is_file():
        before, _, rest = page.read_text(encoding="utf-8").partition(BEGIN)
        page.write_text("\n".join([before + BEGIN, "", *rows, "", END + rest.partition(END)[2]]), encoding="utf-8")
