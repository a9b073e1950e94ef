"""A flight to turn around with the mouse: cloud, bars and three trajectories, above the curve of the error."""

import json
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from steelnb.datatypes import Array, Segments, Trajectory
from steelnb.experiment import Result
from steelnb.figures.style import COLOURS, LABELS, Figure, draw_bars, frame_3d, style
from steelnb.metrics import position_error_m

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as PlotlyFigure

HEIGHT_PX = 860
PLOTLY_TYPE = "application/vnd.plotly.v1+json"
CLOUD, MEMBERS = "#8a94a6", "#c4c4c4"
TRACKS = {"true": COLOURS["truth"], "drifting": COLOURS["none"], "corrected": COLOURS["average"]}
WIDTHS = {"true": 3, "drifting": 4, "corrected": 8}
"""The corrected trajectory lies on the true one where all is well: one thin, one wide shows both."""
CAMERA = {"eye": {"x": 0.8, "y": -1.5, "z": 0.5}, "projection": {"type": "orthographic"}}


def figure_scene(result: Result, cloud: Array, segments: Segments) -> "PlotlyFigure":
    """The scene above the error curve, interactive; what the legend names can be switched off by a click on it.

    ``cloud (N, 3)`` are the scans at the corrected poses, ``segments`` the bars found in them, both in the world frame.
    """
    low, high, near = _seen(result, cloud)
    return _scene(_tracks(result), _errors(result), result.prior.stamp_s, cloud, segments, low, high, near)


def figure_recorded_scene(
    prior: Trajectory, corrected: Trajectory, truth: Trajectory | None, cloud: Array, segments: Segments
) -> "PlotlyFigure":
    """The same of a recorded flight, whose true members nobody knows; errors at the poses of ``truth``."""
    tracks = {"drifting": prior.position, "corrected": corrected.position}
    errors, stamp_s = {}, prior.stamp_s
    if truth is not None:
        tracks = {"true": truth.position} | tracks
        stamp_s = truth.stamp_s
        errors = {
            name: position_error_m(path.at(stamp_s), truth)
            for name, path in {"drifting": prior, "corrected": corrected}.items()
        }
    points = np.concatenate([cloud, *tracks.values()])
    low, high = np.floor(points.min(axis=0)), np.ceil(points.max(axis=0))
    return _scene(tracks, errors, stamp_s - stamp_s[0], cloud, segments, low, high)


def plotly_bundle(figure: "PlotlyFigure", text: str) -> dict[str, Any]:
    """A figure as JupyterLab's renderer of Plotly takes it, whatever renderer the user's settings name; and as text."""
    content = json.loads(cast(str, figure.to_json()))
    return {PLOTLY_TYPE: {**content, "config": {"displaylogo": False, "responsive": True}}, "text/plain": text}


def _scene(
    tracks: dict[str, Array],
    errors: dict[str, Array],
    time_s: Array,
    cloud: Array,
    segments: Segments,
    low: Array,
    high: Array,
    members: Array | None = None,
) -> "PlotlyFigure":
    """The scene between the corners ``low`` and ``high (3,)``, with true ``members (M, 2, 3)`` where they are known,
    and the errors ``(N,)`` at ``time_s (N,)`` below it, where there are any."""
    from plotly.graph_objects import Scatter, Scatter3d
    from plotly.subplots import make_subplots

    rows = {"rows": 2, "row_heights": (0.7, 0.3), "specs": [[{"type": "scene"}], [{"type": "xy"}]]}
    if not errors:
        rows = {"rows": 1, "specs": [[{"type": "scene"}]]}
    figure = make_subplots(cols=1, vertical_spacing=0.06, **rows)
    if members is not None:
        line = {"color": MEMBERS, "width": 2}
        figure.add_trace(Scatter3d(**_lines(members), name="true members", line=line), row=1, col=1)
    points = Scatter3d(
        **_columns(cloud), mode="markers", name="cloud", marker={"size": 1, "color": CLOUD, "opacity": 0.5}
    )
    bars = np.stack([segments.start, segments.end], axis=1)
    found = Scatter3d(**_lines(bars), name="bars found", line={"color": COLOURS["least_squares"], "width": 6})
    figure.add_traces([points, found], rows=1, cols=1)
    for name, trajectory in tracks.items():
        line = {"color": TRACKS[name], "width": WIDTHS[name]}
        path = Scatter3d(**_columns(trajectory), mode="lines", name=name, legendgroup=name, line=line)
        figure.add_trace(path, row=1, col=1)
    for name, error in errors.items():
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


def figure_flight(result: Result, cloud: Array, segments: Segments) -> Figure:
    """The same on paper: the scene on the left, the error curve on the right. Arguments as of `figure_scene`."""
    with style():
        figure = Figure(figsize=(11, 4.8))
        grid = figure.add_gridspec(1, 2, width_ratios=(1, 1.5))
        scene = figure.add_subplot(grid[0], projection="3d")
        low, high, near = _seen(result, cloud)
        draw_bars(scene, near, colors=MEMBERS, linewidths=0.5)
        scene.scatter(*cloud[::4].T, s=0.4, color=CLOUD, linewidths=0)
        draw_bars(
            scene, np.stack([segments.start, segments.end], axis=1), colors=COLOURS["least_squares"], linewidths=1.6
        )
        curve = figure.add_subplot(grid[1])
        for name, positions in _tracks(result).items():
            scene.plot(*positions.T, color=TRACKS[name], linewidth=2.8 if name == "true" else 1.4, label=name)
        for name, error in _errors(result).items():
            curve.plot(result.prior.stamp_s, error, color=TRACKS[name], label=f"{name}: mean {error.mean():.3f} m")
        frame_3d(scene, np.stack([low, high]), -60, zoom=0.88)
        scene.set_yticks([tick for tick in scene.get_yticks() if tick < high[1] - 0.5])  # the last would lie on 0 of z
        scene.plot([], [], color=COLOURS["least_squares"], label="bars found")
        scene.legend(loc="upper left", bbox_to_anchor=(-0.1, 1.05), fontsize=10)
        curve.set(xlabel="time (s)", ylabel="distance to the truth (m)", xlim=(0, result.prior.stamp_s[-1]))
        curve.set_ylim(0, 1.3 * curve.get_ylim()[1])
        s = result.settings
        curve.set_title(f"{s.flight.trajectory}, {s.noise_name}, sensor {s.sensor}, {LABELS[s.odometry.method]}")
        curve.legend(loc="upper left", fontsize=10)
    return figure


def _seen(result: Result, cloud: Array) -> tuple[Array, Array, Array]:
    """Lowest and highest corner ``(3,)`` of what was flown and seen, whole metres from the ground up, and the axes
    ``(M, 2, 3)`` of the true members that do not reach above it."""
    points = np.concatenate([cloud, *_tracks(result).values()])
    low, high = np.floor(points.min(axis=0)), np.ceil(points.max(axis=0))
    low[2] = 0.0
    axes = result.truth.tower.axes
    return low, high, axes[(axes[:, :, 2] <= high[2]).all(axis=1)]


def _tracks(result: Result) -> dict[str, Array]:
    """The three trajectories as positions ``(N, 3)`` at the scans."""
    true = result.truth.trajectory.at(result.prior.stamp_s)
    return {"true": true.position, "drifting": result.prior.position, "corrected": result.corrected.position}


def _errors(result: Result) -> dict[str, Array]:
    """The distance to the truth ``(N,)`` of the two that have one."""
    truth = result.truth.trajectory
    return {"drifting": position_error_m(result.prior, truth), "corrected": position_error_m(result.corrected, truth)}


def _columns(points: Array) -> dict[str, Any]:
    """``(N, 3)`` as the arguments x, y and z; single precision is half a page, and finer than a pixel."""
    return dict(zip("xyz", points.T.astype(np.float32), strict=True)) | {"hoverinfo": "skip"}


def _lines(bars: Array) -> dict[str, Any]:
    """Bars ``(M, 2, 3)`` as one line that is interrupted between them."""
    gap = np.full((len(bars), 1, 3), np.nan)
    return _columns(np.concatenate([bars, gap], axis=1).reshape(-1, 3)) | {"mode": "lines"}
