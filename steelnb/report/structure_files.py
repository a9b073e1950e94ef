"""`steelnb structure`: contents of a structure file, differences between two, and conversion to other formats."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from steelnb.files import new_folder
from steelnb.fusion.differences import Comparison, Mask, compare_structures
from steelnb.fusion.structure import Structure
from steelnb.io.segments import GROUPS, orientation
from steelnb.io.structures import read_structure, write_structure
from steelnb.report.words import counted
from steelnb.settings import Tolerance
from steelnb.types import Array, IntArray

COLUMNS = ("what", "change", "a", "b", "offset_m", "angle_deg", "end_m", "length_m", "x_m", "y_m", "z_m")
MOST_ROWS = 40
"""Differences that are printed; the file holds all."""


@dataclass(frozen=True)
class StructureReport:
    """Result of `compare_files`. ``table`` has a row for each difference and the columns `COLUMNS`: ``a`` and ``b``
    number the bar or joint in each file; place and length are those in the first file that has it."""

    comparison: Comparison
    table: pd.DataFrame
    summary: tuple[str, ...]


def describe_file(path: Path | str) -> tuple[str, ...]:
    """Contents of a structure file as lines of text. Raises the errors of `read_structure`."""
    return _described(Path(path).name, read_structure(path))


def convert_file(path: Path | str, target: Path | str, *, overwrite: bool = False) -> tuple[Path, ...]:
    """Write the structure of a JSON file in the format that the ending of ``target`` names, and give the files written.

    Raises the errors of `read_structure` and of `write_structure`.
    """
    return write_structure(read_structure(path), target, overwrite=overwrite, about={"source": Path(path).name})


def compare_files(
    path_a: Path | str, path_b: Path | str, output: Path | str | None = None, tolerance: Tolerance | None = None
) -> StructureReport:
    """Compare two structure files; with ``output``, write ``differences.csv`` and ``differences.png`` to that folder.

    Raises the errors of `read_structure`, `SettingsError` and `OutputError`; nothing is written then.
    """
    path_a, path_b, limit = Path(path_a), Path(path_b), tolerance or Tolerance()
    a, b = read_structure(path_a), read_structure(path_b)
    found = compare_structures(a, b, limit)
    table = differences(a, b, found)
    lines = [f"A {line}" for line in _described(path_a.name, a)] + [f"B {line}" for line in _described(path_b.name, b)]
    lines += _counts(found, limit) + _printed(table)
    if output:
        with new_folder(output) as folder:
            table.to_csv(folder / "differences.csv", index=False, float_format="%.4f", lineterminator="\n")
            if len(a) or len(b):
                from steelnb.report.three_views import figure_comparison

                title = f"A {path_a.name} → B {path_b.name}"
                figure_comparison(a, b, found, title).savefig(folder / "differences.png", dpi=150)
        lines.append(f"written   {output}/: differences.csv{', .png' if len(a) or len(b) else ''}")
    return StructureReport(found, table, tuple(lines))


def differences(a: Structure, b: Structure, found: Comparison) -> pd.DataFrame:
    """A row for each bar and joint that is missing, extra, moved or tied otherwise; the most moved first."""
    rows: list[tuple] = []

    def bar(change: str, i: int | None, j: int | None, *off: float) -> None:
        one, k = (a, i) if i is not None else (b, j)
        s, at = one.segments, one.segments.middle[k]
        rows.append(("bar", change, i, j, *(off or (np.nan,) * 3), float(s.length[k]), *at.tolist()))

    def joint(change: str, i: int | None, j: int | None, distance: float = np.nan) -> None:
        at = a.joint[i] if i is not None else b.joint[j]
        rows.append(("joint", change, i, j, distance, np.nan, np.nan, np.nan, *at.tolist()))

    off = found.deviation
    for i in found.bar_missing.tolist():
        bar("missing", i, None)
    for j in found.bar_extra.tolist():
        bar("extra", None, j)
    for k in _largest_first(off.end_m, found.bar_moved):
        bar("moved", *found.bar[k].tolist(), float(off.offset_m[k]), float(off.angle_deg[k]), float(off.end_m[k]))
    for i in found.joint_missing.tolist():
        joint("missing", i, None)
    for j in found.joint_extra.tolist():
        joint("extra", None, j)
    for k in _largest_first(found.joint_distance_m, found.joint_moved):
        joint("moved", int(found.joint[k, 0]), int(found.joint[k, 1]), float(found.joint_distance_m[k]))
    for k in np.flatnonzero(found.joint_retied):
        joint("retied", int(found.joint[k, 0]), int(found.joint[k, 1]), float(found.joint_distance_m[k]))
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype({"a": "Int64", "b": "Int64"})


def _largest_first(value: Array, chosen: Mask) -> IntArray:
    index = np.flatnonzero(chosen).astype(np.int64)
    return index[np.argsort(-value[index], kind="stable")]


def _described(name: str, structure: Structure) -> tuple[str, ...]:
    groups, length = orientation(structure.segments), structure.segments.length
    shares = [f"{groups.count(group)} {group.replace('_', ' ')}" for group in GROUPS]
    return (
        f"{name}: {counted(len(structure), 'bar')} ({', '.join(shares)}), {length.sum():.1f} m; "
        f"{counted(len(structure.joint), 'joint')}, {counted(structure.graph().number_of_edges(), 'piece')} of bars "
        "between them",
        *([f"empty     {structure.reason}"] if structure.reason else []),
    )


def _counts(found: Comparison, limit: Tolerance) -> list[str]:
    counts = pd.DataFrame(
        {
            "in both": (len(found.bar), len(found.joint)),
            "moved": (found.bar_moved.sum(), found.joint_moved.sum()),
            "retied": (0, found.joint_retied.sum()),
            "missing": (len(found.bar_missing), len(found.joint_missing)),
            "extra": (len(found.bar_extra), len(found.joint_extra)),
        },
        index=["bars", "joints"],
    )
    off = found.deviation
    lines = [f"          {line}" for line in counts.to_string(col_space=8).splitlines()]
    lines.append(
        f"moved     bars: axis by more than {limit.offset_m:g} m or {limit.angle_deg:g}°, or an end by more than "
        f"{limit.end_m:g} m; joints: {limit.joint_m:g} m"
    )
    if len(found.bar):
        lines.append(
            f"medians   of the bars in both: axis {np.median(off.offset_m):.4f} m, {np.median(off.angle_deg):.2f}°, "
            f"ends {np.median(off.end_m):.4f} m"
        )
    lines.append("result    " + ("equal within the tolerances" if found.equal else "DIFFERENT"))
    return lines


def _printed(table: pd.DataFrame) -> list[str]:
    if table.empty:
        return []
    text = table.head(MOST_ROWS).round(3).astype(object)
    left = len(table) - MOST_ROWS
    lines = text.where(text.notna(), "-").to_string(index=False).splitlines()
    return [*lines, *([f"and {left} more; -o FOLDER writes all"] if left > 0 else [])]
