"""Methods of segmentation side by side: pictures of what they found, curves over conditions, maps over tuning."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

from steelnb.datatypes import Array
from steelnb.figures.style import Figure, style
from steelnb.study.segmentation import CHOSEN, CLUTTER, FIXED, NOISE_M, REFERENCE, Trial

# Okabe and Ito's palette (2008), with a marker each for print without colour.
LOOKS = {
    "hough": ("#D55E00", "o", "Hough"),
    "hough-once": ("#882255", "p", "Hough, one pass"),
    "hough-blocks": ("#CC79A7", "D", "Hough in blocks"),
    "ransac-lines": ("#0072B2", "s", "RANSAC lines"),
    "ransac-lines-uniform": ("#56B4E9", "P", "RANSAC lines, any two points"),
    "ransac-planes": ("#777777", "v", "RANSAC planes"),
    "gmm": ("#009E73", "^", "GMM"),
    "dbscan": ("#E69F00", "X", "DBSCAN"),
}
RIGHT, WRONG, MISSED, POINTS = "#009E73", "#D55E00", "#0072B2", "#c8c8c8"
CONDITIONS = {
    "noise_m": ("range noise (cm)", 100.0),
    "clutter": ("clutter (% of the points)", 100.0),
    "kept": ("points kept (%)", 100.0),
}
RECALL_MIN = 0.05
"""Below this, the errors of the segments that are right are those of one or two."""
NUMBERS = {
    "recall": ("recall", 1.0),
    "precision": ("precision", 1.0),
    "angle_deg": ("angle (°)", 1.0),
    "offset_m": ("offset (cm)", 100.0),
}


def figure_found(trials: Sequence[Trial]) -> Figure:
    """What each method found in one scene, seen from where the sensor was: right and wrong segments over the points,
    and the bars missed."""
    flat = _project(trials[0].scene.points, trials[0].scene.across)
    wide, high = np.ptp(flat, axis=0) + 0.2
    columns = len(trials) if high > 1.3 * wide else 3
    rows = -(-len(trials) // columns)
    with style():
        width = 12.0 / columns
        size = (columns * width + 0.5, rows * (width * high / wide + 0.9) + 0.4)
        figure = Figure(figsize=size)
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for k, panel in enumerate(panels.ravel()):
            if k >= len(trials):
                panel.set_axis_off()
                continue
            _draw_found(panel, trials[k])
            if k + columns >= len(trials):
                panel.set_xlabel("across (m)")
                panel.tick_params(labelbottom=True)
            if k % columns == 0:
                panel.set_ylabel("height (m)")
        keys = [Line2D([], [], color=colour, lw=2) for colour in (RIGHT, WRONG)]
        keys += [Line2D([], [], color=MISSED, lw=1.4, ls=(0, (2, 1.5)))]
        keys += [Line2D([], [], color=POINTS, marker="o", ls="", ms=4)]
        labels = ["right segment", "wrong segment", "observed bar missed", "points"]
        figure.legend(keys, labels, loc="outside lower center", ncols=4)
    return figure


def _draw_found(panel: Axes, trial: Trial) -> None:
    scene, score = trial.scene, trial.score
    flat = _project(scene.points, scene.across)
    shown = np.linspace(0, len(flat) - 1, min(len(flat), 20_000)).astype(int)
    panel.scatter(flat[shown, 0], flat[shown, 1], s=0.7, c=POINTS, linewidths=0, rasterized=True)
    missed = scene.members.axes[scene.members.observed() & ~score.found]
    panel.add_collection(
        LineCollection(
            list(_project(missed, scene.across)), colors=MISSED, lw=1.3, linestyles=[(0, (2, 1.5))], zorder=3
        )
    )
    bars = _project(np.stack([trial.segments.start, trial.segments.end], axis=1), scene.across)
    for mask, colour in ((score.right, RIGHT), (~score.right, WRONG)):
        panel.add_collection(LineCollection(list(bars[mask]), colors=colour, lw=1.5, capstyle="round"))
    numbers = f"recall {score.recall:.2f}\n"
    numbers += f"precision {score.precision:.2f}" if len(score.right) else "no segment"
    panel.set_title(f"{_label(trial.method)}\n{numbers}", fontsize=10)
    panel.set_aspect("equal")
    low, high = flat.min(axis=0) - 0.1, flat.max(axis=0) + 0.1
    panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))


def _project(points: Array, across: Array) -> Array:
    """Points ``(…, 3)`` → ``(…, 2)``: to the right and up."""
    return np.stack([points @ across, points[..., 2]], axis=-1)


def figure_conditions(cases: pd.DataFrame, usual: dict[str, float]) -> Figure:
    """Recall, precision, angle and offset (rows) over noise, clutter and density (columns), a curve a method.

    ``cases`` is `steelnb.study.over_cases`; each column of panels takes the cases that differ from ``usual`` in one
    condition only. Errors of a method that finds next to nothing say nothing, and are left out.
    """
    methods = [name for name in LOOKS if name in set(cases["method"])]
    with style():
        figure = Figure(figsize=(10.5, 10.5))
        panels = figure.subplots(len(NUMBERS), len(CONDITIONS), sharex="col", sharey="row", squeeze=False)
        for column, (condition, (words, scale)) in enumerate(CONDITIONS.items()):
            others = [name for name in usual if name != condition]
            chosen = cases[np.logical_and.reduce([cases[name] == usual[name] for name in others])]
            for row, (number, (unit, factor)) in enumerate(NUMBERS.items()):
                panel = panels[row, column]
                for method in methods:
                    colour, marker, label = LOOKS[method]
                    curve = chosen[chosen["method"] == method].sort_values(condition)
                    x, y = scale * curve[condition], factor * curve[number]
                    if number not in ("recall", "precision"):
                        y = y.where(curve["recall"] >= RECALL_MIN)
                    panel.plot(x, y, color=colour, marker=marker, markersize=5, label=label)
                panel.axvline(scale * usual[condition], color="#777777", lw=0.8, ls=":", zorder=0)
                if row == 0 and condition == "kept":
                    panel.set_xscale("log", base=2)
                    panel.set_xticks(scale * np.sort(chosen[condition].unique()))
                    panel.xaxis.set_major_formatter(lambda value, _: f"{value:.3g}")
                if column == 0:
                    panel.set_ylabel(unit)
                if row == len(NUMBERS) - 1:
                    panel.set_xlabel(words)
        for row, number in enumerate(NUMBERS):
            panels[row, 0].set_ylim(0, 1.03 if number in ("recall", "precision") else None)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def figure_sequence(trials: Sequence[Trial]) -> Figure:
    """Recall, precision and points of each frame of a sequence, a curve a method."""
    methods = list(dict.fromkeys(trial.method for trial in trials))
    scenes = list({id(trial.scene): trial.scene for trial in trials}.values())
    with style():
        figure = Figure(figsize=(9.0, 7.0))
        top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(2, 2, 1))
        for method in methods:
            colour, marker, label = LOOKS[method]
            own = [trial for trial in trials if trial.method == method]
            index = [next(k for k, scene in enumerate(scenes) if scene is trial.scene) for trial in own]
            look: dict[str, Any] = {"color": colour, "marker": marker, "markersize": 5, "label": label}
            look["linestyle"] = "-" if len(own) == len(scenes) else ""
            top.plot(index, [trial.score.recall for trial in own], **look)
            middle.plot(index, [trial.score.precision for trial in own], **look)
        bottom.plot([scene.members.observed().sum() for scene in scenes], color="#000000", marker=".")
        top.set(ylabel="recall", ylim=(-0.03, 1.03))
        middle.set(ylabel="precision", ylim=(-0.03, 1.03))
        bottom.set(ylabel="bars observed", xlabel="frame", ylim=(0, None))
        bottom.set_xlim(-0.5, len(scenes) - 0.5)
        figure.legend(*top.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def figure_tuning(votes: pd.DataFrame, noise: pd.DataFrame) -> Figure:
    """Maps of recall and precision over dx: by least number of votes (left) and by range noise (right).

    Both are `steelnb.study.tuning_map`. Under each fixed dx stand the two rules that need no tuning, with their dx.
    """
    with style():
        figure = Figure(figsize=(12.0, 8.6))
        panels = figure.subplots(2, 2, squeeze=False)
        low = min(0.5, *(float(table[n].min()) for table in (votes, noise) for n in ("recall", "precision")))
        for column, (table, by, words) in enumerate(
            ((votes, "min_votes", "min_votes"), (noise, "noise_m", "range noise (cm)"))
        ):
            for row, number in enumerate(("recall", "precision")):
                image = _draw_map(panels[row, column], table, by, number, low)
                panels[row, column].set_title(number)
                panels[row, column].set_ylabel(words)
                if row == 1:
                    panels[row, column].set_xlabel("dx (cm)")
        figure.colorbar(image, ax=panels, shrink=0.6, label="recall or precision")
    return figure


def figure_over_seeds(table: pd.DataFrame, timing: pd.DataFrame) -> Figure:
    """Recall, precision and time a frame of each method, a dot a seed, with the mean, or median of the times, as a bar.

    ``table`` is `steelnb.study.trial_table` and ``timing`` `trial_timing` by seed.
    """
    methods = [name for name in LOOKS if name in set(table["method"])]
    columns = (
        (table, "recall", "recall"),
        (table, "precision", "precision"),
        (timing, "median_ms", "time a frame (ms)"),
    )
    with style():
        figure = Figure(figsize=(11.0, 0.75 * len(methods) + 1.2))
        panels = figure.subplots(1, len(columns), sharey=True)
        for panel, (rows, number, words) in zip(panels, columns, strict=True):
            for k, method in enumerate(methods):
                colour, marker, _ = LOOKS[method]
                values = rows[rows["method"] == method].sort_values("seed")[number].to_numpy()
                spread = np.linspace(-0.25, 0.25, len(values))
                panel.plot(values, k + spread, marker, color=colour, markersize=4, alpha=0.7, ls="")
                middle = float(np.median(values) if number == "median_ms" else values.mean())
                panel.plot([middle] * 2, [k - 0.38, k + 0.38], color="#000000", lw=2)
            panel.set(xlabel=words)
            panel.grid(axis="y", visible=False)
        for panel in panels[:2]:
            panel.set_xlim(-0.03, 1.03)
        panels[2].set_xscale("log")
        panels[2].xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        panels[2].xaxis.set_minor_formatter(lambda value, _: "")
        panels[0].set_yticks(range(len(methods)), [_label(name) for name in methods])
        panels[0].set_ylim(len(methods) - 0.5, -0.5)
    return figure


def _draw_map(panel: Axes, table: pd.DataFrame, by: str, number: str, low: float):  # type: ignore[no-untyped-def]
    fixed = table[table["rule"] == FIXED]
    grid = fixed.pivot_table(index=by, columns="dx_m", values=number)
    rules = [table[table["rule"] == rule].set_index(by).loc[grid.index].reset_index() for rule in (CHOSEN, REFERENCE)]
    values = np.column_stack([grid.to_numpy(), *(rule[number] for rule in rules)])
    image = panel.imshow(values, origin="lower", aspect="auto", cmap="viridis", vmin=low, vmax=1.0)
    for (row, column), value in np.ndenumerate(values):
        colour = "black" if value > (low + 1.0) / 2 + 0.1 * (1 - low) else "white"
        text = f"{value:.2f}"
        if column >= grid.shape[1]:
            text += f"\n({100 * rules[column - grid.shape[1]]['dx_m'][row]:.1f})"
        panel.annotate(text, (column, row), ha="center", va="center", fontsize=8.5, color=colour)
    panel.axvline(grid.shape[1] - 0.5, color="white", lw=4)
    names = [f"{100 * dx:g}" for dx in grid.columns] + ["from\npoints", "diag.\n/ 64"]
    panel.set_xticks(range(len(names)), names, fontsize=9)
    panel.set_yticks(range(len(grid)), [f"{100 * v:g}" if by == "noise_m" else f"{v}" for v in grid.index])
    panel.grid(False)
    return image


def _label(method: str) -> str:
    return LOOKS[method][2] if method in LOOKS else method


USUAL = {"noise_m": NOISE_M, "clutter": CLUTTER, "kept": 1.0}
"""The conditions at which the methods are compared."""
