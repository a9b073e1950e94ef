"""Changes of a known structure as a table and a line of text."""

from pathlib import Path

import numpy as np
import pandas as pd

from steelnb.fusion.changes import KINDS, Changes
from steelnb.report.style import end_points
from steelnb.report.words import counted
from steelnb.types import Array


def write_changes(changes: Changes, path: Path, origin: Array) -> None:
    """Write ``changes.csv``: a row for each bar of the map, numbered as in its file, and then for each new one.

    ``origin (3,)``, metres, is added to the ends. Where a bar is missing or not seen, its offset is empty.
    """
    ends = end_points(changes.segments) + origin
    table = pd.DataFrame({"bar": np.arange(len(changes.kind)), "kind": changes.kind})
    for name in ("offset_m", "sigma_m"):
        table[name] = [f"{value:.4f}" if np.isfinite(value) else "" for value in getattr(changes, name)]
    table["significance"] = [f"{value:.3g}" if np.isfinite(value) else "" for value in changes.significance]
    for e, end in enumerate(("start", "end")):
        for axis, name in enumerate("xyz"):
            table[f"{end}_{name}_m"] = ends[:, e, axis].round(4)
    table.to_csv(path, index=False, lineterminator="\n")


def changes_line(changes: Changes) -> str:
    """The numbers of bars by kind, as a line of the summary of a run."""
    told = {kind: len(changes.of(kind)) for kind in KINDS}
    numbers = ", ".join(f"{number} {kind}" for kind, number in told.items() if number or kind in ("missing", "moved"))
    return f"changes   {counted(len(changes.known), 'bar')} of the map: {numbers}"
