"""The panel of notebook 00, in which a flight is chosen."""

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from steelnb import experiment, plots
from steelnb.core.errors import SteelnbError
from steelnb.core.types import Array, Segments, Trajectory
from steelnb.fusion.cloud_bars import bars_of_cloud
from steelnb.metrics import paired_clouds
from steelnb.notebook.runs import Flights
from steelnb.notebook.tables import title
from steelnb.plots import COLOURS, LABELS
from steelnb.plots.draw import figure_flight
from steelnb.plots.scene3d import HEIGHT_PX, figure_scene, plotly_bundle
from steelnb.settings import METHODS, SENSORS, TRAJECTORIES, ExperimentSettings
from steelnb.settings.world import at_level

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as PlotlyFigure

NOISES = ("random-walk", "constant-drift", "yaw-random-walk", "random-walk+yaw-random-walk")
POINTS_MAX = 20_000


@dataclass(frozen=True)
class ShownFlight:
    """A corrected flight: its ``paths`` as `figure_scene` takes them, the ``cloud (N, 3)`` of its preprocessed scans at
    the corrected poses, metres, at most `POINTS_MAX` points, and the bars of the map."""

    result: experiment.Result
    paths: dict[str, Trajectory]
    cloud: Array
    segments: Segments

    def picture(self) -> plots.Figure:
        """The scene as a static figure (`plots.draw.figure_flight`)."""
        method = self.result.settings.odometry.method
        names = {"drifting": "none", "corrected": method}
        paths = {LABELS[name]: (self.paths[path], COLOURS[name]) for path, name in names.items()}
        return figure_flight(paths, self.paths["true"], self.cloud, self.segments, title(self.result.settings))


class Panel:
    """Controls above a scene. Every change of a control runs the flight again and redraws the scene in place."""

    def __init__(
        self, trajectory: str, noise: str, level: float, sensor: str, method: str, seed: int, tower: str | None,
        duration_s: float, overrides: Mapping[str, Any],
    ) -> None:  # fmt: skip
        """The first flight, with ``level`` times the drift of a noise; the last three have no control. Raises
        `InputError` for a value that cannot be chosen."""
        import ipywidgets as widgets

        self._fixed: dict[str, Any] = {"duration_s": duration_s, "overrides": dict(overrides), "tower": tower}
        first: dict[str, Any] = {"trajectory": trajectory, "noise": noise, "sensor": sensor, "method": method}
        first |= {"level": level, "seed": seed}
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
        self.view: ShownFlight | None = None
        self._flights = Flights()
        self._picture: Any = None

    def settings(self, noise: str, level: float, **more: Any) -> ExperimentSettings:
        """The settings of a flight with ``level`` times the drift of a noise. Raises `InputError`."""
        return ExperimentSettings.preset(noise=at_level(noise, level), **more, **self._fixed)

    def show(self) -> ShownFlight:
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

    def _fly(self) -> ShownFlight:
        began = time.perf_counter()
        settings = self.settings(**{name: control.value for name, control in self.controls.items()})
        self._tell("flying", 0)
        flight, truth = self._flights(settings, functools.partial(self._tell, "flying"))
        paths = {"drifting": flight.prior, "true": truth.trajectory.at(flight.prior.stamp_s)}
        self._draw(figure_scene(paths, members=truth.tower.axes))
        doing = functools.partial(self._tell, "this is the drift; correcting it")
        result = experiment.estimate(settings, flight, truth, doing)
        segments = result.segments
        if not len(segments):  # the map of an odometry by clouds
            segments = bars_of_cloud(result.points).bars
        cloud = plots.thinned(paired_clouds(flight, result, truth, settings.odometry.preprocess, 1)[0], POINTS_MAX)
        self.view = ShownFlight(result, paths | {"corrected": result.corrected}, cloud, segments)
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
