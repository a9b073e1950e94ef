"""The error of every seed, by noise and method: what one seed cannot show."""

import numpy as np
import pandas as pd

from steelnb.figures.style import COLOURS, LABELS, Figure, style


def figure_accuracy(table: pd.DataFrame, goal_m: float, worst_m: float) -> Figure:
    """``ate_rmse_m`` of each row of a table of runs as a dot, means as bars, a column for each noise and method.

    ``goal_m`` (for the mean) and ``worst_m`` (for any seed) are drawn as lines.
    """
    cases = list(dict.fromkeys(zip(table["case"], table["method"], strict=True)))
    with style():
        figure = Figure(figsize=(1.6 + 1.15 * len(cases), 4.6))
        panel = figure.add_subplot()
        for k, (case, method) in enumerate(cases):
            chosen = table[(table["case"] == case) & (table["method"] == method)]
            error = 100 * chosen["ate_rmse_m"].to_numpy()
            spread = np.linspace(-0.15, 0.15, len(error))
            panel.plot(k + spread, error, "o", color=COLOURS.get(method, "#0072B2"), markersize=6, alpha=0.8)
            panel.plot([k - 0.25, k + 0.25], [error.mean()] * 2, color=COLOURS["truth"], linewidth=2)
            panel.annotate(
                f"{error.mean():.1f}", (k + 0.27, error.mean()), va="center", fontsize=10,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},
            )  # fmt: skip
        panel.axhline(
            100 * goal_m, color=COLOURS["report"], linestyle="--", label=f"goal for the mean, {100 * goal_m:g} cm"
        )
        panel.axhline(
            100 * worst_m, color=COLOURS["report"], linestyle=":", label=f"goal for any seed, {100 * worst_m:g} cm"
        )
        short = {"+yaw-random-walk": "\n+ yaw walk", ", blind": ",\nblind"}
        labels = [f"{_replaced(case, short)}\n{LABELS.get(method, method)}" for case, method in cases]
        panel.set_xticks(range(len(cases)), labels, fontsize=9)
        panel.set(ylabel="ATE, root mean square (cm)", xlim=(-0.5, len(cases) - 0.3), ylim=(0, None))
        panel.grid(axis="x", visible=False)
        panel.set_ylim(0, 1.25 * panel.get_ylim()[1])
        panel.legend(loc="upper left")
    return figure


def _replaced(text: str, short: dict[str, str]) -> str:
    for long, other in short.items():
        text = text.replace(long, other)
    return text
