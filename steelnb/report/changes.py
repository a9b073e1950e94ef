"""Changes of a known structure as a table, a picture and a line of text."""

from pathlib import Path

import numpy as np
import pandas as pd

from steelnb.fusion.changes import KINDS, Changes
from steelnb.report.style import COLOURS, INDIGO, LIGHT_GREY, PINK, Figure, draw_legend, draw_lines, end_points, style
from steelnb.report.three_views import three_views, upright_box
from steelnb.report.words import counted
from steelnb.types import Array

LOOKS = {
    "same": {"color": LIGHT_GREY, "lw": 1.0}, "not seen": {"color": LIGHT_GREY, "lw": 1.0, "ls": ":"},
    "moved": {"color": PINK, "lw": 2.4}, "bent": {"color": INDIGO, "lw": 2.4},
    "missing": {"color": COLOURS["wrong"], "lw": 2.4}, "new": {"color": COLOURS["right"], "lw": 2.4},
}  # fmt: skip
"""Of the bars by kind; nothing that has changed may lie below what has not."""


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


@style()
def figure_changes(changes: Changes, title: str) -> Figure:
    """The bars of the map and the new ones from the front, the side and in perspective, coloured by kind."""
    ends = end_points(changes.segments)
    figure, panels, project = three_views(ends.reshape(-1, 3), upright_box(ends.reshape(-1, 3)))
    for name, panel in panels.items():
        for kind, look in LOOKS.items():
            bars = project(ends[changes.of(kind)], name)
            draw_lines(panel, bars, colors=look["color"], linewidths=look["lw"], linestyles=look.get("ls", "-"))
    figure.set_figheight(figure.get_figheight() + 0.5)  # a legend of two rows
    draw_legend(figure, {f"{kind}: {len(changes.of(kind))}": look for kind, look in LOOKS.items()}, ncols=3)
    figure.suptitle(title, fontsize=12)
    return figure


def changes_line(changes: Changes) -> str:
    """The numbers of bars by kind, as a line of the summary of a run."""
    told = {kind: len(changes.of(kind)) for kind in KINDS}
    numbers = ", ".join(f"{number} {kind}" for kind, number in told.items() if number or kind in ("missing", "moved"))
    return f"changes   {counted(len(changes.known), 'bar')} of the map: {numbers}"
