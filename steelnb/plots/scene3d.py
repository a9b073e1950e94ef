"""The plotly scene: paths, cloud and bars in 3D beside the errors over time."""

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from steelnb import plots
from steelnb.core.types import Array, Segments, Trajectory
from steelnb.metrics import position_error_m
from steelnb.plots import COLOURS
from steelnb.plots.draw import in_view

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as PlotlyFigure

HEIGHT_PX = 560
CLOUD_POINTS = 100_000
"""Maximum number of points of a kind in the scene of a cloud."""
PLOTLY_TYPE = "application/vnd.plotly.v1+json"
AXES = {f"{axis}axis": {"title": {"text": f"{axis} (m)"}, "showspikes": False} for axis in "xyz"}
WIDTHS = {"true": 3, "drifting": 4, "corrected": 8}
"""Widths of the paths. A good correction covers the true path, so one is thin and the other wide to show both."""


def figure_scene(
    paths: Mapping[str, Trajectory | None],
    cloud: Array | None = None,
    segments: Segments | None = None,
    members: Array | None = None,
    method: str = "best",
) -> "PlotlyFigure":
    """The interactive 3D scene beside the errors over time. A click in the legend hides a line.

    ``paths``: poses ``drifting``, ``corrected`` (in the colour of ``method``) and ``true``; the last two may be
    missing. Errors are distances to the true path or, without one, to the drifting one. ``cloud (N, 3)``; ``segments``:
    the bars found; ``members (M, 2, 3)``: the true ones. All in the world frame, metres.
    """
    from plotly.graph_objects import Scatter, Scatter3d
    from plotly.subplots import make_subplots

    known = {name: path for name, path in paths.items() if path is not None}
    colours = {"true": COLOURS["truth"], "drifting": COLOURS["none"], "corrected": COLOURS[method]}
    figure = make_subplots(1, 2, specs=[[{"type": "scene"}, {"type": "xy"}]], column_widths=(0.62, 0.38))
    lines = {}
    if members is not None:
        highest_m = 1 + known["drifting"].position[:, 2].max()
        shown = members[(members[..., 2] < highest_m).all(axis=1)]
        lines["true members"] = _apart(shown), COLOURS["member"], 2
    if segments is not None:
        lines["bars found"] = _apart(plots.end_points(segments)), COLOURS["bars found"], 6
    lines |= {name: (path.position, colours[name], WIDTHS[name]) for name, path in known.items()}
    for name, (points, colour, width) in lines.items():
        look = {"mode": "lines", "name": name, "legendgroup": name, "line": {"color": colour, "width": width}}
        figure.add_trace(Scatter3d(**_columns(points), **look), 1, 1)
    if cloud is not None:
        marker = {"size": 1, "color": COLOURS["points"], "opacity": 0.5}
        figure.add_trace(Scatter3d(**_columns(cloud), mode="markers", name="cloud", marker=marker), 1, 1)
    reference = known.get("true", known["drifting"])
    for name, path in known.items():
        if path is not reference:
            error_m = position_error_m(path.at(reference.stamp_s), reference)
            look = {"name": name, "legendgroup": name, "line": {"color": colours[name], "width": 2}}
            time_s = reference.stamp_s - reference.stamp_s[0]
            figure.add_trace(Scatter(x=time_s, y=error_m, showlegend=False, **look), 1, 2)
    figure.update_layout(
        template="plotly_white",
        height=HEIGHT_PX,
        margin={"l": 0, "r": 16, "t": 12, "b": 48},
        legend={"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom", "itemsizing": "constant"},
        scene={**AXES, "aspectmode": "data", "camera": {"eye": {"x": 1.0, "y": -1.9, "z": 0.6}}},
    )
    figure.update_xaxes(title_text="time (s)")
    where = "truth" if "true" in known else "recorded poses"
    beside = {"rangemode": "tozero", "side": "right"}  # on the left its title would lie over a narrow scene
    figure.update_yaxes(title_text=f"distance to the {where} (m)", **beside)
    return figure


def figure_cloud(points: Array, bars: Segments, surface: NDArray[np.bool_]) -> "PlotlyFigure":
    """An interactive scene of a cloud ``(N, 3)``, metres, its bars, and the points on surfaces ``(N,)`` in another
    colour. A click in the legend hides a kind."""
    from plotly.graph_objects import Figure as PlotlyFigure
    from plotly.graph_objects import Scatter3d

    figure, seen = PlotlyFigure(), in_view(points)
    points, surface = points[seen], surface[seen]
    for where, name, key in ((surface, "surfaces", "surface"), (~surface, "other points", "points")):
        marker = {"size": 1, "color": COLOURS[key], "opacity": 0.6}
        shown = plots.thinned(points[where], CLOUD_POINTS)
        figure.add_trace(Scatter3d(**_columns(shown), mode="markers", name=name, marker=marker))
    line = {"color": COLOURS["bars found"], "width": 6}
    figure.add_trace(Scatter3d(**_columns(_apart(plots.end_points(bars))), mode="lines", name="bars", line=line))
    figure.update_layout(template="plotly_white", scene={**AXES, "aspectmode": "data"}, margin=dict.fromkeys("lrtb", 0))
    return figure


def _columns(points: Array) -> dict[str, Any]:
    """Points ``(N, 3)`` as the arguments x, y and z. Single precision halves the page and is finer than a pixel."""
    return dict(zip("xyz", points.T.astype(np.float32), strict=True)) | {"hoverinfo": "skip"}


def _apart(bars: Array) -> Array:
    """Bars ``(M, 2, 3)`` as the points ``(3 M, 3)`` of one line that is interrupted between them."""
    return np.concatenate([bars, np.full((len(bars), 1, 3), np.nan)], axis=1).reshape(-1, 3)


def plotly_bundle(figure: "PlotlyFigure") -> dict[str, Any]:
    """MIME bundle of a figure for JupyterLab's Plotly renderer, regardless of the user's default, with a text."""
    content = json.loads(cast(str, figure.to_json()))
    return {PLOTLY_TYPE: {**content, "config": {"displaylogo": False, "responsive": True}}, "text/plain": "a scene"}
