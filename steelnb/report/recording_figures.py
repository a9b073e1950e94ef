"""Figures of a recorded flight (notebook 09, `steelnb run`): the path, its errors, odometries compared."""

from collections.abc import Mapping

import numpy as np
from matplotlib.ticker import MaxNLocator

from steelnb.report.style import COLOURS, LABELS, Figure, gather_legend, style
from steelnb.types import Array, Trajectory


@style()
def figure_recorded_trajectories(
    prior: Trajectory, corrected: Trajectory, truth: Trajectory | None, method: str, title: str
) -> Figure:
    """The path from above and from the side on which it is widest, at one scale, metres in the world frame."""
    named = [("drifting", prior, COLOURS["none"], 1.2), (LABELS[method], corrected, COLOURS[method], 1.3)]
    if truth is not None:
        named.insert(1, ("truth", truth, COLOURS["truth"], 3.6))  # wide: the corrected path lies on it
    everything = np.concatenate([path.position for _, path, _, _ in named])
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = 0.06 * max(float((high - low).max()), 0.1)
    low, high = low - margin, high + margin
    views = {"from above": [0, 1], "from the side": [int(np.argmax((high - low)[:2])), 2]}
    widths, heights = np.array([(high - low)[columns] for columns in views.values()]).T
    inches = min(9.4 / widths.sum(), 7.0 / heights.max())  # for a metre, in both panels
    figure = Figure(figsize=(max(inches * widths.sum(), 5.0) + 1.6, max(inches * heights.max(), 1.2) + 1.7))
    panels = figure.subplots(1, 2, width_ratios=widths.tolist())
    for panel, (name, columns) in zip(panels, views.items(), strict=True):
        across, up = columns
        for label, path, colour, width in named:
            panel.plot(path.position[:, across], path.position[:, up], color=colour, linewidth=width, label=label)
        panel.plot(*prior.position[0][columns], "o", color=COLOURS["truth"], markersize=5, label="start")
        panel.set(xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)", aspect="equal", title=name)
        panel.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]))
        for axis in (panel.xaxis, panel.yaxis):
            most = int(1.4 * inches * np.ptp(axis.get_view_interval()))
            axis.set_major_locator(MaxNLocator(max(1, min(8, most)), steps=[1, 2, 5, 10]))
    gather_legend(figure, ncols=4)
    figure.suptitle(title, fontsize=12)
    return figure


@style()
def figure_distances(
    curves: Mapping[str, tuple[Array, Array]], what: str, title: str, times_ms: Mapping[str, Array] | None = None
) -> Figure:
    """Metres ``(N,)`` over stamps ``(N,)`` of odometries side by side, and beside them ``times_ms``, the milliseconds
    ``(K,)`` a scan of each: median, quartiles, and the 5th and 95th percentile.

    ``drifting`` among ``curves`` are the recorded poses, other names methods.
    """
    figure = Figure(figsize=(11 if times_ms else 9, 4.6))
    panels = figure.subplots(1, 2 if times_ms else 1, squeeze=False, width_ratios=(1.6, 1) if times_ms else None)[0]
    begin_s = min(stamp_s[0] for stamp_s, _ in curves.values())
    for name, (stamp_s, distance_m) in curves.items():
        rms = float(np.sqrt((distance_m**2).mean()))
        label = f"{LABELS.get(name, name)}: rms {rms:.3f} m, max {distance_m.max():.3f} m"
        panels[0].plot(
            stamp_s - begin_s, distance_m, color=COLOURS["none" if name == "drifting" else name], label=label
        )
    panels[0].set(xlabel="time (s)", ylabel=what)
    panels[0].set_ylim(0, 1.1 * max(panels[0].get_ylim()[1], 1e-3))
    if times_ms:
        names = [LABELS[name] for name in times_ms]
        panels[1].boxplot(list(times_ms.values()), orientation="horizontal", tick_labels=names, sym="", whis=(5, 95))
        panels[1].set(xlabel="time a scan (ms): median, quartiles, 5 and 95 %", xscale="log")
        panels[1].invert_yaxis()
    gather_legend(figure, ncols=2)
    figure.suptitle(title, fontsize=12)
    return figure
