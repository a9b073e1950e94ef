"""Front, side and perspective of bars: the pictures of `steelnb segment` and `steelnb run`."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from steelnb.plots import (
    COLOURS,
    Figure,
    draw_legend,
    draw_lines,
    end_points,
    project_perspective,
    style,
    thinned,
)
from steelnb.types import Array, Segments

GROUPS = {"near_vertical": COLOURS["leg"], "inclined": COLOURS["bracing"], "near_horizontal": COLOURS["ring"]}
POINTS_MAX = 60_000
Layer = tuple[str, dict[str, Any], Array]
VERTICAL_DEG, HORIZONTAL_DEG = 20.0, 10.0
"""Near vertical is up to 20° from the vertical, since legs lean; near horizontal up to 10° from the horizontal."""


def orientation(segments: Segments) -> list[str]:
    """Class of each segment out of `GROUPS`, from its direction alone."""
    names = list(GROUPS)
    lean = np.degrees(np.arccos(np.clip(np.abs(segments.direction[:, 2]), 0, 1)))
    return [names[0] if angle <= VERTICAL_DEG else names[1 + (angle >= 90 - HORIZONTAL_DEG)] for angle in lean]


@style()
def figure_segments(points: Array, segments: Segments, groups: Sequence[str], title: str) -> Figure:
    """Points ``(N, 3)`` in grey, segments coloured by their class of orientation."""
    return figure_layers(layers_by_group(segments, groups), title, thinned(points, POINTS_MAX))


def layers_by_group(segments: Segments, groups: Sequence[str]) -> list[Layer]:
    """Segments in a layer for each of `GROUPS`, of which ``groups`` names one for each segment."""
    ends, of = end_points(segments), np.array(groups)
    return [
        (f"{name.replace('_', ' ')} ({np.count_nonzero(of == name)})", {"color": colour, "lw": 1.1}, ends[of == name])
        for name, colour in GROUPS.items()
    ]


def figure_layers(layers: Sequence[Layer], title: str, cloud: Array | None = None) -> Figure:
    """Bars from the front, from the side and in perspective at one scale, one layer over the other, above points
    ``(N, 3)`` in grey: the label of each layer, its look, and its bars ``(M, 2, 3)``.

    The front is the widest view: the structure is turned about z until the box around it is smallest, its wider side
    first. Lengths are metres from the middle of that box and from the lowest point. Towers stand side by side, long
    structures lie below each other.
    """
    cloud = np.zeros((0, 3)) if cloud is None else cloud
    everything = np.concatenate([cloud, *(shapes.reshape(-1, 3) for _, _, shapes in layers)])
    turn = upright_box(cloud if len(cloud) else everything)
    turned = everything @ turn.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    shift = np.array([*(low + high)[:2] / 2, low[2]])
    columns = {"front": [0, 2], "side": [1, 2]}

    def project(world: Array, name: str) -> Array:
        near = world @ turn.T - shift
        return near[..., columns[name]] if name in columns else project_perspective(near, turned - shift)

    flat = {name: project(everything, name) for name in (*columns, "perspective")}
    sizes = np.array([1.06 * np.ptp(points, axis=0) for points in flat.values()])
    sizes = np.maximum(sizes, max(0.1 * sizes.max(), 1e-3))  # a flat cloud still needs space for its axes
    if sizes[0, 0] <= 1.5 * sizes[0, 1]:
        extent = np.array([sizes[:, 0].sum(), sizes[:, 1].max()])
        shape: dict[str, Any] = {"ncols": 3, "width_ratios": sizes[:, 0].tolist()}
    else:
        extent = np.array([sizes[:, 0].max(), sizes[:, 1].sum()])
        shape = {"nrows": 3, "height_ratios": sizes[:, 1].tolist()}
    width, height = extent * min(9.0 / extent[0], 9.0 / extent[1]) + (2.0, 2.6)
    figure = Figure(figsize=(max(width, 6.0), height))
    for panel, name, size in zip(figure.subplots(**shape), flat, sizes, strict=True):
        panel.plot(*project(cloud, name).T, "o", ms=1.0, mew=0, color=COLOURS["points"], rasterized=True)
        for _, look, shapes in layers:
            drawn = project(shapes, name)
            draw_lines(panel, drawn, colors=look["color"], linewidths=look["lw"], linestyles=look.get("ls", "-"))
        middle = (flat[name].min(axis=0) + flat[name].max(axis=0)) / 2
        (left, right), (bottom, top) = np.stack([middle - size / 2, middle + size / 2], axis=1)
        panel.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", title=name, xlabel="(m)", ylabel="height (m)")
    panel.set_axis_off()
    keys: dict[str, Any] = {label: look for label, look, _ in layers if label}
    if len(cloud):
        keys["points"] = {"color": COLOURS["points"], "marker": "o", "ls": "", "ms": 3}
    draw_legend(figure, keys, ncols=3 if width > 9 else 2)
    figure.suptitle(title, fontsize=12)
    return figure


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
