"""Structures rebuilt from a flight: Figure 3.4 as a pair, the error on the bars, recall, the near-side bias."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.lines import Line2D

from steelnb.config import TrajectoryName
from steelnb.datatypes import Array
from steelnb.figures.segments import seen
from steelnb.figures.style import Figure, style
from steelnb.study.structure import Rebuilt, structure_goals

# Okabe and Ito's palette (2008).
RIGHT, WRONG, TRUE, JOINT = "#009E73", "#D55E00", "#b8b8b8", "#222222"
POSES = {"raw": "#D55E00", "corrected": "#0072B2", "true": "#009E73"}
POSE_LABELS = {"raw": "drifting poses", "corrected": "corrected poses", "true": "true poses"}
AXES = {"middle of points": "#D55E00", "section fitted": "#0072B2"}
METHODS = {"final": ("#0072B2", "o"), "incremental": ("#E69F00", "s")}
TOWER_IN = 7.0
BAR_M = 2.0
"""Length of the bar that shows the scale."""


def figure_structures(runs: Sequence[Rebuilt]) -> Figure:
    """The structure of each run, a panel a run, over the true members (grey), in perspective.

    Bars within 5° and 10 cm of a member along half their length are green, others red; joints are dots.
    """
    with style():
        figure, panels = _panels(runs)
        for panel, run in zip(panels, runs, strict=True):
            right = run.score.member >= 0
            bars = _bars(run)
            _draw(panel, run, bars[~right], colors=WRONG, linewidths=1.3, zorder=2)
            _draw(panel, run, bars[right], colors=RIGHT, linewidths=1.5, zorder=3)
            at = seen(run.structure.joint, run.source.truth.tower.vertices)
            panel.plot(at[:, 0], at[:, 1], "o", color=JOINT, markersize=2.4, zorder=4)
            numbers = run.score.metrics
            panel.set_title(
                f"{POSE_LABELS[run.poses]}, {run.method}\n{np.count_nonzero(right)} bars on a member, "
                f"{np.count_nonzero(~right)} not;\n{len(run.structure.joint)} joints; recall {numbers['recall']:.0%}",
                fontsize=11,
            )
        keys = [Line2D([], [], color=c, lw=2) for c in (RIGHT, WRONG, TRUE)]
        keys.append(Line2D([], [], color=JOINT, marker="o", ls="", ms=4))
        labels = ["bar on a member", "on none", "true member", "joint"]
        figure.legend(keys, labels, loc="outside lower center", ncols=4)
    return figure


def figure_structure_errors(runs: Sequence[Rebuilt], most_m: float = 0.03) -> Figure:
    """Each run's bars coloured by the distance of their axis to the member's, up to ``most_m``, in perspective.

    Bars on no member are black and dashed, members that were observed and not found thick and dark grey.
    """
    colours = ListedColormap(colormaps["plasma"](np.linspace(0, 0.87, 256)))  # no yellow, which paper hides
    scale = Normalize(0, 100 * most_m)
    with style():
        figure, panels = _panels(runs)
        for panel, run in zip(panels, runs, strict=True):
            right = run.score.member >= 0
            bars, truth = _bars(run), run.source.reference
            missed = truth.axes[truth.observed & ~run.score.found]
            _draw(panel, run, missed, colors="#777777", linewidths=2.6, zorder=2)
            shades = colours(scale(100 * run.score.offset_m[right]))
            _draw(panel, run, bars[right], colors=shades, linewidths=2.0, zorder=3)
            _draw(panel, run, bars[~right], colors="#000000", linewidths=1.3, linestyles="--", zorder=4)
            numbers = run.score.metrics
            panel.set_title(
                f"{POSE_LABELS[run.poses]}\nmedian {100 * numbers['offset_median_m']:.1f} cm, "
                f"p90 {100 * numbers['offset_p90_m']:.1f} cm"
            )
        figure.colorbar(
            ScalarMappable(scale, colours), ax=list(panels), shrink=0.6, pad=0.02, extend="max",
            label="distance of a bar's axis to the true axis (cm)",
        )  # fmt: skip
        keys = [Line2D([], [], color=TRUE, lw=1), Line2D([], [], color="#777777", lw=2.6)]
        keys.append(Line2D([], [], color="#000000", lw=1.5, ls="--"))
        labels = ["true member", "observed, not found", "bar on no member"]
        figure.legend(keys, labels, loc="outside lower center", ncols=3 if len(runs) > 1 else 2)
    return figure


def figure_recall(table: pd.DataFrame, observed_from: int = 100) -> Figure:
    """Recall against the points seen of a member, from `study.recall_by_points`: a line for each poses and method."""
    with style():
        figure = Figure(figsize=(7.6, 4.9))
        panel = figure.add_subplot()
        for (poses, method), rows in table.groupby(["poses", "method"], sort=False):
            middle = np.sqrt(rows["points_from"] * rows["points_to"])
            true, final = poses == "true", method == "final"
            panel.plot(
                middle, 100 * rows["recall"], color=POSES[str(poses)], linestyle="-" if final else "--",
                marker="o" if final else "s", markersize=9 if true else 5, mfc="none" if true else None,
                zorder=2 if true else 3, label=f"{POSE_LABELS[str(poses)]}, {method}",
            )  # fmt: skip
        first = table.drop_duplicates(["points_from", "points_to"])
        middle = np.sqrt(first["points_from"] * first["points_to"])
        for place, members in zip(middle.tolist(), first["members"].tolist(), strict=True):
            panel.annotate(str(members), (place, 107), ha="center", va="center", fontsize=10, color="#555555")
        panel.annotate("members:", (0, 107), (-6, 0), ("axes fraction", "data"), "offset points", ha="right",
                       va="center", fontsize=10, color="#555555", annotation_clip=False)  # fmt: skip
        panel.axvline(observed_from, color="#555555", linestyle=":", linewidth=1.2)
        panel.annotate("observed\nfrom here on", (observed_from, 86), (4, 0), textcoords="offset points",
                       fontsize=10, color="#555555")  # fmt: skip
        panel.set_xscale("log")
        panel.set(xlabel="points seen of a member in the flight", ylabel="members found (%)", ylim=(0, 112))
        panel.set_yticks(range(0, 101, 20))
        figure.legend(loc="outside lower center", ncols=2, fontsize=10)
    return figure


def figure_near_side(bias: pd.DataFrame) -> Figure:
    """How much nearer to the sensor than the true axes bars were found, from `study.near_side`: a dot a bar.

    Columns are the kinds of member, with the width of their flanges; lines are medians.
    """
    kinds = bias.groupby("kind")["section_m"].first().sort_values(ascending=False)
    with style():
        figure = Figure(figsize=(7.6, 4.9))
        panel = figure.add_subplot()
        panel.axhline(0, color="#000000", linewidth=1.0)
        for k, kind in enumerate(kinds.index):
            for side, (axis, colour) in zip((-0.2, 0.2), AXES.items(), strict=True):
                value = 100 * bias[(bias["kind"] == kind) & (bias["axis"] == axis)]["toward_sensor_m"].to_numpy()
                value = np.sort(value[np.isfinite(value)])
                if not len(value):
                    continue
                spread = 0.13 * np.sin(2.4 * np.arange(len(value)))  # the golden angle: dots side by side, no chance
                panel.plot(k + side + spread, np.clip(value, -4, 6), "o", color=colour, markersize=3.5, alpha=0.55)
                panel.plot([k + side - 0.17, k + side + 0.17], [np.median(value)] * 2, color="#000000", linewidth=2.5)
                panel.annotate(f"{np.median(value):+.1f}", (k + side, 6.5), ha="center", fontsize=11, color=colour)
        panel.set_xticks(range(len(kinds)), [f"{kind}\n{1000 * flange:.0f} mm" for kind, flange in kinds.items()])
        panel.set(xlim=(-0.5, len(kinds) - 0.5), ylim=(-4.2, 7.2), xlabel="kind of member, width of its flanges")
        panel.set_ylabel("axis nearer to the sensor than the true one (cm)")
        panel.grid(axis="x", visible=False)
        keys = [Line2D([], [], color=colour, marker="o", ls="") for colour in AXES.values()]
        keys.append(Line2D([], [], color="#000000", lw=2.5))
        labels = ["middle of the points", "section fitted", "median (cm, above)"]
        figure.legend(keys, labels, loc="outside lower center", ncols=3)
    return figure


def figure_structure_goals(table: pd.DataFrame, trajectory: TrajectoryName) -> Figure:
    """A panel for each goal: a dot a flight, from a table of `study.structures_over_seeds`, by tower and method.

    The goal is the dashed line, the side of it that is aimed at is white; lines through dots are means.
    """
    towers, methods = list(dict.fromkeys(table["tower"])), list(dict.fromkeys(table["method"]))
    with style():
        figure = Figure(figsize=(12.5, 8.6))
        panels = figure.subplots(3, 4).ravel()
        goals = structure_goals(table, trajectory).to_dict("records")
        for panel, goal in zip(panels, goals, strict=True):
            name, factor, unit = _unit(goal["goal"])
            for k, tower in enumerate(towers):
                for m, method in enumerate(methods):
                    value = factor * table[(table["tower"] == tower) & (table["method"] == method)][goal["goal"]]
                    place = k + (m - 0.5 * (len(methods) - 1)) * 0.36
                    spread = np.linspace(-0.1, 0.1, len(value)) if len(value) > 1 else np.zeros(len(value))
                    panel.plot(place + spread, value, METHODS[method][1], color=METHODS[method][0], markersize=4.5)
                    panel.plot([place - 0.15, place + 0.15], [value.mean()] * 2, color="#000000", linewidth=1.8)
            limit = factor * goal["limit"]
            panel.axhline(limit, color="#555555", linestyle="--", linewidth=1.2)
            low, high = panel.get_ylim()
            low = 0.0 if goal["side"] == "at most" else min(low, limit) - 1
            high = 1.15 * max(high, limit) if goal["side"] == "at most" else 100 * 1.01
            panel.set(xlim=(-0.5, len(towers) - 0.5), ylim=(low, high), ylabel=unit)
            panel.set_title(f"{name}: {goal['side']} {limit:g} {unit}", fontsize=11)
            wrong = (limit, high) if goal["side"] == "at most" else (low, limit)
            panel.axhspan(*wrong, color="#f1e4dc", zorder=0)
            panel.set_xticks(range(len(towers)), towers)
            panel.grid(axis="x", visible=False)
        keys = [Line2D([], [], color=METHODS[m][0], marker=METHODS[m][1], ls="") for m in methods]
        keys += [Line2D([], [], color="#000000", lw=1.8), Line2D([], [], color="#555555", lw=1.2, ls="--")]
        figure.legend(keys, [*methods, "mean", "goal"], loc="outside lower center", ncols=4)
    return figure


def _unit(column: str) -> tuple[str, float, str]:
    """The name of a column for a reader, and what its values are to be multiplied by for a unit."""
    for ending, factor, unit in (("_m", 100.0, "cm"), ("_deg", 1.0, "°"), ("duplicates", 1.0, "bars")):
        if column.endswith(ending):
            name = column.removesuffix("_m").removesuffix("_deg").replace("_", " ").replace("ate rmse", "pose error")
            return name, factor, unit
    return column.replace("_", " "), 100.0, "%"


def _panels(runs: Sequence[Rebuilt]) -> tuple[Figure, list[Axes]]:
    """A panel for each run, with the true members in grey and a bar of two metres."""
    flat = seen(runs[0].source.truth.tower.vertices, runs[0].source.truth.tower.vertices)
    (left, low), (right, high) = flat.min(axis=0), flat.max(axis=0)
    scale = TOWER_IN / (high - low)
    figure = Figure(figsize=(len(runs) * max((right - left) * scale + 0.3, 3.7) + 0.8, TOWER_IN + 1.5))
    panels = list(figure.subplots(1, len(runs), squeeze=False)[0])
    for panel, run in zip(panels, runs, strict=True):
        _draw(panel, run, run.source.truth.tower.axes, colors=TRUE, linewidths=0.8, zorder=1)
        panel.set(xlim=(left - 0.3, right + 0.3), ylim=(low - 0.9, high + 0.2), aspect="equal")
        panel.set_axis_off()
        panel.plot([left, left + BAR_M], [low - 0.4] * 2, color="#000000", linewidth=2.5)
        panel.annotate(f"{BAR_M:g} m", (left + BAR_M / 2, low - 0.5), ha="center", va="top", fontsize=10)
    return figure, panels


def _draw(panel: Axes, run: Rebuilt, bars: Array, **look: Any) -> None:
    """Add bars ``(M, 2, 3)`` to a panel, seen in perspective."""
    flat = seen(bars.reshape(-1, 3), run.source.truth.tower.vertices).reshape(-1, 2, 2)
    panel.add_collection(LineCollection(list(flat), capstyle="round", **look))


def _bars(run: Rebuilt) -> Array:
    segments = run.structure.segments
    return np.stack([segments.start, segments.end], axis=1)
