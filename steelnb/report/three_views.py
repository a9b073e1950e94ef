"""Front, side and perspective of bars: the pictures of `steelnb segment`, `steelnb run` and `steelnb structure A B`."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from steelnb.fusion.differences import Comparison
from steelnb.fusion.structure import Structure
from steelnb.report.style import (
    COLOURS,
    LIGHT_GREY,
    PINK,
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
CHANGES = {"same": LIGHT_GREY, "missing": COLOURS["wrong"], "extra": COLOURS["right"], "moved": PINK}
POINTS_MAX = 60_000


@style()
def figure_segments(points: Array, segments: Segments, groups: Sequence[str], title: str) -> Figure:
    """Points ``(N, 3)`` in grey, segments coloured by their class of orientation, in the views of `three_views`."""
    turn, ends = upright_box(points), end_points(segments)
    points = thinned(points, POINTS_MAX)
    figure, panels, project = three_views(np.concatenate([points, ends.reshape(-1, 3)]), turn)
    colours = [GROUPS[group] for group in groups]
    for name, panel in panels.items():
        x, y = project(points, name).T
        panel.scatter(x, y, s=1.0, c=COLOURS["points"], linewidths=0, rasterized=True)
        draw_lines(panel, project(ends, name), colors=colours, linewidths=1.1, alpha=0.9)
    keys: dict[str, dict[str, Any]] = {
        f"{name.replace('_', ' ')} ({sum(other == name for other in groups)})": {"color": colour, "lw": 2}
        for name, colour in GROUPS.items()
    }
    keys["points"] = {"color": COLOURS["points"], "marker": "o", "ls": "", "ms": 3}
    draw_legend(figure, keys, ncols=4 if figure.get_figwidth() > 9 else 2)
    figure.suptitle(title, fontsize=12)
    return figure


@style()
def figure_comparison(a: Structure, b: Structure, found: Comparison, title: str) -> Figure:
    """Both structures, with the missing, extra and moved parts in colour, in the views of `three_views`.

    Bars are lines, joints rings; of bars that have moved, the place in ``a`` is dashed.
    """
    ends = [end_points(structure.segments).reshape(-1, 3) for structure in (a, b)]
    both = np.concatenate([*ends, a.joint, b.joint])
    figure, panels, project = three_views(both, upright_box(both))
    moved, moved_joint = found.bar_moved, found.joint_moved | found.joint_retied
    # Nothing that has changed may lie below what has not.
    layers = [
        ("same", "-", b, found.bar[~moved, 1], found.joint[~moved_joint, 1]),
        ("moved", "--", a, found.bar[moved, 0], found.joint[[]][:, 0]),
        ("moved", "-", b, found.bar[moved, 1], found.joint[moved_joint, 1]),
        ("missing", "-", a, found.bar_missing, found.joint_missing),
        ("extra", "-", b, found.bar_extra, found.joint_extra),
    ]
    for name, panel in panels.items():
        for kind, dash, structure, bars, joints in layers:
            width = 1.0 if kind == "same" else 2.2 if dash == "-" else 1.2
            flat = project(end_points(structure.segments)[bars], name)
            draw_lines(panel, flat, colors=CHANGES[kind], linewidths=width, linestyles=dash)
            if kind != "same":
                at = project(structure.joint[joints], name)
                panel.plot(at[:, 0], at[:, 1], "o", mfc="none", mec=CHANGES[kind], mew=1.3, ms=7)
    counts = {kind: (len(bars), len(joints)) for kind, dash, _, bars, joints in layers if dash == "-"}
    keys = {
        f"{kind}: {counts[kind][0]} bars, {counts[kind][1]} joints": {"color": colour, "lw": 2.5}
        for kind, colour in CHANGES.items()
    }
    figure.set_figheight(figure.get_figheight() + 0.5)  # a legend of two rows
    draw_legend(figure, keys, ncols=4 if figure.get_figwidth() > 11 else 2)
    figure.suptitle(title, fontsize=12)
    return figure


def three_views(points: Array, turn: Array) -> tuple[Figure, dict[str, Axes], Callable[[Array, str], Array]]:
    """A figure with a panel for each view of ``points (N, 3)`` at one scale, and the projection into a view by name.

    The front is the widest view: the structure is turned about z until the box around it is smallest, its wider side
    first. Lengths are metres from the middle of that box and from the lowest point. Towers stand side by side, long
    structures lie below each other.
    """
    turned = points @ turn.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    shift = np.array([*(low + high)[:2] / 2, low[2]])
    columns = {"front": [0, 2], "side": [1, 2]}

    def project(world: Array, name: str) -> Array:
        near = world @ turn.T - shift
        if name in columns:
            return near[..., columns[name]]
        return project_perspective(near, turned - shift)

    names = [*columns, "perspective"]
    extents = {name: (project(points, name).min(axis=0), project(points, name).max(axis=0)) for name in names}
    sizes = np.array([1.06 * (high - low) for low, high in extents.values()])
    sizes = np.maximum(sizes, max(0.1 * sizes.max(), 1e-3))  # a flat cloud still needs space for its axes
    beside = sizes[0, 0] <= 1.5 * sizes[0, 1]
    inches = min(7.0 / sizes[:, 1].max(), 8.0 / sizes[:, 0].sum()) if beside else 9.0 / sizes[:, 0].max()
    if beside:
        size = np.array([sizes[:, 0].sum(), sizes[:, 1].max()]) * inches + (2.4, 2.2)
        shape: dict[str, Any] = {"nrows": 1, "ncols": 3, "width_ratios": sizes[:, 0].tolist()}
    else:
        size = np.array([sizes[:, 0].max(), sizes[:, 1].sum()]) * inches + (1.4, 3.4)
        shape = {"nrows": 3, "ncols": 1, "height_ratios": sizes[:, 1].tolist()}
    figure = Figure(figsize=(max(size[0], 6.0), size[1]))
    panels = dict(zip(names, figure.subplots(**shape), strict=True))
    for (name, panel), extent in zip(panels.items(), sizes, strict=True):
        low, high = (sum(extents[name]) + sign * extent for sign in (-1, 1))
        panel.set(xlim=(low[0] / 2, high[0] / 2), ylim=(low[1] / 2, high[1] / 2), aspect="equal", title=name)
        for axis in (panel.xaxis, panel.yaxis):
            ticks = max(1, int(1.5 * inches * np.ptp(axis.get_view_interval())))  # three for every two inches
            axis.set_major_locator(MaxNLocator(min(ticks, 10), steps=[1, 2, 5, 10]))
        panel.set_xlabel("across (m)" if name == "front" else "along (m)")
        if name == "front" or not beside:
            panel.set_ylabel("height (m)")
    panels["perspective"].set_axis_off()
    return figure, panels, project


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
