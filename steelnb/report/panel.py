"""Notebook 00: the panel in which a flight is chosen, and the picture below it that follows."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from steelnb.batch import at_level
from steelnb.errors import SteelnbError
from steelnb.plots import LABELS
from steelnb.scene import HEIGHT_PX, View, figure_scene, fly, plotly_bundle
from steelnb.settings import METHODS, SENSORS, TRAJECTORIES, ExperimentSettings, TrajectoryName
from steelnb.simulation import Tower
from steelnb.types import Trajectory

if TYPE_CHECKING:
    from IPython.display import DisplayHandle

NOISES = ("random-walk", "constant-drift", "yaw-random-walk", "random-walk+yaw-random-walk")
DRIFTED = "The flight, and the poses as they drift. Their correction follows."


class Panel:
    """Controls above a picture that follows them: every change flies again and redraws the picture in its place."""

    def __init__(
        self,
        trajectory: TrajectoryName,
        noise: str,
        level: float,
        sensor: str,
        method: str,
        seed: int,
        duration_s: float,
        overrides: Mapping[str, Any] | None = None,
    ) -> None:
        """The first flight; raises `InputError` for a value that cannot be chosen."""
        import ipywidgets as widgets

        self.view: View | None = None
        self.duration_s, self.overrides = duration_s, dict(overrides or {})
        self.settings(trajectory, noise, level, sensor, method, seed)
        wide, names = {"description_width": "5em"}, [(LABELS.get(name, name), name) for name in METHODS]
        self.controls = {
            "trajectory": widgets.ToggleButtons(options=TRAJECTORIES, value=trajectory),
            "sensor": widgets.ToggleButtons(options=list(dict.fromkeys((*SENSORS, sensor))), value=sensor),
            "noise": widgets.Dropdown(options=list(dict.fromkeys((*NOISES, noise))), value=noise),
            "level": widgets.FloatSlider(level, min=0, max=max(5.0, level), step=0.25, continuous_update=False),
            "method": widgets.Dropdown(options=names, value=method),
            "seed": widgets.IntSlider(seed, min=0, max=max(50, seed), continuous_update=False),
        }
        for name, control in self.controls.items():
            control.description, control.style = f"{name} ×" if name == "level" else name, wide
            control.layout.width = "26em"
            control.observe(self._follow, "value")
        self.controls["level"].tooltip = "times the report's drift"
        self.status = widgets.Label("flying …")
        self._sentence: DisplayHandle | None = None
        self._picture: DisplayHandle | None = None

    def settings(
        self, trajectory: TrajectoryName, noise: str, level: float, sensor: str, method: str, seed: int
    ) -> ExperimentSettings:
        """The settings of a flight with ``level`` times the drift of a noise. Raises `InputError`."""
        noise = at_level(noise, level)
        return ExperimentSettings.preset(trajectory, noise, method, sensor, seed, self.duration_s, self.overrides)

    def show(self, on_progress: Callable[[float], None] | None = None) -> View:
        """Display controls, sentence and picture below the current cell: as soon as it is flown the drift, and when it
        is corrected the view, which is given. Raises what `explore.fly` raises."""
        import ipywidgets as widgets
        from IPython.display import display

        flow = widgets.Layout(display="flex", flex_flow="row wrap", align_items="center")
        display(widgets.Box([*self.controls.values(), self.status], layout=flow))
        return self._fly(self._show_drift, on_progress)

    def _follow(self, change: Mapping[str, Any]) -> None:
        """Fly with what the controls say; a fault is told in the status line, and the picture stays."""
        self.status.value = "flying …"
        try:
            self._fly()
        except SteelnbError as fault:
            self.status.value = str(fault)

    def _fly(self, on_flown: Callable[..., object] | None = None, on_progress: Any = None) -> View:
        chosen = {name: control.value for name, control in self.controls.items()}
        self.view = view = fly(self.settings(**chosen), on_flown, on_progress)
        members, method = view.result.truth.tower.axes, view.result.settings.odometry.method
        scene = figure_scene(*view.trajectories, view.cloud, view.segments, members, method)
        self._draw(view.summary, plotly_bundle(scene, view.summary))
        self.status.value = f"computed in {view.seconds:.1f} s"
        return view

    def _show_drift(self, prior: Trajectory, truth: Trajectory, tower: Tower) -> None:
        self.status.value = "scanning and correcting …"
        scene = figure_scene(prior, None, truth, members=tower.axes)
        self._draw(DRIFTED, plotly_bundle(scene, DRIFTED))

    def _draw(self, sentence: str, bundle: dict[str, Any]) -> None:
        """Put a sentence (Markdown) and a picture in the place of those before, or below the current cell."""
        from IPython.display import Markdown, display

        if self._picture is None or self._sentence is None:
            self._sentence = display(Markdown(sentence), display_id=True)
            self._picture = display(bundle, raw=True, display_id=True)
            return
        self._sentence.update(Markdown(sentence))
        # The renderer of Plotly leaves what it has drawn as it is; one of another type in between ends it.
        self._picture.update({"text/html": f"<div style='height: {HEIGHT_PX}px'></div>"}, raw=True)
        self._picture.update(bundle, raw=True)
