"""Charts of the runs of a study, by seaborn: errors over seeds as dots, and estimates with their intervals."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import matplotlib.figure
import matplotlib.pyplot as plt
import pandas as pd
import seaborn as sns
from matplotlib.lines import Line2D

from steelnb.core.errors import InputError
from steelnb.plots.style import BLACK, COLOURS, DRIFT, GREY, LABELS, gather_legend, log_axis

WIDE = 100.0
"""Ratio of values above which `forest` uses a logarithmic scale."""


def require_runs(runs: pd.DataFrame, methods: Iterable[str]) -> pd.DataFrame:
    """The same runs, which were chosen from a study. Raises `InputError` if there are none."""
    if runs.empty:
        raise InputError(f"no run of {', '.join(methods)} is left to draw: expected other methods, noises or studies")
    return runs


def error_dots(runs: pd.DataFrame, case: str, methods: Sequence[str], **facets: Any) -> sns.FacetGrid:
    """Plot the absolute trajectory error of each run as a dot, with one row per value of the categorical column
    ``case`` and one colour per method. A black bar is the mean; the range of errors without correction is behind.

    ``runs`` has the columns ``ate_rmse_m`` and ``raw_ate_rmse_m`` (m) and ``method``. ``facets`` are options of
    `seaborn.catplot`, such as ``col``. Without a run, the panels of a given ``col_order`` say so; else raises
    `InputError`.
    """
    if "col_order" not in facets:
        require_runs(runs, methods)
    if runs.empty:
        grid = sns.FacetGrid(runs, **facets)
        for panel in grid.axes.flat:
            panel.text(0.5, 0.5, "no run", ha="center", va="center", transform=panel.transAxes)
            panel.set_axis_off()
        return grid
    rows = runs.assign(ate_cm=100 * runs["ate_rmse_m"], drift_cm=100 * runs["raw_ate_rmse_m"])
    dodge = 0.8 - 0.8 / len(methods) if case != "method" else 0.0
    dots = {"x": "ate_cm", "y": case, "order": list(rows[case].cat.categories), "hue": "method", "hue_order": methods}
    grid = sns.catplot(
        rows, kind="strip", dodge=dodge > 0, jitter=0.06, palette=COLOURS, legend=False, **dots, **facets
    )
    mean = {"marker": "|", "ms": 12, "mew": 2, "ls": ""}
    means = {"dodge": dodge or False, "errorbar": None, "palette": "dark:black", "legend": False}
    grid.map_dataframe(sns.pointplot, **means, **mean, **dots)
    grid.map_dataframe(_draw_drift, case=case, order=dots["order"])
    errors_cm = rows["ate_cm"]
    for panel in grid.axes.flat:
        log_axis(panel, "x", min(1.0, errors_cm[errors_cm > 0].min()), (errors_cm == 0).any())
    grid.set(xlabel="ATE, root mean square (cm)", ylabel="", ylim=(len(dots["order"]) - 0.5, -0.5))
    panel = grid.axes.flat[0]
    names = LABELS if case == "method" else {}
    panel.set_yticks(range(len(dots["order"])), [names.get(name, name) for name in dots["order"]])
    for name in methods if case != "method" else ():
        panel.plot([], [], "o", color=COLOURS[name], label=name)
    panel.plot([], [], color=BLACK, label="mean", **mean)
    gather_legend(grid.figure, ncols=len(methods) + 2)
    return grid


def _draw_drift(data: pd.DataFrame, case: str, order: Sequence[str], **_: Any) -> None:
    """Draw the range of errors without correction into the current panel, for each value of ``case``."""
    low, high = (data.groupby(case, observed=True)["drift_cm"].agg(name).reindex(order) for name in ("min", "max"))
    plt.gca().barh(low.index, high - low, left=low, zorder=0, label="none", **DRIFT)
    plt.gca().use_sticky_edges = False


def forest(cells: pd.DataFrame, colours: Mapping[str, str]) -> matplotlib.figure.Figure:
    """Draw one panel per ``title`` with the estimate and interval of each ``cell`` in the order of the table, coloured
    by ``verdict``, over its ``measure``. Dashed lines are the thresholds. Each panel has its own scale, a logarithmic
    one for positive numbers that span more than `WIDE`."""
    panels = list(cells.groupby(cells["title"].str.wrap(80), sort=False))
    rows, size = [len(some) for _, some in panels], (9, 0.21 * len(cells) + 0.8 * len(panels) + 0.5)
    figure, axes = plt.subplots(len(panels), height_ratios=rows, figsize=size, squeeze=False, layout="constrained")
    for (title, some), panel in zip(panels, axes.flat, strict=True):
        look, cell = some["verdict"].map(colours), some["cell"].replace(LABELS)
        panel.hlines(cell, some["low"], some["high"], lw=2, color=look)
        panel.scatter(some["estimate"], cell, s=22, color=look)
        panel.set_ylim(len(some) - 0.4, -0.6)
        goal = some[["threshold", "threshold_to"]].iloc[0].dropna()
        panel.vlines(goal, *panel.get_ylim(), color=GREY, ls="--")
        if 0 < min(goal.min(), some["low"].min()) * WIDE < some["high"].max():
            panel.set_xscale("log")
            panel.xaxis.set_major_formatter("{x:g}")
        panel.set_title(title, loc="left", size=9)
        panel.set_xlabel(some["measure"].iloc[0], size=9)
        panel.tick_params(labelsize=9)
    verdicts = [Line2D([], [], color=colour, marker="o", ls="", label=verdict) for verdict, colour in colours.items()]
    figure.legend(handles=verdicts, loc="outside lower center", ncols=len(verdicts))
    return figure
