"""The picture of `steelnb segment`: points and segments from the front, from the side and in perspective."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from steelnb.datatypes import Array, Segments
from steelnb.figures.style import Figure, style

# Okabe and Ito's palette (2008).
COLOURS = {"near_vertical": "#0072B2", "inclined": "#D55E00", "near_horizontal": "#009E73"}
POINT_COLOUR = "#bdbdbd"
MAX_POINTS = 60_000
AZIMUTH_DEG, ELEVATION_DEG, DISTANCE = -55.0, 10.0, 2.2
"""Of the camera; its distance to the middle is in diagonals of the cloud."""


def figure_segments(points: Array, segments: Segments, groups: Sequence[str], title: str) -> Figure:
    """Three panels at one scale: points ``(N, 3)`` in grey, segments coloured by their class of orientation.

    The front is the widest view: the structure is turned about z until the box around it is smallest, its wider side
    first. Lengths are metres from the middle of that box and from the lowest point.
    """
    turn = upright_box(points)
    points = points[np.linspace(0, len(points) - 1, min(len(points), MAX_POINTS)).astype(int)] @ turn.T
    low, high = points.min(axis=0), points.max(axis=0)
    shift = np.array([*(low + high)[:2] / 2, low[2]])
    bars = np.stack([segments.start, segments.end], axis=1) @ turn.T - shift
    points = points - shift
    views = {
        "front": (points[:, [0, 2]], bars[..., [0, 2]]),
        "side": (points[:, [1, 2]], bars[..., [1, 2]]),
        "perspective": (seen(points, points), seen(bars.reshape(-1, 3), points).reshape(-1, 2, 2)),
    }
    # One scale for all panels. Towers stand side by side, long structures lie below each other.
    sizes = np.array([np.ptp(flat, axis=0) * 1.06 for flat, _ in views.values()])
    sizes = np.maximum(sizes, 0.1 * sizes.max())  # a flat cloud still needs room for its axes
    beside = sizes[0, 0] <= 1.5 * sizes[0, 1]
    inches = min(7.0 / sizes[:, 1].max(), 8.0 / sizes[:, 0].sum()) if beside else 9.0 / sizes[:, 0].max()
    along, across = (0, 1) if beside else (1, 0)
    extent = np.array([0.0, 0.0])
    extent[along], extent[across] = sizes[:, along].sum(), sizes[:, across].max()
    with style():
        size = extent * inches + ([2.4, 2.2] if beside else [1.4, 3.4])
        figure = Figure(figsize=(max(size[0], 6.0), size[1]))
        ratios = list(sizes[:, along])
        grid = (
            figure.add_gridspec(1, 3, width_ratios=ratios)
            if beside
            else figure.add_gridspec(3, 1, height_ratios=ratios)
        )
        colours = [COLOURS[group] for group in groups]
        for k, (name, (flat, lines)) in enumerate(views.items()):
            panel = figure.add_subplot(grid[k])
            _draw(panel, flat, lines, colours, sizes[k], inches)
            panel.set_title(name)
            if name == "perspective":
                panel.set_axis_off()
                continue
            panel.set_xlabel("across (m)" if name == "front" else "along (m)")
            if k == 0 or not beside:
                panel.set_ylabel("height (m)")
        keys = [Line2D([], [], color=colour, lw=2) for colour in COLOURS.values()]
        labels = [f"{name.replace('_', ' ')} ({sum(other == name for other in groups)})" for name in COLOURS]
        keys.append(Line2D([], [], color=POINT_COLOUR, marker="o", ls="", ms=3))
        figure.legend(keys, [*labels, "points"], loc="outside lower center", ncols=4 if size[0] > 9 else 2)
        figure.suptitle(title, fontsize=12)
    return figure


def _draw(panel: Axes, points: Array, bars: Array, colours: list[str], size: Array, inches: float) -> None:
    panel.scatter(points[:, 0], points[:, 1], s=1.0, c=POINT_COLOUR, linewidths=0, rasterized=True)
    panel.add_collection(LineCollection(list(bars), colors=colours, linewidths=1.1, capstyle="round", alpha=0.9))
    low, high = [(points.min(axis=0) + points.max(axis=0) + sign * size) / 2 for sign in (-1, 1)]
    panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    for axis in (panel.xaxis, panel.yaxis):
        ticks = max(1, int(1.5 * inches * np.ptp(axis.get_view_interval())))  # three for every two inches
        axis.set_major_locator(MaxNLocator(min(ticks, 10), steps=[1, 2, 5, 10]))


def seen(points: Array, cloud: Array) -> Array:
    """Points ``(N, 3)`` → ``(N, 2)`` metres as a pinhole camera sees them, to scale in the middle of the cloud.

    Not matplotlib's 3D axes, which draw into a square and hide bars behind points.
    """
    azimuth, elevation = np.radians([AZIMUTH_DEG, ELEVATION_DEG])
    to_camera = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    away = points - (cloud.min(axis=0) + cloud.max(axis=0)) / 2
    distance = DISTANCE * np.linalg.norm(np.ptp(cloud, axis=0))
    flat = away @ np.stack([right, np.cross(to_camera, right)], axis=1)
    return np.asarray(flat * (distance / (distance - away @ to_camera))[:, None])


def upright_box(points: Array) -> Array:
    """Rotation ``(3, 3)`` about z after which the upright box around the points is smallest and widest along x."""
    flat = points[:: max(1, len(points) // 20_000), :2]
    best = (np.inf, np.eye(3))
    for angle in np.radians(np.arange(0, 180, 1.0)):
        c, s = np.cos(angle), np.sin(angle)
        # Quantiles, since a single stray point would tilt the box.
        wide, deep = np.subtract(*np.quantile(flat @ np.array([[c, s], [-s, c]]), (0.99, 0.01), axis=0))
        if wide >= deep and wide * deep < best[0]:
            best = (float(wide * deep), np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]))
    return best[1]
