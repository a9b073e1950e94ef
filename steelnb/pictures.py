"""The two pictures of a recording or a cloud: paths with their errors over time, and bars over points."""

from collections.abc import Callable, Mapping

import numpy as np

from steelnb.metrics import position_error_m
from steelnb.plots import (
    COLOURS,
    Figure,
    draw_lines,
    end_points,
    gather_legend,
    project_perspective,
    style,
    thinned,
)
from steelnb.types import Array, Segments, Trajectory

POINTS_MAX = 60_000
VERTICAL_DEG, HORIZONTAL_DEG = 20.0, 10.0
"""Bars up to 20° from the vertical count as near vertical, since legs lean; those up to 10° from the horizontal as near
horizontal."""


@style()
def figure_path(paths: Mapping[str, tuple[Trajectory, str]], truth: Trajectory | None, title: str) -> Figure:
    """Paths from above and from the side on which the first is wider, metres in the world frame; and over time their
    distance to the truth or, without one, to the first path.

    ``paths``: label → trajectory and colour, the recorded one first. They have a pose at every stamp of the truth.
    """
    prior = next(iter(paths.values()))[0]
    true = prior if truth is None else truth
    wider = int(np.argmax(np.ptp(prior.position[:, :2], axis=0)))
    figure = Figure(figsize=(12, 4.4))
    *views, panel = figure.subplots(1, 3)
    for view, (across, up), name in zip(views, ((0, 1), (wider, 2)), ("from above", "from the side"), strict=True):
        if truth is not None:
            view.plot(*truth.position[:, [across, up]].T, color=COLOURS["truth"], linewidth=3.6, label="truth")
        for label, (path, colour) in paths.items():
            view.plot(*path.position[:, [across, up]].T, color=colour, linewidth=1.3, label=label)
        view.plot(*prior.position[0][[across, up]], "o", color=COLOURS["truth"], markersize=5, label="start")
        view.set(xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)", title=name)
        view.set_aspect("equal", adjustable="datalim")
    for label, (path, colour) in paths.items():
        if path is not true:
            distance_m = position_error_m(path.at(true.stamp_s), true)
            panel.plot(true.stamp_s - true.stamp_s[0], distance_m, color=colour, label=label)
    what = "to the recorded poses" if truth is None else "to the truth"
    panel.set(xlabel="time (s)", ylabel=f"distance {what} (m)", title="over time", ylim=(0, None))
    gather_legend(figure, ncols=len(paths) + 2)
    figure.suptitle(title, fontsize=12)
    return figure


@style()
def figure_bars(points: Array, segments: Segments, title: str) -> Figure:
    """Bars over points ``(N, 3)``, metres: along y, along x and in perspective, coloured by their orientation."""
    cloud, ends = thinned(points, POINTS_MAX), end_points(segments)
    everything = np.concatenate([cloud, ends.reshape(-1, 3)])
    lean_deg = np.degrees(np.arccos(np.clip(np.abs(segments.direction[:, 2]), 0, 1)))
    upright, level = lean_deg <= VERTICAL_DEG, lean_deg >= 90 - HORIZONTAL_DEG
    kinds = {
        "near vertical": (upright, COLOURS["leg"]),
        "inclined": (~upright & ~level, COLOURS["bracing"]),
        "near horizontal": (level, COLOURS["ring"]),
    }
    views: dict[str, Callable[[Array], Array]] = {
        "from the front": lambda world: world[..., [0, 2]],
        "from the side": lambda world: world[..., [1, 2]],
        "in perspective": lambda world: project_perspective(world, everything),
    }
    figure = Figure(figsize=(11, 6.5))
    for panel, (name, project) in zip(figure.subplots(1, 3), views.items(), strict=True):
        panel.plot(*project(cloud).T, "o", ms=1.0, mew=0, color=COLOURS["points"], rasterized=True)
        for label, (mask, colour) in kinds.items():
            draw_lines(panel, project(ends[mask]), colors=colour, linewidths=1.1, label=f"{label} ({mask.sum()})")
        panel.set(title=name, ylabel="z (m)", xlabel="y (m)" if name == "from the side" else "x (m)")
        panel.set_aspect("equal", adjustable="datalim")
        panel.autoscale_view()
    panel.set_axis_off()
    gather_legend(figure, ncols=3)
    figure.suptitle(title, fontsize=12)
    return figure
