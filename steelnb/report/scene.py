"""A flight to turn around with the mouse: cloud, bars and trajectories, above the curve of the error."""

import json
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from steelnb.metrics import position_error_m
from steelnb.report.style import COLOURS, end_points
from steelnb.types import Array, Segments, Trajectory

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as PlotlyFigure

HEIGHT_PX = 860
PLOTLY_TYPE = "application/vnd.plotly.v1+json"
CLOUD, MEMBERS = "#8a94a6", "#c4c4c4"
TRACKS = {"true": COLOURS["truth"], "drifting": COLOURS["drifting"], "corrected": COLOURS["corrected"]}
WIDTHS = {"true": 3, "drifting": 4, "corrected": 8}
"""The corrected trajectory lies on the true one where all is well: one thin, one wide shows both."""
CAMERA = {"eye": {"x": 0.8, "y": -1.5, "z": 0.5}, "projection": {"type": "orthographic"}}


def figure_scene(
    prior: Trajectory,
    corrected: Trajectory,
    truth: Trajectory | None,
    cloud: Array,
    segments: Segments,
    members: Array | None = None,
) -> "PlotlyFigure":
    """The scene above the error curve, interactive; what the legend names can be switched off by a click on it.

    ``cloud (N, 3)`` are the scans at the corrected poses, ``segments`` the bars found in them, ``members``
    ``(M, 2, 3)`` the true ones, all in the world frame; errors are those at the stamps of ``truth``.
    """
    from plotly.graph_objects import Scatter, Scatter3d
    from plotly.subplots import make_subplots

    tracks, errors = tracks_and_errors(prior, corrected, truth)
    low, high = corners(cloud, tracks)
    rows = {"rows": 2, "row_heights": (0.7, 0.3), "specs": [[{"type": "scene"}], [{"type": "xy"}]]}
    if not errors:
        rows = {"rows": 1, "specs": [[{"type": "scene"}]]}
    figure = make_subplots(cols=1, vertical_spacing=0.06, **rows)
    if members is not None:
        low[2] = 0.0
        known = members[(members[:, :, 2] <= high[2]).all(axis=1)]
        line = {"color": MEMBERS, "width": 2}
        figure.add_trace(Scatter3d(**_lines(known), name="true members", line=line), row=1, col=1)
    marker = {"size": 1, "color": CLOUD, "opacity": 0.5}
    points = Scatter3d(**_columns(cloud), mode="markers", name="cloud", marker=marker)
    line = {"color": COLOURS["least_squares"], "width": 6}
    found = Scatter3d(**_lines(end_points(segments)), name="bars found", line=line)
    figure.add_traces([points, found], rows=1, cols=1)
    for name, positions in tracks.items():
        line = {"color": TRACKS[name], "width": WIDTHS[name]}
        path = Scatter3d(**_columns(positions), mode="lines", name=name, legendgroup=name, line=line)
        figure.add_trace(path, row=1, col=1)
    for name, (time_s, error) in errors.items():
        line = {"color": TRACKS[name], "width": 2}
        curve = Scatter(x=time_s, y=error, name=name, legendgroup=name, showlegend=False, line=line)
        figure.add_trace(curve, row=2, col=1)
    axes = {
        f"{name}axis": {"title": {"text": f"{name} (m)"}, "range": [low[k], high[k]], "backgroundcolor": "white",
                        "gridcolor": "#e4e4e4", "dtick": 2, "showspikes": False}
        for k, name in enumerate("xyz")
    }  # fmt: skip
    # Without perspective, the size of the box in the page goes by its aspect ratio.
    ratio = dict(zip("xyz", 1.6 * (high - low) / np.linalg.norm(high - low) * np.sqrt(2), strict=True))
    figure.update_layout(
        template="plotly_white",
        height=HEIGHT_PX,
        margin={"l": 56, "r": 16, "t": 12, "b": 48},
        legend={"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom", "itemsizing": "constant"},
        scene={**axes, "aspectmode": "manual", "aspectratio": ratio, "camera": CAMERA},
        hovermode="closest",
    )
    figure.update_xaxes(title_text="time (s)")
    figure.update_yaxes(title_text="distance to the truth (m)", rangemode="tozero")
    return figure


def plotly_bundle(figure: "PlotlyFigure", text: str) -> dict[str, Any]:
    """A figure as JupyterLab's renderer of Plotly takes it, whatever renderer the user's settings name; and as text."""
    content = json.loads(cast(str, figure.to_json()))
    return {PLOTLY_TYPE: {**content, "config": {"displaylogo": False, "responsive": True}}, "text/plain": text}


def tracks_and_errors(
    prior: Trajectory, corrected: Trajectory, truth: Trajectory | None
) -> tuple[dict[str, Array], dict[str, tuple[Array, Array]]]:
    """Positions ``(N, 3)`` of each trajectory, and where there is truth the times ``(N,)`` and errors ``(N,)`` of both
    others."""
    tracks = {"drifting": prior.position, "corrected": corrected.position}
    if truth is None:
        return tracks, {}
    time_s, paths = truth.stamp_s - truth.stamp_s[0], {"drifting": prior, "corrected": corrected}
    errors = {name: (time_s, position_error_m(path.at(truth.stamp_s), truth)) for name, path in paths.items()}
    return {"true": truth.position, **tracks}, errors


def corners(cloud: Array, tracks: dict[str, Array]) -> tuple[Array, Array]:
    """Lowest and highest corner ``(3,)`` around a cloud and trajectories, in whole metres."""
    points = np.concatenate([cloud, *tracks.values()])
    return np.floor(points.min(axis=0)), np.ceil(points.max(axis=0))


def _columns(points: Array) -> dict[str, Any]:
    """``(N, 3)`` as the arguments x, y and z; single precision is half a page, and finer than a pixel."""
    return dict(zip("xyz", points.T.astype(np.float32), strict=True)) | {"hoverinfo": "skip"}


def _lines(bars: Array) -> dict[str, Any]:
    """Bars ``(M, 2, 3)`` as one line that is interrupted between them."""
    gap = np.full((len(bars), 1, 3), np.nan)
    return _columns(np.concatenate([bars, gap], axis=1).reshape(-1, 3)) | {"mode": "lines"}
