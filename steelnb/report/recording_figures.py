"""The figure of a recorded flight: its path, and how far it is from the truth or from the recorded poses."""

import numpy as np

from steelnb.metrics import position_error_m
from steelnb.plots import COLOURS, LABELS, Figure, gather_legend, style
from steelnb.types import Trajectory


@style()
def figure_path(prior: Trajectory, corrected: Trajectory, truth: Trajectory | None, method: str, title: str) -> Figure:
    """The path from above and from the side on which it is wider, metres in the world frame; and over time the distance
    of both paths to the truth or, without one, of the corrected path to the recorded poses."""
    paths = {"drifting": (prior, COLOURS["none"], 1.2), LABELS[method]: (corrected, COLOURS[method], 1.3)}
    shown = paths if truth is None else {"truth": (truth, COLOURS["truth"], 3.6)} | paths
    wider = int(np.argmax(np.ptp(prior.position[:, :2], axis=0)))
    figure = Figure(figsize=(12, 4.4))
    *views, panel = figure.subplots(1, 3)
    for view, (across, up), name in zip(views, ((0, 1), (wider, 2)), ("from above", "from the side"), strict=True):
        for label, (path, colour, width) in shown.items():
            view.plot(path.position[:, across], path.position[:, up], color=colour, linewidth=width, label=label)
        view.plot(*prior.position[0][[across, up]], "o", color=COLOURS["truth"], markersize=5, label="start")
        view.set(xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)", title=name)
        view.set_aspect("equal", adjustable="datalim")
    true = prior if truth is None else truth
    for label, (path, colour, _) in paths.items():
        if path is not true:
            distance_m = position_error_m(path.at(true.stamp_s), true)
            panel.plot(true.stamp_s - true.stamp_s[0], distance_m, color=colour, label=label)
    what = "to the recorded poses" if truth is None else "to the truth"
    panel.set(xlabel="time (s)", ylabel=f"distance {what} (m)", title="over time", ylim=(0, None))
    gather_legend(figure, ncols=4)
    figure.suptitle(title, fontsize=12)
    return figure
