"""What notebook 00 does: a short flight for any choice of settings, and a panel to choose them with.

A flight and its scans take most of the time, and do not depend on drift and method: they are made once and kept.
"""

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from steelnb import experiment
from steelnb.config import (
    METHODS,
    REPORT_NOISE,
    SENSORS,
    TRAJECTORIES,
    ExperimentSettings,
    MethodName,
    NoiseSettings,
    SensorName,
    TrajectoryName,
)
from steelnb.datatypes import Array, Flight, Segments, Trajectory
from steelnb.errors import SteelnbError
from steelnb.figures import HEIGHT_PX, LABELS, figure_scene, plotly_bundle
from steelnb.hough.blocks import segment_structure
from steelnb.segment import MIN_VOTES, tube_radius
from steelnb.simulation import Truth

if TYPE_CHECKING:
    from IPython.display import DisplayHandle

POINTS_MAX = 20_000
NOISES = ("random-walk", "constant-drift", "yaw-random-walk", "random-walk+yaw-random-walk")


@dataclass(frozen=True)
class View:
    """One flight and what there is to see: the scans as a ``cloud (N, 3)`` at the corrected poses, at most
    `POINTS_MAX` points; the bars of the map; and the time it took."""

    result: experiment.Result
    cloud: Array
    segments: Segments
    seconds: float

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


def at_level(noise: str, level: float) -> str:
    """A noise whose levels, the report's where it names none, are multiplied by ``level``. Raises `SettingsError`."""
    NoiseSettings.parse(noise)
    if noise == "none" or level == 1:
        return noise
    parts = (part.strip().partition(":") for part in noise.split("+"))
    scaled = "+".join(f"{name}:{level * float(given or REPORT_NOISE[name][1]):g}" for name, _, given in parts)
    NoiseSettings.parse(scaled)
    return scaled


def fly(
    trajectory: TrajectoryName,
    noise: str,
    level: float,
    sensor: SensorName,
    method: MethodName,
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
    plain = ExperimentSettings.preset(trajectory, "none", "none", sensor, seed, duration_s)
    flight, truth = _flown(plain.but(tower=settings.tower, flight=settings.flight, tof=settings.tof))
    result = experiment.estimate(settings, experiment.redrift(settings, flight, truth), truth)
    cloud = place(flight, result.corrected, settings.preprocess.floor_m)
    segments = result.segments
    if not len(segments) and len(result.points) > MIN_VOTES:  # the map of an odometry by clouds
        segments = segment_structure(result.points, tube_radius(result.points), MIN_VOTES)
    return View(result, cloud, segments, time.perf_counter() - began)


@functools.lru_cache(maxsize=4)
def _flown(settings: ExperimentSettings) -> tuple[Flight, Truth]:
    return experiment.simulate(settings)


def place(flight: Flight, poses: Trajectory, floor_m: float, points_max: int = POINTS_MAX) -> Array:
    """The returns of all scans above ``floor_m``, laid at ``poses``: a cloud ``(N, 3)`` of at most ``points_max``
    points, evenly taken from every scan."""
    each = points_max // max(len(flight.scans), 1)
    placed = []
    for scan, T_world_drone in zip(flight.scans, poses.T_world_drone, strict=True):
        T_world_sensor = T_world_drone @ flight.T_drone_sensor
        world = scan.points.reshape(-1, 3) @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3]
        world = world[world[:, 2] >= floor_m]  # NaN, where nothing returned, is not
        placed.append(world[np.linspace(0, len(world) - 1, min(each, len(world))).astype(int)])
    return np.concatenate(placed) if placed else np.zeros((0, 3))


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
        return plotly_bundle(figure_scene(self.view.result, self.view.cloud, self.view.segments), self.view.summary)
