"""Notebook 00: a short flight for any choice of settings, and a scene to turn around."""

import functools
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from steelnb import experiment
from steelnb.batch import caption
from steelnb.hough.blocks import MIN_VOTES, segment_structure
from steelnb.hough.dx import default_dx
from steelnb.metrics import position_error_m
from steelnb.plots import (
    COLOURS,
    LABELS,
    Figure,
    draw_bars,
    draw_paths,
    end_points,
    gather_legend,
    project_perspective,
    style,
    thinned,
)
from steelnb.row import paired_clouds
from steelnb.settings import ExperimentSettings
from steelnb.simulation import Tower
from steelnb.types import Array, Segments, Trajectory

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as PlotlyFigure
    from plotly.graph_objects import Scatter3d

POINTS_MAX = 20_000
HEIGHT_PX = 860
PLOTLY_TYPE = "application/vnd.plotly.v1+json"
WIDTHS = {"true": 3, "drifting": 4, "corrected": 8}
"""The corrected trajectory lies on the true one where all is well: one thin, one wide shows both."""
CAMERA = {"eye": {"x": 0.8, "y": -1.5, "z": 0.5}, "projection": {"type": "orthographic"}}


@dataclass(frozen=True)
class View:
    """One flight with a ``cloud (N, 3)`` of its preprocessed scans at the corrected poses, at most `POINTS_MAX` points,
    the bars of the map, and the seconds it took."""

    result: experiment.Result
    cloud: Array
    segments: Segments
    seconds: float

    @property
    def trajectories(self) -> tuple[Trajectory, Trajectory, Trajectory]:
        """The drifting, the corrected and the true trajectory at the scans."""
        prior = self.result.prior
        return prior, self.result.corrected, self.result.truth.trajectory.at(prior.stamp_s)

    @property
    def summary(self) -> str:
        """The numbers of the flight in a sentence (Markdown)."""
        s, numbers = self.result.settings, self.result.metrics
        method = s.odometry.method
        after = "" if method == "none" else f", **{numbers['ate_rmse_m']:.3f} m with {LABELS[method]}**"
        return (
            f"{s.flight.trajectory}, {s.noise_name}, sensor {s.sensor}, seed {s.seed}: root mean square error "
            f"{numbers['raw_ate_rmse_m']:.3f} m without correction{after}; {len(self.segments)} bars in the map. "
            f"{len(self.result.prior)} scans in {s.flight.duration_s:g} s of flight."
        )


def fly(
    settings: ExperimentSettings,
    on_flown: Callable[[Trajectory, Trajectory, Tower], object] | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> View:
    """Fly, let the pose drift, correct it. Raises `CollisionError`.

    ``on_flown`` is called with the drifting and the true poses and the tower before the poses are corrected,
    which takes longer.
    """
    began = time.perf_counter()
    same = {name: getattr(settings, name) for name in ("tower", "flight", "tof", "sensor", "seed")}
    flight, truth = _flown(ExperimentSettings.preset(noise="none").replace(**same))
    flight = experiment.redrift(settings, flight, truth)
    if on_flown:
        on_flown(flight.prior, truth.trajectory.at(flight.prior.stamp_s), truth.tower)
    result = experiment.estimate(settings, flight, truth, on_progress)
    cloud = thinned(paired_clouds(flight, result, every=1)[0], POINTS_MAX)
    segments = result.segments
    if not len(segments) and len(result.points) > MIN_VOTES:  # the map of an odometry by clouds
        segments = segment_structure(result.points, default_dx(result.points))
    return View(result, cloud, segments, time.perf_counter() - began)


_flown = functools.lru_cache(maxsize=4)(experiment.simulate)


def figure_scene(
    prior: Trajectory,
    corrected: Trajectory | None,
    truth: Trajectory | None,
    cloud: Array | None = None,
    segments: Segments | None = None,
    members: Array | None = None,
    method: str = "best",
) -> "PlotlyFigure":
    """The scene above the error curve, interactive; what the legend names can be switched off by a click on it.

    ``cloud (N, 3)`` are the scans at the corrected poses, ``segments`` the bars found in them, ``members``
    ``(M, 2, 3)`` the true ones, all in the world frame; errors are those at the stamps of ``truth``. The corrected
    trajectory has the colour of the ``method``. What is None is not there yet.
    """
    from plotly.graph_objects import Scatter, Scatter3d
    from plotly.subplots import make_subplots

    tracks, errors = tracks_and_errors(prior, corrected, truth)
    colours = {"true": COLOURS["truth"], "drifting": COLOURS["none"], "corrected": COLOURS[method]}
    around = np.concatenate([np.zeros((0, 3)) if cloud is None else cloud, *tracks.values()])
    low, high = np.floor(around.min(axis=0)), np.ceil(around.max(axis=0))
    rows = {"rows": 2, "row_heights": (0.7, 0.3), "specs": [[{"type": "scene"}], [{"type": "xy"}]]}
    if not errors:
        rows = {"rows": 1, "specs": [[{"type": "scene"}]]}
    figure = make_subplots(cols=1, vertical_spacing=0.06, **rows)
    traces = []
    if members is not None:
        low[2] = 0.0
        members = members[(members[:, :, 2] <= high[2]).all(axis=1)]
        traces.append(_path(_apart(members), "true members", COLOURS["member"], 2))
    if cloud is not None:
        marker = {"size": 1, "color": COLOURS["points"], "opacity": 0.5}
        traces.append(Scatter3d(**_columns(cloud), mode="markers", name="cloud", marker=marker))
    if segments is not None:
        traces.append(_path(_apart(end_points(segments)), "bars found", COLOURS["bars found"], 6))
    traces += [_path(at, name, colours[name], WIDTHS[name], legendgroup=name) for name, at in tracks.items()]
    figure.add_traces(traces, rows=1, cols=1)
    for name, (time_s, error) in errors.items():
        line = {"color": colours[name], "width": 2}
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
    )
    figure.update_xaxes(title_text="time (s)")
    figure.update_yaxes(title_text="distance to the truth (m)", rangemode="tozero")
    return figure


def plotly_bundle(figure: "PlotlyFigure", text: str) -> dict[str, Any]:
    """A figure as JupyterLab's renderer of Plotly takes it, whatever renderer the user's settings name; and as text."""
    content = json.loads(cast(str, figure.to_json()))
    return {PLOTLY_TYPE: {**content, "config": {"displaylogo": False, "responsive": True}}, "text/plain": text}


def tracks_and_errors(
    prior: Trajectory, corrected: Trajectory | None, truth: Trajectory | None
) -> tuple[dict[str, Array], dict[str, tuple[Array, Array]]]:
    """Positions ``(N, 3)`` of each trajectory, and where there is truth the times ``(N,)`` and errors ``(N,)`` of both
    others."""
    paths = {"drifting": prior} if corrected is None else {"drifting": prior, "corrected": corrected}
    tracks = {name: path.position for name, path in paths.items()}
    if truth is None:
        return tracks, {}
    time_s = truth.stamp_s - truth.stamp_s[0]
    errors = {name: (time_s, position_error_m(path.at(truth.stamp_s), truth)) for name, path in paths.items()}
    return {"true": truth.position, **tracks}, errors


def _columns(points: Array) -> dict[str, Any]:
    """``(N, 3)`` as the arguments x, y and z; single precision is half a page, and finer than a pixel."""
    return dict(zip("xyz", points.T.astype(np.float32), strict=True)) | {"hoverinfo": "skip"}


def _apart(bars: Array) -> Array:
    """Bars ``(M, 2, 3)`` as the points ``(3 M, 3)`` of one line that is interrupted between them."""
    return np.concatenate([bars, np.full((len(bars), 1, 3), np.nan)], axis=1).reshape(-1, 3)


def _path(points: Array, name: str, colour: str, width: float, **more: Any) -> "Scatter3d":
    from plotly.graph_objects import Scatter3d

    return Scatter3d(**_columns(points), mode="lines", name=name, line={"color": colour, "width": width}, **more)


@style()
def figure_flight(view: View) -> Figure:
    """The scene on paper: cloud, bars and trajectories on the left, the error curve on the right."""
    figure = Figure(figsize=(11, 5.6))
    scene, curve = figure.subplots(1, 2, width_ratios=(1, 1.2))
    tracks, errors = tracks_and_errors(*view.trajectories)
    method, axes = view.result.settings.odometry.method, view.result.truth.tower.axes
    axes = axes[(axes[:, :, 2] <= np.ceil(view.cloud[:, 2].max())).all(axis=1)]
    around, keys = axes.reshape(-1, 3), {"true": "truth", "drifting": "none", "corrected": method}
    draw_bars(scene, axes, around, colors=COLOURS["member"], linewidths=0.7, label="true members")
    x, y = project_perspective(view.cloud[::4], around).T
    scene.scatter(x, y, s=0.6, color=COLOURS["points"], linewidths=0, label="cloud")
    bars = end_points(view.segments)
    draw_bars(scene, bars, around, colors=COLOURS["bars found"], linewidths=1.8, label="bars found")
    draw_paths(scene, {keys[name]: at for name, at in tracks.items()}, around, {"truth": "true"})
    for name, (time_s, error) in errors.items():
        label = f"{LABELS[keys[name]]}: mean {error.mean():.3f} m"
        curve.plot(time_s, error, color=COLOURS[keys[name]], label=label)
    curve.set(xlabel="time (s)", ylabel="distance to the truth (m)", xlim=(0, time_s[-1]))
    gather_legend(figure, ncols=3, markerscale=8)
    figure.suptitle(f"{caption([view.result])}, {LABELS[method]}")
    return figure
