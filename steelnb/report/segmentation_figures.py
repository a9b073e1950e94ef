"""Figures of notebooks 07 and 13: segments found by each method, curves over conditions, maps over tuning, seeds."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from steelnb.report.batch import seeds_text
from steelnb.report.segmentation import CLUTTER, NOISE_M, USUAL, Scene, Trial
from steelnb.report.segmentation_tuning import CHOSEN, FIXED, REFERENCE
from steelnb.report.style import (
    BLACK,
    COLOURS,
    GREY,
    Figure,
    draw_legend,
    draw_lines,
    draw_sample,
    end_points,
    gather_legend,
    style,
    thinned,
)
from steelnb.types import Array

MARKS = {
    "hough": ("o", "Hough"),
    "hough-once": ("p", "Hough, one pass"),
    "hough-blocks": ("D", "Hough in blocks"),
    "ransac-lines": ("s", "RANSAC lines"),
    "ransac-lines-uniform": ("P", "RANSAC lines, any two points"),
    "ransac-planes": ("v", "RANSAC planes"),
    "gmm": ("^", "GMM"),
    "dbscan": ("X", "DBSCAN"),
}
"""Marker and name of each method, in the order of the figures: told apart also without colour."""
DASHES = (0, (2, 1.5))
CONDITIONS = {
    "noise_m": ("range noise (cm)", 100.0),
    "clutter": ("clutter (% of the points)", 100.0),
    "kept": ("points kept (%)", 100.0),
}
RECALL_MIN = 0.05
"""Below this recall, the precision and the errors of the segments are those of one or two."""
UNDRAWN = f"recall below {RECALL_MIN:.0%}: no precision and no errors, which would be those of one or two segments"
USUALLY = f"sensor starling2, range noise {100 * NOISE_M:g} cm, clutter {CLUTTER:.0%}"
NUMBERS = {
    "recall": ("recall", 1.0),
    "precision": ("precision", 1.0),
    "angle_deg": ("angle (°)", 1.0),
    "offset_m": ("offset (cm)", 100.0),
}


@style()
def figure_found(trials: Sequence[Trial]) -> Figure:
    """The segments of each method in one scene, seen from where the sensor was: right and wrong ones over the points,
    and the bars missed."""
    wide, high = np.ptp(_project(trials[0].scene.points, trials[0].scene.across), axis=0) + 0.2
    columns = len(trials) if high > 1.3 * wide else 3
    rows = -(-len(trials) // columns)
    width = 12.0 / columns
    figure = Figure(figsize=(columns * width + 0.5, rows * (width * high / wide + 0.9) + 0.4))
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for k, (panel, trial) in enumerate(zip(panels.ravel(), trials, strict=False)):
        _draw_found(panel, trial)
        if k % columns == 0:
            panel.set_ylabel("height (m)")
        if k + columns >= len(trials):  # also above an empty place
            panel.set_xlabel("across (m)")
            panel.tick_params(labelbottom=True)
    for panel in panels.ravel()[len(trials) :]:
        panel.set_axis_off()
    keys = {
        "right segment": {"color": COLOURS["right"], "lw": 2},
        "wrong segment": {"color": COLOURS["wrong"], "lw": 2},
        "observed bar missed": {"color": COLOURS["missed"], "lw": 1.4, "ls": DASHES},
        "points": {"color": COLOURS["points"], "marker": "o", "ls": "", "ms": 4},
    }
    draw_legend(figure, keys)
    figure.suptitle(_caption([trial.scene for trial in trials]))
    return figure


def _caption(scenes: Iterable[Scene]) -> str:
    """The scenes of some trials at the usual conditions."""
    scenes = list(dict.fromkeys(scenes))
    what = {"frame": "single frames", "sequence": "vertical flight", "tower": "both flights at once"}[scenes[0].name]
    return f"{what}, {seeds_text(scene.seed for scene in scenes)}, {USUALLY}"


def _draw_found(panel: Axes, trial: Trial) -> None:
    scene, score = trial.scene, trial.score
    flat = _project(scene.points, scene.across)
    shown = thinned(flat, 20_000)
    panel.scatter(shown[:, 0], shown[:, 1], s=0.7, c=COLOURS["points"], linewidths=0, rasterized=True)
    missed = _project(scene.members.axes[scene.members.observed() & ~score.found], scene.across)
    draw_lines(panel, missed, colors=COLOURS["missed"], lw=1.3, linestyles=[DASHES], zorder=3, capstyle="butt")
    bars = _project(end_points(trial.segments), scene.across)
    draw_lines(panel, bars[score.right], colors=COLOURS["right"], lw=1.5)
    draw_lines(panel, bars[~score.right], colors=COLOURS["wrong"], lw=1.5)
    numbers = f"{np.count_nonzero(score.right)} of {len(score.right)} right" if len(score.right) else "no segment"
    panel.set_title(f"{MARKS[trial.method][1]}\nrecall {score.recall:.2f}\n{numbers}", fontsize=10)
    panel.set_aspect("equal")
    low, high = flat.min(axis=0) - 0.1, flat.max(axis=0) + 0.1
    panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))


def _project(points: Array, across: Array) -> Array:
    """Points ``(…, 3)`` → ``(…, 2)``: to the right and up."""
    return np.stack([points @ across, points[..., 2]], axis=-1)


@style()
def figure_conditions(cases: pd.DataFrame, seeds: Sequence[int]) -> Figure:
    """Recall, precision, angle and offset (rows) over noise, clutter and density (columns), a curve a method.

    ``cases`` is `segmentation.over_cases` of these seeds; each column of panels takes the cases that differ from
    `USUAL` in one condition only. Precision and errors of a method that finds next to nothing are left out.
    """
    methods = [name for name in MARKS if name in set(cases["method"])]
    figure = Figure(figsize=(10.5, 10.5))
    panels = figure.subplots(len(NUMBERS), len(CONDITIONS), sharex="col", sharey="row", squeeze=False)
    for column, (condition, (words, scale)) in enumerate(CONDITIONS.items()):
        others = [name for name in USUAL if name != condition]
        chosen = cases[np.logical_and.reduce([cases[name] == USUAL[name] for name in others])]
        for row, (number, (unit, factor)) in enumerate(NUMBERS.items()):
            panel = panels[row, column]
            for method in methods:
                marker, label = MARKS[method]
                curve = chosen[chosen["method"] == method].sort_values(condition)
                x, y = scale * curve[condition], factor * curve[number]
                if number != "recall":
                    y = y.where(curve["recall"] >= RECALL_MIN)
                panel.plot(x, y, color=COLOURS[method], marker=marker, markersize=5, label=label)
            panel.axvline(
                scale * USUAL[condition], color=GREY, lw=1.2, ls=":", zorder=0, label="value in the other columns"
            )
            panel.set(xlabel=words, ylabel=unit)
            panel.label_outer()
    for row, number in enumerate(NUMBERS):
        panels[row, 0].set_ylim(0, 1.03 if number in ("recall", "precision") else None)
    ticks = 100 * np.sort(cases["kept"].unique())
    panels[0, -1].set_xscale("log", base=2)
    panels[0, -1].set_xticks(ticks, [f"{value:.3g}" for value in ticks])
    gather_legend(figure, ncols=3)
    figure.suptitle(f"Single frames, {seeds_text(seeds)}, else {USUALLY}, all points\n({UNDRAWN})", fontsize=11)
    return figure


@style()
def figure_sequence(trials: Sequence[Trial]) -> Figure:
    """Recall, precision and points of each frame of a sequence, a curve a method."""
    scenes = list(dict.fromkeys(trial.scene for trial in trials))
    frames = pd.DataFrame(
        {"method": t.method, "frame": scenes.index(t.scene), "recall": t.score.recall, "precision": t.score.precision}
        for t in trials
    )
    figure = Figure(figsize=(9.0, 7.0))
    *panels, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(2, 2, 1))
    for number, panel in zip(("recall", "precision"), panels, strict=True):
        for method, own in frames.groupby("method", sort=False):
            marker, label = MARKS[str(method)]
            dash = "-" if len(own) == len(scenes) else ""
            shown = own[number] if number == "recall" else own[number].where(own["recall"] >= RECALL_MIN)
            panel.plot(own["frame"], shown, dash, color=COLOURS[str(method)], marker=marker, ms=5, label=label)
        panel.set(ylabel=number, ylim=(-0.03, 1.03))
    bottom.plot([scene.members.observed().sum() for scene in scenes], color=BLACK, marker=".")
    bottom.set(ylabel="bars observed", xlabel="frame", ylim=(0, None), xlim=(-0.5, len(scenes) - 0.5))
    gather_legend(figure, ncols=3)
    figure.suptitle(f"{_caption(scenes)}\n({UNDRAWN})", fontsize=11)
    return figure


@style()
def figure_tuning(votes: pd.DataFrame, noise: pd.DataFrame, seeds: Sequence[int]) -> Figure:
    """Maps of recall and precision over dx: by least number of votes (left) and by range noise (right).

    Both are `segmentation_tuning.tuning_map` of a frame of each of these seeds. Beside the fixed dx stand the two rules
    that need no tuning, with their dx.
    """
    figure = Figure(figsize=(12.0, 8.6))
    panels = figure.subplots(2, 2, squeeze=False)
    low = min(0.5, *(float(table[n].min()) for table in (votes, noise) for n in ("recall", "precision")))
    for column, (table, by) in enumerate(((votes, "min_votes"), (noise, "noise_m"))):
        for row, number in enumerate(("recall", "precision")):
            image = _draw_map(panels[row, column], table, by, number, low)
        panels[1, column].set_xlabel("dx (cm)")
    figure.colorbar(image, ax=panels, shrink=0.6, label="recall or precision")
    figure.suptitle(f"Hough, a frame of {seeds_text(seeds)}, {USUALLY}", fontsize=12)
    return figure


def _draw_map(panel: Axes, table: pd.DataFrame, by: str, number: str, low: float):  # type: ignore[no-untyped-def]
    grid = table[table["rule"] == FIXED].pivot_table(index=by, columns="dx_m", values=number)
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
    words, fixed = ("range noise (cm)", "15 votes") if by == "noise_m" else ("least votes", "2 cm of noise")
    panel.set(title=f"{number} by {words.removesuffix(' (cm)')} (at {fixed})", ylabel=words)
    panel.grid(False)
    return image


@style()
def figure_over_seeds(table: pd.DataFrame, timing: pd.DataFrame) -> Figure:
    """Recall, precision and time a frame of each method, a dot a seed, with the mean, or median of the times, as a bar.

    ``table`` is `segmentation.trial_table` and ``timing`` `trial_timing` by seed.
    """
    methods = [name for name in MARKS if name in set(table["method"])]
    columns = {"recall": table, "precision": table, "median_ms": timing}
    figure = Figure(figsize=(11.0, 0.75 * len(methods) + 2.0))
    panels = figure.subplots(1, len(columns), sharey=True)
    for panel, (number, rows) in zip(panels, columns.items(), strict=True):
        middle = np.median if number == "median_ms" else np.mean
        for k, method in enumerate(methods):
            values = rows.loc[rows["method"] == method, number].to_numpy()
            draw_sample(
                panel, k, values, COLOURS[method], MARKS[method][0], middle, width=0.7, across=True,
                markersize=4, alpha=0.7, ls="",
            )  # fmt: skip
        panel.set(xlabel=number, xlim=(-0.03, 1.03))
        panel.grid(axis="y", visible=False)
    panels[2].set(xlabel="time a frame (ms)", xscale="log")
    panels[2].autoscale(axis="x")
    panels[2].xaxis.set_major_formatter("{x:g}")
    panels[2].xaxis.set_minor_formatter("")
    panels[0].set_yticks(range(len(methods)), [MARKS[name][1] for name in methods])
    panels[0].set_ylim(len(methods) - 0.5, -0.5)
    dot: dict[str, Any] = {"color": GREY, "marker": "o", "ls": "", "ms": 4}
    draw_legend(figure, {"a seed": dot, "mean, of times median": {"color": BLACK, "lw": 2.0}})
    figure.suptitle(f"Single frames, {seeds_text(table['seed'])}, {USUALLY}", fontsize=12)
    return figure
