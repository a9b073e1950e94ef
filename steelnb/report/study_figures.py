"""Notebooks 08 and 11: the error over the seeds of a study, by noise and method and over time; verdicts on claims."""

import textwrap
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from steelnb.report.batch import REPORT_CLOUD_ODOMETRY, REPORT_SEGMENT_ODOMETRY
from steelnb.report.claims import FAILS, HOLDS, NOT_RUN, ONLY_WHEN, Claim, Verdict
from steelnb.report.style import BLUE, COLOURS, GREY, LABELS, VERMILION, Figure, draw_legend, draw_sample, style
from steelnb.types import Array

PERCENTILES = (10, 50, 90)
ERROR_LIMITS_M = (0.003, 10.0)
MARKS = {HOLDS: ("o", BLUE), ONLY_WHEN: ("D", "#B37400"), FAILS: ("X", VERMILION), NOT_RUN: ("_", GREY)}
"""Mark and colour of each verdict: told apart by either."""
WHITE = {"facecolor": "white", "edgecolor": "none", "pad": 0.7}
"""Box behind a text."""
LINE_IN, LETTERS = 0.17, 105
MINUS = "\N{MINUS SIGN}"


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Mean, worst and number of seeds of ``ate_rmse_m`` for each case and method, and of what lies outside gaps."""
    named = {"seeds": ("seed", "count"), "ate_mean_m": ("ate_rmse_m", "mean"), "ate_worst_m": ("ate_rmse_m", "max")}
    if "ate_outside_gaps_rmse_m" in runs:
        named["outside_gaps_mean_m"] = ("ate_outside_gaps_rmse_m", "mean")
        named["outside_gaps_worst_m"] = ("ate_outside_gaps_rmse_m", "max")
        named["after_gaps_worst_m"] = ("error_after_gaps_max_m", "max")
    return runs.groupby(["case", "method"], sort=False).agg(**named).reset_index()


def percentile_bands(runs: pd.DataFrame, name: str) -> tuple[Array, Array]:
    """Times ``(T,)`` and `PERCENTILES` ``(3, T)`` over the runs of a curve, at the times of the longest run."""
    time = max(runs["curve_time_s"], key=lambda stamps: stamps[-1])
    curves = [
        np.interp(time, stamps, values, right=np.nan)
        for stamps, values in zip(runs["curve_time_s"], runs[name], strict=True)
    ]
    return np.asarray(time, dtype=float), np.nanpercentile(np.asarray(curves, dtype=float), PERCENTILES, axis=0)


@style()
def figure_accuracy(table: pd.DataFrame, goal_m: float, worst_m: float) -> Figure:
    """``ate_rmse_m`` of each row of a table of runs as a dot, means as bars, a column for each noise and method.

    ``goal_m`` (for the mean) and ``worst_m`` (for any seed) are drawn as lines.
    """
    groups = table.groupby(["case", "method"], sort=False)["ate_rmse_m"]
    figure = Figure(figsize=(1.6 + 1.15 * len(groups), 4.6))
    panel = figure.add_subplot()
    labels = []
    for k, (key, values) in enumerate(groups):
        case, method = map(str, cast(tuple, key))
        mean = draw_sample(panel, k, 100 * values.to_numpy(), COLOURS.get(method, BLUE), width=0.45, alpha=0.8)
        panel.annotate(f"{mean:.1f}", (k + 0.27, mean), va="center", fontsize=10, bbox=WHITE)
        short = case.replace("+yaw-random-walk", "\n+ yaw walk").replace(", blind", ",\nblind")
        labels.append(f"{short}\n{LABELS.get(method, method)}")
    for limit, dash, whom in ((100 * goal_m, "--", "the mean"), (100 * worst_m, ":", "any seed")):
        panel.axhline(limit, color=COLOURS["report"], linestyle=dash, label=f"goal for {whom}, {limit:g} cm")
    panel.set_xticks(range(len(groups)), labels, fontsize=9)
    panel.set(ylabel="ATE, root mean square (cm)", xlim=(-0.5, len(groups) - 0.3), ylim=(0, None))
    panel.grid(axis="x", visible=False)
    panel.set_ylim(0, 1.25 * panel.get_ylim()[1])
    panel.legend(loc="upper left")
    return figure


@style()
def figure_error_bands(runs: pd.DataFrame, methods: Sequence[str]) -> Figure:
    """Error over time, a row for each method and a column for each flight and noise: the median of the seeds, and the
    band of their 10th to 90th percentile.

    ``runs`` are rows of a study of one sensor and duration. The drift without correction stands behind; the grey range
    is that of the report's single seed.
    """
    cases = list(dict.fromkeys(zip(runs["noise"], runs["trajectory"], strict=True))) or [("", "")]
    figure = Figure(figsize=(1.0 + 2.5 * max(len(cases), 2), 0.9 + 2.0 * len(methods)))
    grid = figure.subplots(len(methods), len(cases), sharex=True, sharey=True, squeeze=False)
    of_report = False
    for row, method in enumerate(methods):
        for column, (noise, trajectory) in enumerate(cases):
            panel = grid[row, column]
            case = (runs["noise"] == noise) & (runs["trajectory"] == trajectory) & (runs["method"] == method)
            _draw_bands(panel, runs[case & (runs["status"] == "ok")], method)
            of_report |= _draw_report(panel, noise, trajectory, method)
            panel.set(xlabel="time (s)", ylabel=f"{LABELS.get(method, method)}\nerror (m)")
            panel.label_outer()
            if row == 0:
                panel.set_title(f"{trajectory}\n{noise.replace('+yaw-random-walk', ' + yaw')}", fontsize=11)
    grid[0, 0].set(yscale="log", ylim=ERROR_LIMITS_M)
    grid[0, 0].yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    keys: dict[str, dict[str, Any]] = {
        "no correction: median, 10–90 %": {"color": COLOURS["none"], "linestyle": "--"},
        "corrected: median, 10–90 %": {"color": "#333333"},
    }
    if of_report:
        keys["corrected, the report's one seed"] = {"color": COLOURS["report"], "alpha": 0.35, "linewidth": 8}
    draw_legend(figure, keys, "outside upper center", ncols=3 if len(cases) > 3 else 1, fontsize=10)
    return figure


def _draw_bands(panel: Axes, runs: pd.DataFrame, method: str) -> None:
    """Both errors of some runs."""
    if runs.empty:
        panel.text(0.5, 0.5, "not run", transform=panel.transAxes, ha="center", va="center", color=GREY)
        return
    looks = (("curve_raw_m", COLOURS["none"], "--", 0.13), ("curve_error_m", COLOURS.get(method, BLUE), "-", 0.3))
    for name, colour, dashes, alpha in looks:
        time, (low, median, high) = percentile_bands(runs, name)
        shown = time > 0  # at the start the error is zero, which has no logarithm
        panel.fill_between(time[shown], low[shown], high[shown], color=colour, alpha=alpha, linewidth=0)
        panel.plot(time[shown], median[shown], color=colour, linestyle=dashes)
    panel.set_xlim(0, time[-1])
    panel.text(0.97, 0.04, f"{runs['seed'].nunique()} seeds", transform=panel.transAxes, ha="right", fontsize=9)


def _draw_report(panel: Axes, noise: str, trajectory: str, method: str) -> bool:
    """The range of the report's corrected error, where it shows one; True then."""
    found = REPORT_CLOUD_ODOMETRY.get(noise, {}).get(method, {}).get(trajectory)
    if method == "average" and noise in REPORT_CLOUD_ODOMETRY and trajectory in REPORT_SEGMENT_ODOMETRY:
        found = (0.0, REPORT_SEGMENT_ODOMETRY[trajectory]["max_m"])
    if found:
        panel.axhspan(max(found[0], ERROR_LIMITS_M[0]), found[1], color=COLOURS["report"], alpha=0.18, linewidth=0)
    return found is not None


@style()
def figure_claims(verdicts: Sequence[Verdict]) -> Figure:
    """Forest plot: below each claim, its estimate and 95 % interval in each cell against the claim's threshold.

    Every claim has its own scale, turned so that what is as claimed lies to the right of the upright line, in the
    shaded part. A claim that was not run has the reason in place of cells. Wide intervals leave the panel.
    """
    headings = [_heading(each) for each in verdicts]
    rows = sum(len(text) + len(each.cells) + 1 for text, each in zip(headings, verdicts, strict=True))
    figure = Figure(figsize=(10, LINE_IN * rows + 1.2))
    panel = figure.add_subplot()
    panel.axvline(0, color="#555555", linewidth=0.9, zorder=0)
    y, labels, numbers = 0.0, {}, {}
    for text, each in zip(headings, verdicts, strict=True):
        colour = MARKS[each.verdict][1]
        panel.text(-1.4, y, "\n".join(text), va="top", fontsize=9, color=colour, zorder=3, bbox=WHITE)
        y += len(text)
        place, end = _scale(each)
        panel.fill_betweenx([y, y + len(each.cells)], 0, end, color=BLUE, alpha=0.08, linewidth=0)
        for cell in each.cells.to_dict("records"):
            y += 0.5
            mark, colour = MARKS[HOLDS if cell["holds"] else FAILS]
            panel.plot([place(cell["low"]), place(cell["high"])], [y, y], color=colour)
            panel.plot(place(cell["estimate"]), y, mark, color=colour, markersize=5.5)
            labels[y] = ", ".join(filter(None, (cell[name] for name in each.claim.by)))
            numbers[y] = f"{interval_text(cell['estimate'], cell['low'], cell['high'])} {each.claim.unit}".rstrip()
            y += 0.5
        y += 1
    panel.set(xlim=(-1, 1), ylim=(rows, 0), xticks=[-0.5, 0.5], xlabel="estimate [95 %] on the right")
    panel.set_xticklabels(["not ←", "→ as claimed"])
    panel.set_yticks([*labels], labels.values(), fontsize=8.5)
    panel.secondary_yaxis("right").set_yticks([*numbers], numbers.values(), fontsize=8.5)
    panel.grid(False)
    keys = {word: {"marker": mark, "color": colour, "ls": ""} for word, (mark, colour) in MARKS.items()}
    draw_legend(figure, keys, "outside upper center")
    return figure


def _heading(verdict: Verdict) -> list[str]:
    """Verdict, claim, its section and its test, in lines."""
    text = f"{verdict.verdict.upper()} · {verdict.claim.claim} ({verdict.claim.section}; {claim_goal(verdict.claim)})"
    return textwrap.wrap(text + (f": {verdict.condition}" if verdict.verdict == NOT_RUN else ""), LETTERS)


def _scale(verdict: Verdict) -> tuple[Callable[[float], float], float]:
    """The place of a number between -1 and 1, and where what is claimed ends.

    The claim's (first) threshold lies at 0. All estimates are within the panel, and intervals as far as they reach no
    more than twice as far from the threshold.
    """
    claim, cells = verdict.claim, verdict.cells
    first, last, sign = claim.threshold[0], claim.threshold[-1], -1.0 if claim.comparison == "below" else 1.0
    if cells.empty:
        return float, 0.0
    nearest = float(np.abs(cells["estimate"] - first).max())
    farthest = float(np.abs(cells[["low", "high"]].to_numpy() - first).max())
    reach = 1.1 * max(min(farthest, 2 * nearest), 1.2 * (last - first)) or 1.0
    return lambda value: sign * (value - first) / reach, (
        last - first
    ) / reach if claim.comparison == "between" else 1.0


def claim_goal(claim: Claim) -> str:
    """The test of a claim's number: ``error_mean_m, difference < 0 m``."""
    low, high = (f"{value:g}".replace("-", MINUS) for value in (claim.threshold[0], claim.threshold[-1]))
    test = {"below": f"< {low}", "above": f"> {low}", "between": f"in {low} to {high}"}[claim.comparison]
    return f"{claim.metric}, {claim.form} {test} {claim.unit}".rstrip()


def interval_text(estimate: float, low: float, high: float) -> str:
    """An estimate with its interval, to two digits of the interval's width."""
    width = high - low
    digits = int(np.clip(1 - np.floor(np.log10(width)), 0, 4)) if width > 1e-9 else 2
    middle, first, last = (f"{round(value, digits) + 0.0:.{digits}f}" for value in (estimate, low, high))
    return f"{middle} [{first}, {last}]".replace("-", MINUS)
