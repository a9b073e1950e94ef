"""Figure of notebook 08: a forest plot of the verdicts on the report's claims."""

import textwrap
from collections.abc import Callable, Sequence

import numpy as np

from steelnb.report.claims import FAILS, HOLDS, NOT_RUN, ONLY_WHEN, Claim, Verdict
from steelnb.report.style import BLUE, GREY, VERMILION, Figure, draw_legend, style

MARKS = {HOLDS: ("o", BLUE), ONLY_WHEN: ("D", "#B37400"), FAILS: ("X", VERMILION), NOT_RUN: ("_", GREY)}
"""Mark and colour of each verdict: told apart by either."""
LINE_IN, LETTERS = 0.17, 105
MINUS = "\N{MINUS SIGN}"


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
        panel.text(
            -1.4, y, "\n".join(text), va="top", fontsize=9, color=colour, zorder=3,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
        )  # fmt: skip
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
