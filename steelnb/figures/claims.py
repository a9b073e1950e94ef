"""The report's claims against many seeds: a forest plot of the verdicts, and errors over time with bands."""

import textwrap
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from steelnb.datatypes import Array
from steelnb.figures.report import REPORT_CLOUD_ODOMETRY, REPORT_SEGMENT_ODOMETRY
from steelnb.figures.style import COLOURS, LABELS, Figure, style
from steelnb.study.claims import FAILS, HOLDS, NOT_RUN, ONLY_WHEN, Claim, Verdict

MARKS = {HOLDS: ("o", "#0072B2"), ONLY_WHEN: ("D", "#B37400"), FAILS: ("X", "#D55E00"), NOT_RUN: ("$–$", "#777777")}
"""Mark and colour of each verdict: told apart by either."""
SHORT = {
    "random-walk+yaw-random-walk": "walk + yaw",
    "random-walk": "walk",
    "constant-drift": "constant",
    "hough.dx_m=": "dx ",
    "hough.min_votes=": "votes ",
}
WIDTH, LINE, CLAIM, CELL, AXIS, NUMBERS = 10.0, 0.165, 0.33, 4.1, (5.65, 7.9), 8.05  # inches
LETTERS = 52  # in a line of a claim
MINUS = "\N{MINUS SIGN}"
PERCENTILES = (10, 50, 90)
ERROR_LIMITS_M = (0.003, 10.0)


def figure_claims(verdicts: Sequence[Verdict]) -> Figure:
    """Forest plot: a claim a row, with its estimate and 95 % interval in each cell against the claim's threshold.

    Every row has its own scale, turned so that what is as claimed lies to the right of the upright line, in the shaded
    part. A claim that was not run has the reason in place of cells. An interval that leaves its row ends in an arrow.
    """
    rows = [textwrap.wrap(each.claim.claim, LETTERS) for each in verdicts]
    lines = [max(len(text) + 1, len(each.cells), 2) + 0.9 for text, each in zip(rows, verdicts, strict=True)]
    height = LINE * (sum(lines) + 6)
    with style():
        figure = Figure(figsize=(WIDTH, height))
        figure.set_layout_engine("none")
        panel = figure.add_axes((0, 0, 1, 1))
        panel.set(xlim=(0, WIDTH), ylim=(height, 0))  # in inches, downwards
        panel.set_axis_off()
        middle = 0.5 * (AXIS[0] + AXIS[1])
        for x, text, side in (
            (CLAIM, "claim · section · number", "left"), (CELL, "where", "left"),
            (middle - 0.08, "not ←", "right"), (middle + 0.08, "→ as claimed", "left"),
            (NUMBERS, "estimate [95 %]", "left"),
        ):  # fmt: skip
            panel.text(x, 3.6 * LINE, text, ha=side, va="center", fontsize=10, fontweight="bold")
        handles = [
            Line2D([], [], linestyle="", marker=mark, color=colour, markersize=8, label=word)
            for word, (mark, colour) in MARKS.items()
            if any(each.verdict == word for each in verdicts)
        ]
        panel.legend(handles=handles, loc="upper left", ncols=4, fontsize=10, bbox_to_anchor=(0, 1), borderaxespad=0.3)
        top = 4.8 * LINE
        for words, each, count in zip(rows, verdicts, lines, strict=True):
            _draw_row(panel, each, words, top, count)
            top += count * LINE
    return figure


def _draw_row(panel: Axes, verdict: Verdict, text: Sequence[str], top: float, count: float) -> None:
    """One claim, from ``top`` over ``count`` lines."""
    panel.plot([0.08, WIDTH - 0.08], [top, top], color="#cccccc", linewidth=0.7)
    mark, colour = MARKS[verdict.verdict]
    line = top + (0.95 + np.arange(len(text) + 1)) * LINE
    panel.plot(0.18, line[0], marker=mark, color=colour, markersize=8)
    for y, words in zip(line, text, strict=False):
        panel.text(CLAIM, y, words, va="center", fontsize=9.5)
    panel.text(
        CLAIM, line[-1], f"{verdict.claim.section} · {goal(verdict.claim)}", va="center", fontsize=8.5, color="#555"
    )
    if verdict.verdict == NOT_RUN:
        reason = textwrap.wrap(f"not run: {verdict.condition}", 85)[: int(count)]
        for k, words in enumerate(reason):
            panel.text(CELL, line[0] + k * LINE, words, va="center", fontsize=8.5, color=colour)
        return
    place, ends = _scale(verdict)
    low, high = (float(np.clip(place(end), *AXIS)) for end in ends)
    sides = (top + 0.25 * LINE, top + (count - 0.25) * LINE)
    panel.fill_between([low, high], *sides, color="#0072B2", alpha=0.08, linewidth=0)
    for x in {low, high} - set(AXIS):
        panel.plot([x, x], sides, color="#555", linewidth=0.9)
    for k, cell in enumerate(verdict.cells.to_dict("records")):
        y = line[0] + k * LINE
        panel.text(CELL, y, cell_label([cell[name] for name in verdict.claim.by]), va="center", fontsize=8.5)
        _draw_cell(panel, y, place, cell)
        numbers = told(cell["estimate"], cell["low"], cell["high"])
        panel.text(NUMBERS, y, f"{numbers} {verdict.claim.unit}".rstrip(), va="center", fontsize=8.5)


def _draw_cell(panel: Axes, y: float, place: Callable[[float], float], cell: Mapping[Hashable, Any]) -> None:
    """Estimate and interval of one cell, with an arrow where the interval leaves the row."""
    mark, colour = MARKS[HOLDS if cell["holds"] else FAILS]
    first, last = sorted((place(cell["low"]), place(cell["high"])))
    panel.plot(np.clip([first, last], *AXIS), [y, y], color=colour, linewidth=1.6, solid_capstyle="butt")
    panel.plot(place(cell["estimate"]), y, marker=mark, color=colour, markersize=5.5, markeredgewidth=0)
    for end, outside, arrow in ((AXIS[0], first < AXIS[0], "<"), (AXIS[1], last > AXIS[1], ">")):
        if outside:
            panel.plot(end, y, marker=arrow, color=colour, markersize=5, markeredgewidth=0)


def _scale(verdict: Verdict) -> tuple[Callable[[float], float], tuple[float, float]]:
    """Where a number lies across the row, in inches, and the ends of what is claimed as numbers.

    The claim's (first) threshold lies in the middle. All estimates are within the row, and intervals as far as they
    reach no more than twice as far from the threshold.
    """
    claim, cells = verdict.claim, verdict.cells
    first, sign = claim.threshold[0], -1.0 if claim.comparison == "below" else 1.0
    nearest = float(np.abs(cells["estimate"] - first).max())
    farthest = float(np.abs(cells[["low", "high"]].to_numpy() - first).max())
    reach = 1.1 * max(min(farthest, 2 * nearest), 1.2 * (claim.threshold[-1] - first)) or 1.0
    end = claim.threshold[1] if claim.comparison == "between" else sign * np.inf
    half, middle = 0.5 * (AXIS[1] - AXIS[0]), 0.5 * (AXIS[0] + AXIS[1])
    return lambda value: middle + half * sign * (value - first) / reach, (first, end)


def goal(claim: Claim) -> str:
    """What a claim says of its number: ``error_mean_m, difference < 0 m``."""
    low, high = (f"{value:g}".replace("-", MINUS) for value in (claim.threshold[0], claim.threshold[-1]))
    test = {"below": f"< {low}", "above": f"> {low}", "between": f"in {low} to {high}"}[claim.comparison]
    return f"{claim.metric}, {claim.form} {test} {claim.unit}".rstrip()


def cell_label(values: Sequence[str]) -> str:
    """The values of a cell in a few letters."""
    text = ", ".join(value for value in values if value)
    for long, short in SHORT.items():
        text = text.replace(long, short)
    return text


def told(estimate: float, low: float, high: float) -> str:
    """An estimate with its interval, to two digits of the interval's width."""
    width = high - low
    digits = int(np.clip(1 - np.floor(np.log10(width)), 0, 4)) if width > 1e-9 else 2
    middle, first, last = (f"{round(value, digits) + 0.0:.{digits}f}" for value in (estimate, low, high))
    return f"{middle} [{first}, {last}]".replace("-", MINUS)


def figure_error_bands(runs: pd.DataFrame, methods: Sequence[str]) -> Figure:
    """Error over time, a row for each method and a column for each flight and noise: the median of the seeds, and the
    band of their 10th to 90th percentile.

    ``runs`` are rows of a study of one sensor and duration. The drift without correction stands behind; the grey range
    is that of the report's single seed.
    """
    cases = list(dict.fromkeys(zip(runs["noise"], runs["trajectory"], strict=True))) or [("", "")]
    with style():
        figure = Figure(figsize=(1.0 + 2.5 * max(len(cases), 2), 0.9 + 2.0 * len(methods)))
        grid = figure.subplots(len(methods), len(cases), sharex=True, sharey=True, squeeze=False)
        of_report = False
        for row, method in enumerate(methods):
            for column, (noise, trajectory) in enumerate(cases):
                panel = grid[row, column]
                case = (runs["noise"] == noise) & (runs["trajectory"] == trajectory) & (runs["method"] == method)
                _draw_bands(panel, runs[case & (runs["status"] == "ok")], method)
                of_report |= _draw_report(panel, noise, trajectory, method)
                if row == 0:
                    panel.set_title(f"{trajectory}\n{noise.replace('+yaw-random-walk', ' + yaw')}", fontsize=11)
                if row == len(methods) - 1:
                    panel.set_xlabel("time (s)")
                if column == 0:
                    panel.set_ylabel(f"{LABELS.get(method, method)}\nerror (m)")
        grid[0, 0].set(yscale="log", ylim=ERROR_LIMITS_M)
        grid[0, 0].yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        handles = [
            Line2D([], [], color=COLOURS["none"], linestyle="--", label="no correction: median, 10–90 %"),
            Line2D([], [], color="#333333", label="corrected: median, 10–90 %"),
        ]
        if of_report:
            handles.append(
                Line2D(
                    [], [], color=COLOURS["report"], alpha=0.35, linewidth=8, label="corrected, the report's one seed"
                )
            )
        figure.legend(handles=handles, loc="outside upper center", ncols=3 if len(cases) > 3 else 1, fontsize=10)
    return figure


def _draw_bands(panel: Axes, runs: pd.DataFrame, method: str) -> None:
    """Both errors of some runs."""
    if runs.empty:
        panel.text(0.5, 0.5, "not run", transform=panel.transAxes, ha="center", va="center", color="#777777")
        return
    looks = (("curve_raw_m", COLOURS["none"], "--", 0.13), ("curve_error_m", COLOURS.get(method, "#0072B2"), "-", 0.3))
    for name, colour, dashes, alpha in looks:
        time, (low, median, high) = bands(runs, name)
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


def bands(runs: pd.DataFrame, name: str) -> tuple[Array, Array]:
    """Times ``(T,)`` and `PERCENTILES` ``(3, T)`` over the runs of a curve, at the times of the longest run."""
    time = max(runs["curve_time_s"], key=lambda stamps: stamps[-1])
    curves = [
        np.interp(time, stamps, values, right=np.nan)
        for stamps, values in zip(runs["curve_time_s"], runs[name], strict=True)
    ]
    return np.asarray(time, dtype=float), np.nanpercentile(np.asarray(curves, dtype=float), PERCENTILES, axis=0)
