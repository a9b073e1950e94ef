"""The plotly scene of notebooks 00 and 13, and the panel of notebook 00 in which a flight is chosen."""

import functools
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from steelnb import experiment, plots
from steelnb.core.errors import SteelnbError
from steelnb.core.types import Array, Flight, Segments, Trajectory
from steelnb.hough.lines import default_dx
from steelnb.hough.whole_structure.search import MIN_VOTES, segment_structure
from steelnb.metrics import position_error_m
from steelnb.notebook.batch import at_level
from steelnb.notebook.tables import case_of, paired_clouds
from steelnb.plots import COLOURS, LABELS, flight
from steelnb.settings import METHODS, SENSORS, TRAJECTORIES, ExperimentSettings
from steelnb.simulation import Truth

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as PlotlyFigure

NOISES = ("random-walk", "constant-drift", "yaw-random-walk", "random-walk+yaw-random-walk")
POINTS_MAX = 20_000
HEIGHT_PX = 560
PLOTLY_TYPE = "application/vnd.plotly.v1+json"
WIDTHS = {"true": 3, "drifting": 4, "corrected": 8}
"""Widths of the paths. A good correction covers the true path, so one is thin and the other wide to show both."""


@dataclass(frozen=True)
class View:
    """A corrected flight: its ``paths`` as `figure_scene` takes them, the ``cloud (N, 3)`` of its preprocessed scans at
    the corrected poses, metres, at most `POINTS_MAX` points, and the bars of the map."""

    result: experiment.Result
    paths: dict[str, Trajectory]
    cloud: Array
    segments: Segments


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
    axes = {f"{axis}axis": {"title": {"text": f"{axis} (m)"}, "showspikes": False} for axis in "xyz"}
    figure.update_layout(
        template="plotly_white",
        height=HEIGHT_PX,
        margin={"l": 0, "r": 16, "t": 12, "b": 48},
        legend={"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom", "itemsizing": "constant"},
        scene={**axes, "aspectmode": "data", "camera": {"eye": {"x": 1.0, "y": -1.9, "z": 0.6}}},
    )
    figure.update_xaxes(title_text="time (s)")
    where = "truth" if "true" in known else "recorded poses"
    beside = {"rangemode": "tozero", "side": "right"}  # on the left its title would lie over a narrow scene
    figure.update_yaxes(title_text=f"distance to the {where} (m)", **beside)
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


def figure_flight(view: View) -> plots.Figure:
    """The scene as a static figure (`pictures.figure_flight`)."""
    case, method = case_of(view.result.settings), view.result.settings.odometry.method
    title = "{trajectory} flight, {noise}, sensor {sensor}, seed {seed}".format_map(case)
    names = {"drifting": "none", "corrected": method}
    paths = {LABELS[name]: (view.paths[path], COLOURS[name]) for path, name in names.items()}
    return flight.figure_flight(paths, view.paths["true"], view.cloud, view.segments, title)


class Panel:
    """Controls above a scene. Every change of a control runs the flight again and redraws the scene in place."""

    def __init__(self, duration_s: float, overrides: Mapping[str, Any], **first: Any) -> None:
        """``first``: trajectory, noise, level (times the noise), sensor, method and seed of the first flight. Raises
        `InputError` for a value that cannot be chosen."""
        import ipywidgets as widgets

        self._fixed: dict[str, Any] = {"duration_s": duration_s, "overrides": dict(overrides)}
        self.settings(**first)
        choices = {
            "trajectory": TRAJECTORIES,
            "sensor": tuple(dict.fromkeys((*SENSORS, first["sensor"]))),
            "method": [(LABELS.get(name, name), name) for name in METHODS],
            "noise": tuple(dict.fromkeys((*NOISES, first["noise"]))),
        }
        self.controls = {name: widgets.Dropdown(options=each, value=first[name]) for name, each in choices.items()}
        for name, kind, most in (("level", widgets.FloatSlider, 5.0), ("seed", widgets.IntSlider, 50)):
            self.controls[name] = kind(first[name], min=0, max=max(most, first[name]), continuous_update=False)
        self.controls["level"].step = 0.25
        for name, control in self.controls.items():
            control.description, control.layout.width = f"{name} ×" if name == "level" else name, "21em"
            control.observe(self._follow, "value")
        self.status = widgets.HTML()
        self.view: View | None = None
        self._flown: dict[Any, tuple[Flight, Truth]] = {}
        self._picture: Any = None

    def settings(self, noise: str, level: float, **more: Any) -> ExperimentSettings:
        """The settings of a flight with ``level`` times the drift of a noise. Raises `InputError`."""
        return ExperimentSettings.preset(noise=at_level(noise, level), **more, **self._fixed)

    def show(self) -> View:
        """Display the controls and the scene below the current cell: first the drifting flight, then the corrected one,
        which is returned. Raises `CollisionError`."""
        import ipywidgets as widgets
        from IPython.display import display

        display(widgets.Box([*self.controls.values(), self.status], layout={"flex_flow": "row wrap"}))
        return self._fly()

    def _follow(self, change: Mapping[str, Any]) -> None:
        """Run the flight that the controls describe. An error is shown as text, and the scene stays."""
        try:
            self._fly()
        except SteelnbError as fault:
            self.status.value = str(fault)

    def _fly(self) -> View:
        began = time.perf_counter()
        settings = self.settings(**{name: control.value for name, control in self.controls.items()})
        self._tell("flying", 0)
        world = experiment.world(settings)
        if world not in self._flown:
            self._flown = {world: experiment.simulate(settings, functools.partial(self._tell, "flying"))}
        flight, truth = self._flown[world]
        flight = experiment.redrift(settings, flight, truth)
        paths = {"drifting": flight.prior, "true": truth.trajectory.at(flight.prior.stamp_s)}
        self._draw(figure_scene(paths, members=truth.tower.axes))
        doing = functools.partial(self._tell, "this is the drift; correcting it")
        result = experiment.estimate(settings, flight, truth, doing)
        segments = result.segments
        if not len(segments) and len(result.points) > MIN_VOTES:  # the map of an odometry by clouds
            segments = segment_structure(result.points, default_dx(result.points))
        cloud = plots.thinned(paired_clouds(flight, result, every=1)[0], POINTS_MAX)
        self.view = View(result, paths | {"corrected": result.corrected}, cloud, segments)
        method, numbers = settings.odometry.method, result.metrics
        self._draw(figure_scene(self.view.paths, cloud, segments, truth.tower.axes, method))
        errors = [f"{numbers[name]:.3f} m" for name in ("raw_ate_rmse_m", "ate_rmse_m")]
        self.status.value = (
            f"computed in {time.perf_counter() - began:.1f} s: root mean square error {errors[0]} without correction, "
            f"{errors[1]} with {LABELS[method]}; {len(segments)} bars"
        )
        return self.view

    def _tell(self, doing: str, share: float) -> None:
        self.status.value = f"{doing}: {100 * share:.0f} %"

    def _draw(self, scene: "PlotlyFigure") -> None:
        """Display a scene in place of the previous one or, if it is the first, below the current cell."""
        from IPython.display import display

        bundle = plotly_bundle(scene)
        if self._picture is None:
            self._picture = display(bundle, raw=True, display_id=True)
            return
        # The Plotly renderer does not redraw what it has drawn, so output of another type replaces it first.
        self._picture.update({"text/html": f"<div style='height: {HEIGHT_PX}px'></div>"}, raw=True)
        self._picture.update(bundle, raw=True)
