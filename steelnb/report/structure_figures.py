"""Figures of bars over a tower: maps and structures (Figures 3.4 and 5.1), errors, recall, near side and goals."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from numpy.typing import NDArray

from steelnb.batch import caption
from steelnb.plots import (
    BLACK,
    BLUE,
    COLOURS,
    DARK_GREY,
    GREY,
    LABELS,
    SKY,
    Figure,
    draw_bars,
    draw_legend,
    draw_sample,
    end_points,
    frame_perspective,
    project_perspective,
    style,
)
from steelnb.report.structure_tables import Rebuilt, StructureFlight
from steelnb.report.words import worded
from steelnb.simulation import Tower
from steelnb.types import Array

POSES = {"raw": "drifting poses", "corrected": "corrected poses", "true": "true poses"}
AXES = {"middle of points": SKY, "section fitted": BLUE}
MARKERS = {"final": "o", "incremental": "s"}
TOWER_IN = 7.0
OBSERVED_FROM = 100  # points


def figure_structures(runs: Sequence[Rebuilt]) -> Figure:
    """The structure of each run over the true members (`figure_bars`); joints are dots."""
    panels = {
        f"{POSES[run.poses]}, {run.method}\nrecall {run.score.metrics['recall']:.0%}":
        (end_points(run.structure.segments), run.score.member >= 0, run.structure.joint)
        for run in runs
    }  # fmt: skip
    return figure_bars(runs[0].source.result.truth.tower, panels, _caption(runs[0].source))


@style()
def figure_bars(
    tower: Tower, panels: Mapping[str, tuple[Array, NDArray[np.bool_], Array | None]], title: str
) -> Figure:
    """Bars ``(M, 2, 3)``, whether each is right ``(M,)``, and joints ``(J, 3)`` over the true members (grey), a panel
    for each heading, in perspective.

    Bars within 5° and 10 cm of a true member along half their length are right, the others wrong.
    """
    figure, axes = _panels(tower, len(panels))
    for panel, (heading, (bars, right, joints)) in zip(axes, panels.items(), strict=True):
        draw_bars(panel, bars[~right], tower.vertices, colors=COLOURS["wrong"], linewidths=1.3, zorder=2)
        draw_bars(panel, bars[right], tower.vertices, colors=COLOURS["right"], linewidths=1.5, zorder=3)
        if joints is not None:
            at = project_perspective(joints, tower.vertices)
            panel.plot(at[:, 0], at[:, 1], "o", color=BLACK, markersize=2.4, zorder=4)
        counts = f"{np.count_nonzero(right)} on a member, {np.count_nonzero(~right)} not"
        counts += "" if joints is None else f", {len(joints)} joints"
        panel.set_title(f"{heading}\n{counts}", fontsize=11)
    labels = {"on a member": "right", "on none": "wrong", "true member": "member"}
    draw_legend(figure, {label: {"color": COLOURS[key], "lw": 2} for label, key in labels.items()})
    figure.suptitle(title)
    return figure


@style()
def figure_errors(runs: Sequence[Rebuilt]) -> Figure:
    """Each run's bars coloured by the distance of their axis to the member's, up to 3 cm, in perspective.

    Bars on no member are black and dashed, members that were observed and not found thick and dark grey.
    """
    colours = ListedColormap(colormaps["plasma"](np.linspace(0, 0.87, 256)))  # no yellow, which paper hides
    scale, tower = Normalize(0, 3), runs[0].source.result.truth.tower
    figure, panels = _panels(tower, len(runs))
    for panel, run in zip(panels, runs, strict=True):
        right, bars, truth = run.score.member >= 0, end_points(run.structure.segments), run.source.reference
        shades = colours(scale(100 * run.score.offset_m[right]))
        missed = truth.axes[truth.observed & ~run.score.found]
        draw_bars(panel, missed, tower.vertices, colors=GREY, linewidths=2.6, zorder=2)
        draw_bars(panel, bars[right], tower.vertices, colors=shades, linewidths=2.0, zorder=3)
        draw_bars(panel, bars[~right], tower.vertices, colors=BLACK, linewidths=1.3, linestyles="--", zorder=4)
        median, p90 = (100 * run.score.metrics[f"offset_{name}_m"] for name in ("median", "p90"))
        panel.set_title(f"{POSES[run.poses]}\nmedian {median:.1f} cm, p90 {p90:.1f} cm")
    figure.colorbar(
        ScalarMappable(scale, colours), ax=list(panels), shrink=0.6, pad=0.02, extend="max",
        label="distance of a bar's axis to the true axis (cm)",
    )  # fmt: skip
    keys = {
        "true member": {"color": COLOURS["member"], "lw": 1},
        "observed, not found": {"color": GREY, "lw": 2.6},
        "bar on no member": {"color": BLACK, "lw": 1.5, "ls": "--"},
    }
    draw_legend(figure, keys, ncols=3 if len(runs) > 1 else 2)
    figure.suptitle(_caption(runs[0].source, ",\n"))
    return figure


def _caption(source: StructureFlight, end: str = ", ") -> str:
    """The flight, the tower and the method that corrected the poses of a structure."""
    method = LABELS[source.result.settings.odometry.method]
    return f"{caption([source.result])}{end}tower {source.tower}, poses corrected by {method}"


def _panels(tower: Tower, count: int) -> tuple[Figure, list[Axes]]:
    """Panels side by side, each with the true members in grey."""
    width, height = np.ptp(project_perspective(tower.vertices, tower.vertices), axis=0)
    figure = Figure(figsize=(count * max(width * TOWER_IN / height + 0.3, 3.7) + 0.8, TOWER_IN + 1.8))
    panels = list(figure.subplots(1, count, squeeze=False)[0])
    for panel in panels:
        draw_bars(panel, tower.axes, tower.vertices, colors=COLOURS["member"], linewidths=0.8, zorder=1)
        frame_perspective(panel, tower.vertices)
    return figure, panels


@style()
def figure_recall(table: pd.DataFrame, source: StructureFlight) -> Figure:
    """Recall against the points seen of a member, a line for each poses and method, from `recall_by_points`.

    Lines have the colour of the method that corrected the poses of ``source``, or of none.
    """
    methods = {"raw": "none", "corrected": source.result.settings.odometry.method, "true": "truth"}
    figure = Figure(figsize=(8.2, 5.6))
    panel = figure.add_subplot()
    table = table.assign(middle=np.sqrt(table["points_from"] * table["points_to"]))
    for (poses, method), rows in table.groupby(["poses", "method"], sort=False):
        colour = COLOURS[methods[str(poses)]]
        true, final = poses == "true", method == "final"
        panel.plot(
            rows["middle"], 100 * rows["recall"], color=colour, linestyle="-" if final else "--",
            marker=MARKERS[str(method)], markersize=9 if true else 5, mfc="none" if true else None,
            zorder=2 if true else 3, label=f"{POSES[str(poses)]}, {method}",
        )  # fmt: skip
    panel.axvline(OBSERVED_FROM, color=DARK_GREY, linestyle=":", linewidth=1.2, label="observed from here on")
    panel.set(xscale="log", xlabel="points seen of a member in the flight")
    panel.set(ylabel="members found (%)", ylim=(0, 103))
    figure.legend(loc="outside lower center", ncols=2, fontsize=10)
    figure.suptitle(_caption(source, ",\n"))
    return figure


@style()
def figure_near_side(bias: pd.DataFrame, source: StructureFlight) -> Figure:
    """Distance by which bars lie nearer to the sensor than the true axes (`structure_tables.near_side`), a dot a bar.

    Columns are the kinds of member, with the width of their flanges; lines are medians. ``source`` names the flight.
    """
    kinds = bias.groupby("kind")["section_m"].first().sort_values(ascending=False)
    figure = Figure(figsize=(7.6, 4.9))
    panel = figure.add_subplot()
    panel.axhline(0, color=BLACK, linewidth=1.0)
    for (kind, axis), own in bias.dropna().sort_values("toward_sensor_m").groupby(["kind", "axis"]):
        place = list(kinds.index).index(kind) + (-0.2 if axis == "middle of points" else 0.2)
        values = 100 * own["toward_sensor_m"].to_numpy()
        draw_sample(panel, place, values, AXES[str(axis)], "o", np.median, (-4, 6), alpha=0.55, markersize=3.5)
    panel.set_xticks(range(len(kinds)), [f"{kind}\n{1000 * flange:.0f} mm" for kind, flange in kinds.items()])
    panel.set(xlim=(-0.5, len(kinds) - 0.5), ylim=(-4.2, 6.2), xlabel="kind of member, width of its flanges")
    panel.set_ylabel("axis nearer to the sensor than the true one (cm)")
    panel.grid(axis="x", visible=False)
    keys: dict[str, dict[str, Any]] = {axis: {"color": shade, "marker": "o", "ls": ""} for axis, shade in AXES.items()}
    draw_legend(figure, keys | {"median": {"color": BLACK, "lw": 2.0}})
    figure.suptitle(f"{caption([source.result])},\ntower {source.tower}, true poses")
    return figure


@style()
def figure_goals(table: pd.DataFrame, goals: pd.DataFrame) -> Figure:
    """A panel for each goal: a dot a flight, by tower and method, from a `structure_table`.

    The goal is the dashed line; lines through dots are means.
    """
    towers, methods = list(table["tower"].unique()), list(table["method"].unique())
    figure = Figure(figsize=(12.5, 8.6))
    for panel, goal in zip(figure.subplots(3, 4).ravel(), goals.to_dict("records"), strict=True):
        for (tower, method), own in table.groupby(["tower", "method"], sort=False):
            place = towers.index(tower) + (methods.index(method) - 0.5 * (len(methods) - 1)) * 0.36
            values = own[goal["goal"]].to_numpy()
            draw_sample(panel, place, values, COLOURS[str(method)], MARKERS[str(method)], markersize=4.5)
        panel.axhline(goal["limit"], color=DARK_GREY, linestyle="--", linewidth=1.2)
        panel.set_title(f"{worded(goal['goal'])}: {goal['side']} {goal['limit']:g}", fontsize=11)
        panel.set_xticks(range(len(towers)), towers)
        panel.grid(axis="x", visible=False)
    keys: dict[str, dict[str, Any]] = {m: {"color": COLOURS[m], "marker": MARKERS[m], "ls": ""} for m in methods}
    keys |= {"mean": {"color": BLACK, "lw": 2.0}, "goal": {"color": DARK_GREY, "lw": 1.2, "ls": "--"}}
    draw_legend(figure, keys)
    figure.suptitle(f"{caption(table.drop(columns='tower'))}, poses corrected by {LABELS[table['odometry'].iloc[0]]}")
    return figure
