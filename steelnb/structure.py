"""`steelnb structure`: what a structure file holds, what differs between two, and the same in another format."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from steelnb.config import Tolerance
from steelnb.datatypes import Array, IntArray
from steelnb.exports import GROUPS, export_structure, orientation, read_structure
from steelnb.fusion.compare import Comparison, Mask, compare
from steelnb.fusion.structure import Structure
from steelnb.recordings import new_folder

COLUMNS = ("what", "change", "a", "b", "offset_m", "angle_deg", "end_m", "length_m", "x_m", "y_m", "z_m")
MOST_ROWS = 40
"""Differences that are printed; the file holds all."""


@dataclass(frozen=True)
class StructureReport:
    """What `compare_files` found. ``table`` has a row for each difference and the columns `COLUMNS`: ``a`` and ``b``
    number the bar or joint in each file; place and length are those in the first file that has it."""

    comparison: Comparison
    table: pd.DataFrame
    summary: tuple[str, ...]


def describe_file(path: Path | str) -> tuple[str, ...]:
    """What a structure file holds, as lines of text. Raises the errors of `read_structure`."""
    return _described(Path(path).name, read_structure(path))


def convert_file(path: Path | str, target: Path | str, *, overwrite: bool = False) -> tuple[Path, ...]:
    """Write the structure of a JSON file in the format that the ending of ``target`` names, and give the files written.

    Raises the errors of `read_structure` and of `export_structure`.
    """
    return export_structure(read_structure(path), target, overwrite=overwrite, about={"source": Path(path).name})


def compare_files(
    path_a: Path | str, path_b: Path | str, output: Path | str | None = None, tolerance: Tolerance | None = None
) -> StructureReport:
    """Compare two structure files; with ``output``, write ``differences.csv`` and ``differences.png`` to that folder.

    Raises the errors of `read_structure`, `SettingsError` and `OutputError`; nothing is written then.
    """
    path_a, path_b, limit = Path(path_a), Path(path_b), tolerance or Tolerance()
    a, b = read_structure(path_a), read_structure(path_b)
    found = compare(a, b, limit)
    table = differences(a, b, found)
    lines = [f"A {line}" for line in _described(path_a.name, a)] + [f"B {line}" for line in _described(path_b.name, b)]
    lines += _counts(found, limit)
    lines += _printed(table)
    if output:
        with new_folder(Path(output)) as folder:
            table.to_csv(folder / "differences.csv", index=False, float_format="%.4f", lineterminator="\n")
            if len(a) or len(b):
                from steelnb.figures.structures import figure_comparison

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
    graph = structure.graph()
    return (
        f"{name}: {len(structure)} bars ({', '.join(shares)}), {length.sum():.1f} m; {len(structure.joint)} joints, "
        f"{graph.number_of_edges()} pieces of bars between them",
        *([f"empty     {structure.reason}"] if structure.reason else []),
    )


def _counts(found: Comparison, limit: Tolerance) -> list[str]:
    bars = (len(found.bar), found.bar_moved.sum(), 0, len(found.bar_missing), len(found.bar_extra))
    joints = (
        len(found.joint), found.joint_moved.sum(), found.joint_retied.sum(), len(found.joint_missing),
        len(found.joint_extra),
    )  # fmt: skip
    off = found.deviation
    lines = [f"          {'':8}{'in both':>9}{'moved':>9}{'retied':>9}{'missing':>9}{'extra':>9}"]
    lines += [
        f"          {name:8}" + "".join(f"{n:9d}" for n in of) for name, of in (("bars", bars), ("joints", joints))
    ]
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
    heads = ("", "", "A", "B", "axis m", "angle °", "end m", "length m", "at x", "y", "z")
    rows = [heads]
    for row in table.head(MOST_ROWS).itertuples(index=False):
        numbers = ("-" if pd.isna(v) else str(v) for v in row[2:4])
        decimals = (3, 2, 3, 2, 2, 2, 2)
        values = ("-" if pd.isna(v) else f"{v:.{n}f}" for v, n in zip(row[4:], decimals, strict=True))
        rows.append((*row[:2], *numbers, *values))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(
            [cell.ljust(w) for cell, w in zip(row[:2], widths[:2], strict=True)]
            + [cell.rjust(w) for cell, w in zip(row[2:], widths[2:], strict=True)]
        )
        for row in rows
    ]
    left = len(table) - MOST_ROWS
    return [*(line.rstrip() for line in lines), *([f"and {left} more; -o FOLDER writes all"] if left > 0 else [])]
