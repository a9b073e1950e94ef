"""The pictures of a flight and of the bars in a cloud."""

from collections.abc import Mapping

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from steelnb.core.arguments import checks_arguments
from steelnb.core.types import Array, Segments, Trajectory
from steelnb.metrics import position_error_m
from steelnb.plots import COLOURS, Figure, draw_bars, draw_lines, end_points, gather_legend, thinned
from steelnb.plots.draw import frame_perspective, in_view, project_perspective
from steelnb.plots.style import drawable, style

POINTS_MAX, MARGIN_M = 60_000, 1.0
VIEWS = (0, 2, 1), (1, 2, 0), (0, 1, 2)
"""Axes to the right, up, and towards the viewer, of each view."""
VIEW_NAMES = "from the front", "from the side", "from above"


@checks_arguments
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
    true, cloud = prior if truth is None else truth, cloud[in_view(cloud)]
    around = cloud if len(cloud) > 1 else prior.position[0] + np.array([[-1.0], [1.0]])
    figure = Figure(figsize=(11, 5.6))
    space, over_time = figure.subplots(1, 2, width_ratios=(1, 1.2))
    flat = project_perspective(thinned(cloud, POINTS_MAX), around)
    space.scatter(*flat.T, s=0.6, lw=0, color=COLOURS["points"], label="cloud", rasterized=True)
    draw_bars(space, end_points(segments), around, color=COLOURS["bars found"], lw=1.8, label="bars found")
    if truth is not None:
        space.plot(*project_perspective(truth.position, around).T, color=COLOURS["truth"], lw=3.2, label="truth")
    for label, (path, colour) in paths.items():
        space.plot(*project_perspective(path.position, around).T, color=colour, lw=1.3, label=drawable(label))
        if path is not true:
            distance_m = position_error_m(path.at(true.stamp_s), true)
            over_time.plot(true.stamp_s - true.stamp_s[0], distance_m, color=colour, label=drawable(label))
    frame_perspective(space, around, [path.position for path, _ in paths.values()])
    what = "to the recorded poses" if truth is None else "to the truth"
    over_time.set(xlabel="time (s)", ylabel=f"distance {what} (m)", ylim=(0, None))
    gather_legend(figure, ncols=len(paths) + 3, markerscale=8)
    for text in figure.legends[-1].get_texts():
        text.set_parse_math(False)
    figure.suptitle(drawable(title), fontsize=12, parse_math=False)
    return figure


@checks_arguments
@style()
def figure_bars(
    points: Array, segments: Segments, title: str, surface: NDArray[np.bool_] | None = None, sure: Array | None = None
) -> Figure:
    """Draw bars over points ``(N, 3)``, metres: from the front, from the side, from above and in perspective.

    ``surface (N,)``: whether a point lies on a surface; they have another colour. ``sure (M,)``: how sure each bar
    is, 0 to 1; unsure ones are pale. A bar behind another one is drawn first.
    """
    surface, seen = np.zeros(len(points), dtype=bool) if surface is None else surface, in_view(points)
    points, surface = points[seen], surface[seen]
    kept = [thinned(points[where], POINTS_MAX // 2) for where in (surface, ~surface)]
    kinds = [(cloud, name) for cloud, name in zip(kept, ("surface", "points"), strict=True) if len(cloud)]
    ends, cloud = end_points(segments), points[~surface] if len(segments) else points
    alpha = np.full(len(segments), 1.0) if sure is None else np.clip(sure, 0.25, 1.0)
    figure = Figure(figsize=(13, 6.5))
    *views, space = figure.subplots(1, 4, width_ratios=(1, 1, 1, 1.1))
    for panel, (right, up, depth), name in zip(views, VIEWS, VIEW_NAMES, strict=True):
        for some, kind in kinds:
            panel.plot(*some[:, [right, up]].T, "o", ms=0.8, mew=0, color=COLOURS[kind], rasterized=True)
        order = np.argsort(ends[:, :, depth].mean(axis=1) * (1 if depth != 1 else -1), kind="stable")
        colours = [(*to_rgb(COLOURS["bars found"]), float(a)) for a in alpha[order]]
        draw_lines(panel, ends[order][..., [right, up]], color=colours or None, lw=1.3)
        panel.set(title=name, xlabel=f"{'xyz'[right]} (m)", ylabel=f"{'xyz'[up]} (m)")
        panel.set_aspect("equal", adjustable="datalim")
        if len(segments):  # ground may reach much farther
            (low, left), (high, end) = ends[..., [up, right]].min(axis=(0, 1)), ends[..., [up, right]].max(axis=(0, 1))
            panel.set_xlim(left - MARGIN_M, end + MARGIN_M, auto=True)  # else one of the limits would be fixed
            panel.set_ylim(low - MARGIN_M, high + MARGIN_M, auto=True)
    shown = thinned(cloud, POINTS_MAX // 2)
    space.plot(*project_perspective(shown, cloud).T, "o", ms=0.8, mew=0, color=COLOURS["points"], rasterized=True)
    draw_bars(space, ends, cloud, color=COLOURS["bars found"], lw=1.2)
    frame_perspective(space, cloud)
    figure.suptitle(drawable(title), fontsize=12, parse_math=False)
    return figure
