"""The pictures of a flight and of the bars in a cloud."""

from collections.abc import Mapping

import numpy as np

from steelnb.core.types import Array, Segments, Trajectory
from steelnb.metrics import position_error_m
from steelnb.plots import (
    COLOURS,
    Figure,
    draw_bars,
    draw_lines,
    end_points,
    frame_perspective,
    gather_legend,
    project_perspective,
    thinned,
)
from steelnb.plots.style import style

POINTS_MAX = 60_000


@style()
def figure_flight(
    paths: Mapping[str, tuple[Trajectory, str]],
    truth: Trajectory | None,
    cloud: Array,
    segments: Segments,
    title: str,
) -> Figure:
    """Draw the cloud ``(N, 3)``, bars and paths in perspective, metres, world frame, and beside them the distance of
    the paths to the truth over time or, without a truth, to the first path.

    ``paths``: label → trajectory and colour, the recorded one first. They have a pose at every stamp of the truth.
    """
    prior = next(iter(paths.values()))[0]
    true = prior if truth is None else truth
    around = cloud if len(cloud) > 1 else prior.position[0] + np.array([[-1.0], [1.0]])
    figure = Figure(figsize=(11, 5.6))
    space, over_time = figure.subplots(1, 2, width_ratios=(1, 1.2))
    flat = project_perspective(thinned(cloud, POINTS_MAX), around)
    space.scatter(*flat.T, s=0.6, lw=0, color=COLOURS["points"], label="cloud", rasterized=True)
    draw_bars(space, end_points(segments), around, color=COLOURS["bars found"], lw=1.8, label="bars found")
    if truth is not None:
        space.plot(*project_perspective(truth.position, around).T, color=COLOURS["truth"], lw=3.2, label="truth")
    for label, (path, colour) in paths.items():
        space.plot(*project_perspective(path.position, around).T, color=colour, lw=1.3, label=label)
        if path is not true:
            distance_m = position_error_m(path.at(true.stamp_s), true)
            over_time.plot(true.stamp_s - true.stamp_s[0], distance_m, color=colour, label=label)
    frame_perspective(space, around, [path.position for path, _ in paths.values()])
    what = "to the recorded poses" if truth is None else "to the truth"
    over_time.set(xlabel="time (s)", ylabel=f"distance {what} (m)", ylim=(0, None))
    gather_legend(figure, ncols=len(paths) + 3, markerscale=8)
    figure.suptitle(title, fontsize=12)
    return figure


@style()
def figure_bars(points: Array, segments: Segments, title: str) -> Figure:
    """Draw bars over points ``(N, 3)``, metres, seen along y, along x and in perspective."""
    cloud, ends = thinned(points, POINTS_MAX), end_points(segments)
    figure = Figure(figsize=(11, 6.5))
    *sides, space = figure.subplots(1, 3)
    for panel, axis, name in zip(sides, (0, 1), ("from the front", "from the side"), strict=True):
        panel.plot(*cloud[:, [axis, 2]].T, "o", ms=1.0, mew=0, color=COLOURS["points"], rasterized=True)
        draw_lines(panel, ends[..., [axis, 2]], color=COLOURS["bars found"], lw=1.1)
        panel.set(title=name, xlabel=f"{'xy'[axis]} (m)", ylabel="z (m)")
        panel.set_aspect("equal", adjustable="datalim")
        panel.autoscale_view()
    space.plot(*project_perspective(cloud, points).T, "o", ms=1.0, mew=0, color=COLOURS["points"], rasterized=True)
    draw_bars(space, ends, points, color=COLOURS["bars found"], lw=1.1)
    frame_perspective(space, points)
    figure.suptitle(title, fontsize=12)
    return figure
