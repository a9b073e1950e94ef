"""Drawing of towers, bars, clouds and paths in perspective."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from numpy.typing import NDArray

from steelnb.core.types import Array, Segments, Trajectory
from steelnb.metrics import position_error_m
from steelnb.plots.style import BLACK, COLOURS, KINDS, LABELS, Figure, drawable, gather_legend, style

if TYPE_CHECKING:
    from steelnb.simulation import Tower

CLOUD_POINTS = 60_000
"""Maximum number of points in a picture of a cloud."""
MOST = 0.0005, 0.9995
"""Quantiles of the coordinates between which lie those of 999 in 1000 points."""
BAR_M = 2.0
"""Length of the bar that shows the scale of a perspective."""


def draw_lines(panel: Axes, lines: Array, **look: Any) -> None:
    """Draw straight lines ``(M, 2, 2)`` into a panel; ``look`` are properties of a `LineCollection`."""
    panel.add_collection(LineCollection(list(lines), **{"capstyle": "round", **look}))


def end_points(segments: Segments) -> Array:
    """Both ends of each segment ``(M, 2, 3)``."""
    return np.stack([segments.start, segments.end], axis=1)


def thinned(points: Array, count: int) -> Array:
    """At most ``count`` of the points ``(N, 3)``, evenly spaced in their order."""
    return points[np.linspace(0, len(points) - 1, min(len(points), count)).astype(int)]


def in_view(points: Array) -> NDArray[np.bool_]:
    """Which of the points ``(N, 3)`` a picture shows: those within the range of 999 in 1000, widened by its size. A
    single stray point would make all others a dot."""
    if not len(points):
        return np.zeros(0, dtype=bool)
    low, high = np.quantile(points, MOST, axis=0)
    size = (high - low).max()
    return np.asarray(((points >= low - size) & (points <= high + size)).all(axis=1))


def project_perspective(points: Array, cloud: Array, elevation_deg: float = 10.0) -> Array:
    """Project points ``(…, 3)`` to ``(…, 2)``, metres, by a pinhole camera to the front right of the middle of
    ``cloud``, ``elevation_deg`` above it and 2.2 diagonals away. The middle is drawn to scale. Points at one place are
    seen as if they were as far apart as the scale bar is long.

    Matplotlib's 3D axes are not used, since they draw into a square and hide bars behind points.
    """
    azimuth, elevation = np.radians([-55.0, elevation_deg])
    to_camera = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    away = points - (cloud.min(axis=0) + cloud.max(axis=0)) / 2
    distance = 2.2 * (float(np.linalg.norm(np.ptp(cloud, axis=0))) or BAR_M)
    flat = away @ np.stack([right, np.cross(to_camera, right)], axis=1)
    return np.asarray(flat * (distance / (distance - away @ to_camera))[..., None])


def draw_bars(panel: Axes, bars: Array, cloud: Array, elevation_deg: float = 10.0, **look: Any) -> None:
    """Draw bars ``(M, 2, 3)`` into a panel as `project_perspective` shows them."""
    draw_lines(panel, project_perspective(bars, cloud, elevation_deg), **look)


def draw_judged_bars(
    panel: Axes, members: Array, bars: Array, right: NDArray[np.bool_], joints: Array | None = None
) -> None:
    """Draw the bars found ``(B, 2, 3)``, coloured by whether they are ``right (B,)``, over the true members ``(M, 2,
    3)`` as `project_perspective` shows them, and joints ``(J, 3)`` as dots."""
    cloud = members.reshape(-1, 3)
    draw_bars(panel, members, cloud, color=COLOURS["member"], lw=0.8, label="true member")
    draw_bars(panel, bars[~right], cloud, color=COLOURS["wrong"], lw=1.3, label="bar on no member")
    draw_bars(panel, bars[right], cloud, color=COLOURS["right"], lw=1.5, label="bar on a member")
    if joints is not None:
        x, y = project_perspective(joints, cloud).T
        panel.plot(x, y, "o", color=BLACK, ms=2.4, label="joint")
    frame_perspective(panel, cloud, [bars.reshape(-1, 3)])


def draw_paths(panel: Axes, paths: Mapping[str, Array], cloud: Array, elevation_deg: float = 10.0) -> None:
    """Draw ``paths``, name of the colour → positions ``(N, 3)``, as `project_perspective` shows them, and frame them
    (`frame_perspective`). The truth is a wide line."""
    for name, positions in paths.items():
        x, y = project_perspective(positions, cloud, elevation_deg).T
        label = LABELS.get(name, f"{name} flight")
        panel.plot(x, y, color=COLOURS[name], lw=3.2 if name == "truth" else 1.3, label=label)
    frame_perspective(panel, cloud, list(paths.values()), elevation_deg)


def draw_flight(panel: Axes, members: Array, paths: Mapping[str, Array]) -> None:
    """Draw ``paths``, name of the colour → positions ``(N, 3)``, and the members ``(M, 2, 3)`` of a tower, as
    `project_perspective` shows them."""
    draw_bars(panel, members, members.reshape(-1, 3), color=COLOURS["member"], lw=0.5)
    draw_paths(panel, paths, members.reshape(-1, 3))


def frame_perspective(panel: Axes, cloud: Array, more: Sequence[Array] = (), elevation_deg: float = 10.0) -> None:
    """Set the limits of a panel to the projection (`project_perspective`) of ``cloud (N, 3)`` and ``more``, and draw a
    scale bar instead of axes."""
    flat = project_perspective(np.concatenate([cloud, *more]), cloud, elevation_deg)
    (left, low), (right, high) = flat.min(axis=0), flat.max(axis=0)
    panel.set(xlim=(left - 0.3, right + 0.3), ylim=(low - 0.9, high + 0.2), aspect="equal")
    panel.set_axis_off()
    panel.plot([left, left + BAR_M], [low - 0.4] * 2, color=BLACK, linewidth=2.5)
    panel.annotate(f"{BAR_M:g} m", (left + BAR_M / 2, low - 0.5), ha="center", va="top", fontsize=10)


@style()
def figure_clouds(clouds: Mapping[str, tuple[Array, Array]]) -> Figure:
    """Draw the cloud that each method built, in its colour, over the true one, seen along y and along x.

    ``clouds``: method → built and true points ``(N, 3)``, metres. Black stays visible where no built point covers it.
    """
    everything = np.concatenate([cloud for pair in clouds.values() for cloud in pair])
    everything = everything if len(everything) else np.zeros((1, 3))
    low, high = np.quantile(everything, MOST, axis=0) + np.array([[-0.4], [0.4]])
    wide, tall = (high - low)[:2], (high - low)[2]
    scale = min(6.0 / tall, 3.2 / wide.sum())  # inches per metre
    figure = Figure(figsize=(len(clouds) * (wide.sum() * scale + 0.3) + 0.9, tall * scale + 1.75), layout="compressed")
    panels = figure.subplots(1, 2 * len(clouds), sharey=True, width_ratios=[*wide] * len(clouds))
    for k, (method, (built, true)) in enumerate(clouds.items()):
        for across, panel in enumerate(panels[2 * k : 2 * k + 2]):
            for points, name in ((true, "truth"), (built, method)):
                x, _, z = thinned(points[:, [across, across, 2]], CLOUD_POINTS // 2).T
                panel.scatter(x, z, s=0.7, color=COLOURS[name], lw=0, rasterized=True)
            panel.set(aspect="equal", xlabel=f"{'xy'[across]} (m)", ylabel="" if across or k else "z (m)")
            panel.set(xlim=(low[across], high[across]), ylim=(low[2], high[2]))
        panels[2 * k].set_title(LABELS[method] + ("" if len(built) else ": no points"), loc="left")
        panels[0].plot([], [], "o", color=COLOURS[method], label=LABELS[method])
    panels[0].plot([], [], "o", color=COLOURS["truth"], label="at the true poses")
    gather_legend(figure, ncols=5)
    return figure


def draw_tower(panels: Sequence[Axes], tower: "Tower", paths: Mapping[str, Array], elevation_deg: float = 25.0) -> None:
    """Draw a tower into three panels, its members coloured by kind: in perspective from above the front right, with its
    plates and ``paths`` (name of the colour → positions ``(N, 3)``); from the front; and from the side."""
    scene, *sides = panels
    flat = project_perspective(tower.plates, tower.vertices, elevation_deg)
    scene.add_collection(PolyCollection(list(flat), fc=COLOURS["member"], alpha=0.6))
    kinds = np.array([member.kind for member in tower.members])
    for kind in (name for name in reversed(KINDS) if name in kinds):
        bars = tower.axes[kinds == kind]
        look = {"color": KINDS[kind], "lw": {"leg": 2.2, "secondary": 0.8}.get(kind, 1.2)}
        draw_bars(scene, bars, tower.vertices, elevation_deg, **look)
        for across, side in enumerate(sides):
            draw_lines(side, bars[:, :, [across, 2]], label=f"{kind} ({len(bars)})", **look)
    draw_paths(scene, paths, tower.vertices, elevation_deg)
    for side, name, axis in zip(sides, ("front", "side"), "xy", strict=True):
        side.set(aspect="equal", title=name, xlabel=f"{axis} (m)", ylabel="z (m)")
        side.autoscale()


MARGIN_M = 1.0
VIEWS = (0, 2, 1), (1, 2, 0), (0, 1, 2)
"""Axes to the right, up, and towards the viewer, of each view."""
VIEW_NAMES = "from the front", "from the side", "from above"


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
    flat = project_perspective(thinned(cloud, CLOUD_POINTS), around)
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


@style()
def figure_bars(
    points: Array,
    segments: Segments,
    title: str,
    surface: NDArray[np.bool_] | None = None,
    sure: NDArray[np.bool_] | None = None,
) -> Figure:
    """Draw bars over points ``(N, 3)``, metres: from the front, from the side, from above and in perspective.

    ``surface (N,)``: whether a point lies on a surface; they have another colour. ``sure (M,)``: whether each bar
    is sure; others are thin. A bar behind another one is drawn first.
    """
    surface, seen = np.zeros(len(points), dtype=bool) if surface is None else surface, in_view(points)
    points, surface = points[seen], surface[seen]
    kept = [thinned(points[where], CLOUD_POINTS // 2) for where in (surface, ~surface)]
    kinds = [(cloud, name) for cloud, name in zip(kept, ("surface", "points"), strict=True) if len(cloud)]
    ends, cloud = end_points(segments), points[~surface] if len(segments) else points
    width = np.where(np.ones(len(segments), dtype=bool) if sure is None else sure, 1.3, 0.4)
    figure = Figure(figsize=(13, 6.5))
    *views, space = figure.subplots(1, 4, width_ratios=(1, 1, 1, 1.1))
    for panel, (right, up, depth), name in zip(views, VIEWS, VIEW_NAMES, strict=True):
        for some, kind in kinds:
            panel.plot(*some[:, [right, up]].T, "o", ms=0.8, mew=0, color=COLOURS[kind], rasterized=True)
        order = np.argsort(ends[:, :, depth].mean(axis=1) * (1 if depth != 1 else -1), kind="stable")
        draw_lines(panel, ends[order][..., [right, up]], color=COLOURS["bars found"], lw=width[order])
        panel.set(title=name, xlabel=f"{'xyz'[right]} (m)", ylabel=f"{'xyz'[up]} (m)")
        panel.set_aspect("equal", adjustable="datalim")
        if len(segments):  # ground may reach much farther
            (low, left), (high, end) = ends[..., [up, right]].min(axis=(0, 1)), ends[..., [up, right]].max(axis=(0, 1))
            panel.set_xlim(left - MARGIN_M, end + MARGIN_M, auto=True)  # else one of the limits would be fixed
            panel.set_ylim(low - MARGIN_M, high + MARGIN_M, auto=True)
    shown = thinned(cloud, CLOUD_POINTS // 2)
    space.plot(*project_perspective(shown, cloud).T, "o", ms=0.8, mew=0, color=COLOURS["points"], rasterized=True)
    draw_bars(space, ends, cloud, color=COLOURS["bars found"], lw=width)
    frame_perspective(space, cloud)
    figure.suptitle(drawable(title), fontsize=12, parse_math=False)
    return figure
