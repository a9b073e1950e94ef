"""Figures of notebooks 07 and 13: segments found by each method, curves over conditions, maps over tuning, seeds."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.image import AxesImage

from steelnb.report.batch import seeds_text
from steelnb.report.segmentation import CHOSEN, CLUTTER, FIXED, NOISE_M, REFERENCE, USUAL, Trial
from steelnb.report.style import (
    BLACK,
    COLOURS,
    GREY,
    Figure,
    draw_grid,
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
    "ransac-lines": ("s", "RANSAC lines"),
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
    width = max(12.0 / len(trials), 2.3)
    figure = Figure(figsize=(len(trials) * width + 0.5, width * high / wide + 1.5))
    panels = figure.subplots(1, len(trials), sharex=True, sharey=True, squeeze=False)[0]
    for panel, trial in zip(panels, trials, strict=True):
        _draw_found(panel, trial)
        panel.set(xlabel="across (m)", ylabel="height (m)")
        panel.label_outer()
    keys = {
        "right segment": {"color": COLOURS["right"], "lw": 2},
        "wrong segment": {"color": COLOURS["wrong"], "lw": 2},
        "observed bar missed": {"color": COLOURS["missed"], "lw": 1.4, "ls": DASHES},
        "points": {"color": COLOURS["points"], "marker": "o", "ls": "", "ms": 4},
    }
    draw_legend(figure, keys)
    figure.suptitle(f"a frame, seed {trials[0].scene.seed}, {USUALLY}")
    return figure


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
def figure_tuning(votes: pd.DataFrame, noise: pd.DataFrame, seeds: Sequence[int]) -> Figure:
    """Maps of recall and precision over dx: by least number of votes (left) and by range noise (right).

    Both are `segmentation.tuning_map` of a frame of each of these seeds. Beside the fixed dx stand the two rules
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


def _draw_map(panel: Axes, table: pd.DataFrame, by: str, number: str, low: float) -> AxesImage:
    """One of the maps of `figure_tuning`; the dx of the rules, in cm, in brackets."""
    grid = table[table["rule"] == FIXED].pivot_table(index=by, columns="dx_m", values=number)
    grid.columns = pd.Index([f"{100 * dx:g}" for dx in grid.columns])
    texts = grid.map("{:.2f}".format)
    for rule, name in ((CHOSEN, "from\npoints"), (REFERENCE, "diag.\n/ 64")):
        own = table[table["rule"] == rule].set_index(by)
        grid[name], dx_cm = own[number], 100 * own["dx_m"]
        texts[name] = [f"{value:.2f}\n({dx:.1f})" for value, dx in zip(own[number], dx_cm, strict=True)]
    if by == "noise_m":
        grid.index = 100 * grid.index
    image = draw_grid(panel, grid, (low, 1.0), texts=texts.to_numpy())
    words, fixed = ("range noise (cm)", "15 votes") if by == "noise_m" else ("least votes", "2 cm of noise")
    panel.set(title=f"{number} by {words.removesuffix(' (cm)')} (at {fixed})", ylabel=words)
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
    panels[0].set_yticks(range(len(methods)), [MARKS[name][1] for name in methods])
    panels[0].set_ylim(len(methods) - 0.5, -0.5)
    dot: dict[str, Any] = {"color": GREY, "marker": "o", "ls": "", "ms": 4}
    draw_legend(figure, {"a seed": dot, "mean, of times median": {"color": BLACK, "lw": 2.0}})
    figure.suptitle(f"Single frames, {seeds_text(table['seed'])}, {USUALLY}", fontsize=12)
    return figure
