"""Notebooks 12 and 08: the error over the seeds of a study, by noise and method and over time; verdicts on claims."""

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from steelnb.batch import caption, report_range
from steelnb.claims import FAILS, HOLDS, NOT_RUN, OPEN, USUAL, Claim, Verdict, cell_name
from steelnb.plots import COLOURS, GREY, LABELS, REPORT_BAND, Figure, draw_legend, style
from steelnb.types import Array

PERCENTILES = (10, 50, 90)
MARKS = {HOLDS: ("o", "right"), OPEN: ("D", "undecided"), FAILS: ("X", "wrong"), NOT_RUN: ("_", "undecided")}
"""Mark and colour of each verdict: told apart by either."""
WHITE = {"facecolor": "white", "edgecolor": "none", "pad": 0.7}
"""Box behind a text."""
LINE_IN, LETTERS, FRAME_LINES = 0.17, 100, 2.4
MINUS = "\N{MINUS SIGN}"


def percentile_bands(runs: pd.DataFrame, name: str) -> tuple[Array, Array]:
    """Times ``(T,)`` and `PERCENTILES` ``(3, T)`` over the runs of a curve, at the times of the longest run."""
    time = max(runs["curve_time_s"], key=lambda stamps: stamps[-1])
    curves = [
        np.interp(time, stamps, values, right=np.nan)
        for stamps, values in zip(runs["curve_time_s"], runs[name], strict=True)
    ]
    return np.asarray(time, dtype=float), np.nanpercentile(np.asarray(curves, dtype=float), PERCENTILES, axis=0)


@style()
def figure_error_bands(runs: pd.DataFrame, methods: Sequence[str]) -> Figure:
    """Error over time, a row for each method and a column for each flight and noise: the median of the seeds, and the
    band of their 10th to 90th percentile.

    ``runs`` are rows of a study of one sensor and duration. The drift without correction stands behind; the grey range
    is that of the report's single seed.
    """
    runs = runs[runs["method"].isin(methods)]
    cases = list(dict.fromkeys(zip(runs["noise"], runs["trajectory"], strict=True))) or [("", "")]
    figure = Figure(figsize=(1.0 + 2.5 * max(len(cases), 2), 1.6 + 2.0 * len(methods)))
    grid = figure.subplots(len(methods), len(cases), sharex=True, sharey=True, squeeze=False)
    of_report = False
    for row, method in enumerate(methods):
        for column, (noise, trajectory) in enumerate(cases):
            panel = grid[row, column]
            case = (runs["noise"] == noise) & (runs["trajectory"] == trajectory) & (runs["method"] == method)
            _draw_bands(panel, runs[case & (runs["status"] == "ok")], method)
            panel.set(xlabel="time (s)", ylabel=f"{LABELS[method]}\nerror (m)")
            panel.label_outer()
            if row == 0:
                panel.set_title(f"{trajectory}\n{noise.replace('+yaw-random-walk', ' + yaw')}", fontsize=11)
    grid[0, 0].set_yscale("log")
    lowest_m = grid[0, 0].get_ylim()[0]
    for (row, column), panel in np.ndenumerate(grid):
        of_report |= _draw_report(panel, *cases[column], methods[row], lowest_m)
    keys: dict[str, dict[str, Any]] = {LABELS["none"]: {"color": COLOURS["none"], "ls": "--"}}
    keys |= {LABELS[method]: {"color": COLOURS[method]} for method in methods}
    keys["10–90 % of the seeds"] = {"fc": GREY, "alpha": 0.3}
    if of_report:
        keys["the report's one seed"] = REPORT_BAND
    draw_legend(figure, keys, ncols=4 if len(cases) > 3 else 3 if len(cases) > 2 else 2, fontsize=10)
    if len(runs):
        figure.suptitle(f"{caption(runs.drop(columns=['trajectory', 'noise']))}: median and band")
    return figure


def _draw_bands(panel: Axes, runs: pd.DataFrame, method: str) -> None:
    """Draw both errors of some runs."""
    if runs.empty:
        panel.text(0.5, 0.5, "not run", transform=panel.transAxes, ha="center", va="center", color=GREY)
        return
    looks = (("curve_raw_m", COLOURS["none"], "--", 0.13), ("curve_error_m", COLOURS[method], "-", 0.3))
    for name, colour, dashes, alpha in looks:
        time, (low, median, high) = percentile_bands(runs, name)
        shown = time > 0  # at the start the error is zero, which has no logarithm
        panel.fill_between(time[shown], low[shown], high[shown], color=colour, alpha=alpha, linewidth=0)
        panel.plot(time[shown], median[shown], color=colour, linestyle=dashes)
    panel.set_xlim(0, time[-1])


def _draw_report(panel: Axes, noise: str, trajectory: str, method: str, lowest_m: float) -> bool:
    """The range of the report's corrected error down to ``lowest_m``, where it shows one; True then."""
    found = report_range(noise, method, trajectory)
    if found:
        panel.axhspan(max(found[0], lowest_m), found[1], **REPORT_BAND)
    return found is not None


def figures_by_section(verdicts: Sequence[Verdict]) -> dict[str, Figure]:
    """A `figure_claims` for each section of the report, ``claims_3_2_3`` for section 3.2.3."""
    sections: dict[str, list[Verdict]] = {}
    for each in verdicts:
        sections.setdefault(each.claim.section.split(",")[0], []).append(each)
    return {f"claims_{section.replace('.', '_')}": figure_claims(own) for section, own in sections.items()}


@style()
def figure_claims(verdicts: Sequence[Verdict]) -> Figure:
    """Forest plot: a panel for each claim, with its estimate and 95 % interval in each cell; what is claimed is shaded.

    Every claim has its own scale, in the unit of its number, with the claim's threshold in the middle and turned so
    that what is as claimed lies to the right. Wide intervals leave the panel. A claim that was not run has the reason
    in place of cells.
    """
    headings = [_heading(each) for each in verdicts]
    cells = [len(each.cells) for each in verdicts]
    lines = sum(cells) + sum(len(text) + FRAME_LINES for text in headings)
    figure = Figure(figsize=(10, LINE_IN * lines + 0.9))
    panels = figure.subplots(len(verdicts), 1, squeeze=False, height_ratios=[max(count, 0.2) for count in cells])[:, 0]
    for panel, text, each in zip(panels, headings, verdicts, strict=True):
        panel.set_title("\n".join(text), loc="left", fontsize=9.5)
        if each.cells.empty:
            panel.set_axis_off()
        else:
            _draw_claim(panel, each)
    keys: dict[str, dict[str, Any]] = {
        word: {"marker": mark, "color": COLOURS[name], "ls": ""} for word, (mark, name) in MARKS.items()
    }
    draw_legend(figure, keys | {"as claimed": {"fc": COLOURS["right"], "alpha": 0.15}}, "outside upper center")
    return figure


def _draw_claim(panel: Axes, verdict: Verdict) -> None:
    """The cells of a claim over its scale, and their numbers on the right."""
    claim, rows = verdict.claim, verdict.cells.to_dict("records")
    first, last = claim.threshold[0], claim.threshold[-1]
    nearest = float(np.abs(verdict.cells["estimate"] - first).max())
    farthest = float(np.abs(verdict.cells[["low", "high"]].to_numpy() - first).max())
    reach = 1.1 * max(min(farthest, 2 * nearest), 1.2 * (last - first)) or 1.0
    right = first - reach if claim.comparison == "below" else first + reach
    left = 2 * first - right
    if claim.form == "ratio":  # of lengths and shares: not below 0
        left, right = max(left, 0.0), max(right, 0.0)
    end = last if claim.comparison == "between" else right
    panel.axvspan(first, end, color=COLOURS["right"], alpha=0.1, linewidth=0)
    panel.axvline(first, color=GREY, linewidth=0.9, zorder=0)
    for y, cell in enumerate(rows):
        mark, name = MARKS[cell["verdict"]]
        panel.plot([cell["low"], cell["high"]], [y, y], color=COLOURS[name])
        panel.plot(cell["estimate"], y, mark, color=COLOURS[name], markersize=5.5)
    numbers = [f"{interval_text(cell['estimate'], cell['low'], cell['high'])} {claim.unit}".rstrip() for cell in rows]
    names = [cell_name(cell[name] for name in claim.by) for cell in rows]
    panel.set(xlim=(left, right), ylim=(len(rows) - 0.5, -0.5))
    panel.tick_params(axis="x", labelsize=8)
    panel.set_yticks(range(len(rows)), names, fontsize=8.5)
    panel.secondary_yaxis("right").set_yticks(range(len(rows)), numbers, fontsize=8.5)
    panel.grid(axis="y", visible=False)


def _heading(verdict: Verdict) -> list[str]:
    """Verdict, claim, its section, its test, its runs, in lines."""
    claim = verdict.claim
    seeds = sorted({*verdict.cells["n_seeds"]}) or [0]
    number = f"{seeds[0]:g}" + (f" to {seeds[-1]:g}" if len(seeds) > 1 else "")
    runs = f"{number} seeds, sensor {(USUAL | claim.where)['sensor']}"
    text = f"{verdict.verdict.upper()} · {claim.claim} ({claim.section}; {claim_goal(claim)}; {runs})"
    return textwrap.wrap(text + (f": {verdict.missing}" if verdict.verdict == NOT_RUN else ""), LETTERS)


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
