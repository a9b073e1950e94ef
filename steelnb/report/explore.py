"""Notebook 00: a short flight for any choice of settings, which are chosen in a panel, and a scene to turn around."""

import functools
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from steelnb import experiment
from steelnb.errors import SteelnbError
from steelnb.hough.blocks import segment_structure
from steelnb.hough.tube import MIN_VOTES, tube_radius
from steelnb.metrics import position_error_m
from steelnb.report.batch import at_level, caption
from steelnb.report.style import (
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
from steelnb.settings import METHODS, SENSORS, TRAJECTORIES, ExperimentSettings, TrajectoryName
from steelnb.study.row import paired_clouds
from steelnb.types import Array, Segments, Trajectory

if TYPE_CHECKING:
    from IPython.display import DisplayHandle
    from plotly.graph_objects import Figure as PlotlyFigure
    from plotly.graph_objects import Scatter3d

POINTS_MAX = 20_000
NOISES = ("random-walk", "constant-drift", "yaw-random-walk", "random-walk+yaw-random-walk")
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
    trajectory: TrajectoryName,
    noise: str,
    level: float,
    sensor: str,
    method: str,
    seed: int,
    duration_s: float,
    overrides: Mapping[str, Any] | None = None,
) -> View:
    """Fly, let the pose drift, correct it. Raises `SettingsError` and `CollisionError`."""
    began = time.perf_counter()
    settings = ExperimentSettings.preset(
        trajectory, at_level(noise, level), sensor=sensor, seed=seed, duration_s=duration_s,
        overrides=dict(overrides or {}), method=method,
    )  # fmt: skip
    plain = ExperimentSettings.preset(trajectory, "none", sensor=sensor, seed=seed, duration_s=duration_s)
    flight, truth = _flown(plain.replace(tower=settings.tower, flight=settings.flight, tof=settings.tof))
    result = experiment.estimate(settings, experiment.redrift(settings, flight, truth), truth)
    cloud = thinned(paired_clouds(flight, result, every=1)[0], POINTS_MAX)
    segments = result.segments
    if not len(segments) and len(result.points) > MIN_VOTES:  # the map of an odometry by clouds
        segments = segment_structure(result.points, tube_radius(result.points), MIN_VOTES)
    return View(result, cloud, segments, time.perf_counter() - began)


_flown = functools.lru_cache(maxsize=4)(experiment.simulate)


def figure_scene(
    prior: Trajectory,
    corrected: Trajectory,
    truth: Trajectory | None,
    cloud: Array,
    segments: Segments,
    members: Array | None = None,
    method: str = "best",
) -> "PlotlyFigure":
    """The scene above the error curve, interactive; what the legend names can be switched off by a click on it.

    ``cloud (N, 3)`` are the scans at the corrected poses, ``segments`` the bars found in them, ``members``
    ``(M, 2, 3)`` the true ones, all in the world frame; errors are those at the stamps of ``truth``. The corrected
    trajectory has the colour of the ``method``.
    """
    from plotly.graph_objects import Scatter, Scatter3d
    from plotly.subplots import make_subplots

    tracks, errors = tracks_and_errors(prior, corrected, truth)
    colours = {name: COLOURS[key] for name, key in track_keys(method).items()}
    low, high = corners(cloud, tracks)
    rows = {"rows": 2, "row_heights": (0.7, 0.3), "specs": [[{"type": "scene"}], [{"type": "xy"}]]}
    if not errors:
        rows = {"rows": 1, "specs": [[{"type": "scene"}]]}
    figure = make_subplots(cols=1, vertical_spacing=0.06, **rows)
    traces = []
    if members is not None:
        low[2] = 0.0
        members = members[(members[:, :, 2] <= high[2]).all(axis=1)]
        traces.append(_path(_apart(members), "true members", COLOURS["member"], 2))
    marker = {"size": 1, "color": COLOURS["points"], "opacity": 0.5}
    traces.append(Scatter3d(**_columns(cloud), mode="markers", name="cloud", marker=marker))
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


def track_keys(method: str) -> dict[str, str]:
    """The key of the colour of each of `tracks_and_errors`, where a method corrected."""
    return {"true": "truth", "drifting": "none", "corrected": method}


def corners(cloud: Array, tracks: dict[str, Array]) -> tuple[Array, Array]:
    """Lowest and highest corner ``(3,)`` around a cloud and trajectories, in whole metres."""
    points = np.concatenate([cloud, *tracks.values()])
    return np.floor(points.min(axis=0)), np.ceil(points.max(axis=0))


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
    method, highest_m = view.result.settings.odometry.method, corners(view.cloud, tracks)[1][2]
    axes = view.result.truth.tower.axes
    axes = axes[(axes[:, :, 2] <= highest_m).all(axis=1)]
    around, keys = axes.reshape(-1, 3), track_keys(method)
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


class Panel:
    """Controls above a view that follows them: every change flies again and redraws the picture in its place."""

    def __init__(self, first: View, noise: str, level: float, overrides: Mapping[str, Any] | None = None) -> None:
        """``first`` is shown before anything is changed; it was flown with ``noise``, ``level`` and ``overrides``."""
        import ipywidgets as widgets

        s = first.result.settings
        self.view, self.overrides = first, dict(overrides or {})
        method, wide = s.odometry.method, {"description_width": "5em"}
        names = [(LABELS.get(name, name), name) for name in METHODS]
        self.controls = {
            "trajectory": widgets.ToggleButtons(options=TRAJECTORIES, value=s.flight.trajectory),
            "sensor": widgets.ToggleButtons(options=SENSORS, value=s.sensor),
            "noise": widgets.Dropdown(options=list(dict.fromkeys((*NOISES, noise))), value=noise),
            "level": widgets.FloatSlider(level, min=0, max=max(5.0, level), step=0.25, continuous_update=False),
            "method": widgets.Dropdown(options=names, value=method),
            "seed": widgets.IntSlider(s.seed, min=0, max=max(50, s.seed), continuous_update=False),
        }
        for name, control in self.controls.items():
            control.description, control.style = f"{name} ×" if name == "level" else name, wide
            control.layout.width = "26em"
            control.observe(self._follow, "value")
        self.controls["level"].tooltip = "times the report's drift"
        self.status = widgets.Label(self._took())
        self._sentence: DisplayHandle | None = None
        self._picture: DisplayHandle | None = None

    def show(self) -> None:
        """Display controls, sentence and picture below the current cell."""
        import ipywidgets as widgets
        from IPython.display import Markdown, display

        flow = widgets.Layout(display="flex", flex_flow="row wrap", align_items="center")
        display(widgets.Box([*self.controls.values(), self.status], layout=flow))
        self._sentence = display(Markdown(self.view.summary), display_id=True)
        self._picture = display(self._bundle(), raw=True, display_id=True)

    def _follow(self, change: Mapping[str, Any]) -> None:
        """Fly with what the controls say; a fault is told in the status line, and the picture stays."""
        from IPython.display import Markdown

        chosen = {name: control.value for name, control in self.controls.items()}
        self.status.value = "flying …"
        duration_s = self.view.result.settings.flight.duration_s
        try:
            self.view = fly(**chosen, duration_s=duration_s, overrides=self.overrides)
        except SteelnbError as fault:
            self.status.value = str(fault)
            return
        if self._picture is not None and self._sentence is not None:
            self._sentence.update(Markdown(self.view.summary))
            # The renderer of Plotly leaves what it has drawn as it is; one of another type in between ends it.
            self._picture.update({"text/html": f"<div style='height: {HEIGHT_PX}px'></div>"}, raw=True)
            self._picture.update(self._bundle(), raw=True)
        self.status.value = self._took()

    def _took(self) -> str:
        return f"computed in {self.view.seconds:.1f} s"

    def _bundle(self) -> dict[str, Any]:
        view = self.view
        members, method = view.result.truth.tower.axes, view.result.settings.odometry.method
        picture = figure_scene(*view.trajectories, view.cloud, view.segments, members, method)
        return plotly_bundle(picture, view.summary)
