"""A recorded flight: where it went, drifting and corrected, and its errors over time where there is truth."""

import numpy as np
from matplotlib.ticker import MaxNLocator

from steelnb.datatypes import Array, Trajectory
from steelnb.figures.style import COLOURS, LABELS, Figure, style

DRIFTING = "drifting"


def figure_recorded_errors(stamp_s: Array, prior_m: Array, corrected_m: Array, method: str, title: str) -> Figure:
    """Distance to the truth over time, before and after correction; ``prior_m`` and ``corrected_m`` are ``(N,)``."""
    with style():
        figure = Figure(figsize=(9, 4.2))
        panel = figure.add_subplot()
        time_s = stamp_s - stamp_s[0]
        named = ((DRIFTING, prior_m, COLOURS["none"]), (LABELS[method], corrected_m, _colour(method)))
        for label, error, colour in named:
            rms = float(np.sqrt((error**2).mean()))
            panel.plot(time_s, error, color=colour, label=f"{label}: rms {rms:.3f} m, max {error.max():.3f} m")
        panel.set(xlabel="time (s)", ylabel="distance to the truth (m)", xlim=(0, max(time_s[-1], 1e-3)), title=title)
        panel.set_ylim(0, 1.25 * max(panel.get_ylim()[1], 1e-3))
        panel.legend(loc="upper left")
    return figure


def figure_recorded_trajectories(
    prior: Trajectory, corrected: Trajectory, truth: Trajectory | None, method: str, title: str
) -> Figure:
    """The path from above and from the side on which it is widest, at one scale, metres in the world frame."""
    named = [(DRIFTING, prior, COLOURS["none"], 1.2), (LABELS[method], corrected, _colour(method), 1.4)]
    if truth is not None:
        named.insert(1, ("truth", truth, COLOURS["truth"], 1.6))
    everything = np.concatenate([path.position for _, path, _, _ in named])
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = 0.06 * max(float((high - low).max()), 0.1)
    low, high = low - margin, high + margin
    wide = int(np.argmax((high - low)[:2]))
    views = ((0, 1, "from above"), (wide, 2, "from the side"))
    widths = np.array([high[across] - low[across] for across, _, _ in views])
    heights = np.array([high[up] - low[up] for _, up, _ in views])
    inches = min(9.4 / widths.sum(), 7.0 / heights.max())  # for a metre, in both panels
    with style():
        figure = Figure(figsize=(max(inches * widths.sum(), 5.0) + 1.6, max(inches * heights.max(), 1.2) + 1.7))
        panels = figure.subplots(1, 2, width_ratios=widths.tolist())
        for panel, (across, up, name) in zip(panels, views, strict=True):
            for label, path, colour, width in named:
                panel.plot(path.position[:, across], path.position[:, up], color=colour, linewidth=width, label=label)
            panel.plot(*prior.position[0][[across, up]], "o", color=COLOURS["truth"], markersize=5, label="start")
            panel.set(xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)", aspect="equal", title=name)
            panel.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]))
            for axis in (panel.xaxis, panel.yaxis):
                most = int(1.4 * inches * np.ptp(axis.get_view_interval()))
                axis.set_major_locator(MaxNLocator(max(1, min(8, most)), steps=[1, 2, 5, 10]))
        figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        figure.suptitle(title, fontsize=12)
    return figure


def _colour(method: str) -> str:
    return COLOURS["report"] if method == "none" else COLOURS[method]
