"""Charts of the runs of a study, by seaborn: errors over seeds as dots, and estimates with their intervals."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.figure
import matplotlib.pyplot as plt
import pandas as pd
import seaborn as sns
from matplotlib.lines import Line2D

from steelnb.core.errors import InputError
from steelnb.plots.style import BLACK, COLOURS, DRIFT, GREY, gather_legend


def error_dots(runs: pd.DataFrame, case: str, methods: Sequence[str], **facets: Any) -> sns.FacetGrid:
    """Plot the absolute trajectory error of each run as a dot, with one row per value of the categorical column
    ``case`` and one colour per method. A black bar is the mean; the range of errors without correction is behind.

    ``runs`` has the columns ``ate_rmse_m`` and ``raw_ate_rmse_m`` (m) and ``method``. ``facets`` are options of
    `seaborn.catplot`, such as ``col``. Raises `InputError` without a run.
    """
    if runs.empty:
        raise InputError(f"no run of {', '.join(methods)} is left to draw: expected other methods or noises")
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
    grid.set(xscale="log", xlabel="ATE, root mean square (cm)", ylabel="", ylim=(len(dots["order"]) - 0.5, -0.5))
    panel = grid.axes.flat[0]
    for name in methods if case != "method" else ():
        panel.plot([], [], "o", color=COLOURS[name], label=name)
    panel.plot([], [], color=BLACK, label="mean", **mean)
    gather_legend(grid.figure, ncols=4)
    return grid


def _draw_drift(data: pd.DataFrame, case: str, order: Sequence[str], **_: Any) -> None:
    """Draw the range of errors without correction into the current panel, for each value of ``case``."""
    low, high = (data.groupby(case, observed=True)["drift_cm"].agg(name).reindex(order) for name in ("min", "max"))
    plt.gca().barh(low.index, high - low, left=low, zorder=0, label="none", **DRIFT)
    plt.gca().use_sticky_edges = False


def forest(cells: pd.DataFrame, colours: Mapping[str, str]) -> matplotlib.figure.Figure:
    """Draw one panel per ``title`` with the estimate and interval of each ``cell``, coloured by ``verdict``. Dashed
    lines are the thresholds. Each panel has its own scale."""
    rows = cells.assign(title=cells["title"].str.wrap(80))
    heights = rows.groupby("title", sort=False).size() + 2
    shape = {"sharex": False, "sharey": False, "aspect": 9, "height": 1}
    grid = sns.FacetGrid(
        rows, row="title", hue="verdict", palette=colours, gridspec_kws={"height_ratios": list(heights)}, **shape
    )
    grid.figure.set_figheight(0.23 * heights.sum() + 1)  # before `map`, whose tight layout needs the room
    grid.map(plt.hlines, "cell", "low", "high", lw=2).map(plt.scatter, "estimate", "cell", s=22)
    for title, panel in grid.axes_dict.items():
        goal = rows.loc[rows["title"] == title, ["threshold", "threshold_to"]].iloc[0].dropna()
        panel.vlines(goal, *panel.get_ylim(), color=GREY, ls="--")
    grid.set_titles("").set_titles("{row_name}", loc="left", size=9).set_axis_labels("", "")
    grid.figure.set_layout_engine("constrained")
    verdicts = [Line2D([], [], color=colour, marker="o", ls="", label=verdict) for verdict, colour in colours.items()]
    grid.figure.legend(handles=verdicts, loc="outside lower center", ncols=len(verdicts))
    return grid.figure
