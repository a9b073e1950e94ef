"""Notebooks 02 to 05: figures of odometries (3.2, 3.3, 3.5–3.10, 5.2, 5.3): errors, methods side by side, clouds."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from steelnb.batch import caption, plot_of, report_curve
from steelnb.experiment import Result
from steelnb.metrics import Bend, position_error_m
from steelnb.plots import (
    COLOURS,
    LABELS,
    Figure,
    draw_bars,
    draw_paths,
    gather_legend,
    style,
    thinned,
)
from steelnb.settings.report_plots import ReportPlot
from steelnb.types import Array

POINTS_MAX = 60_000
ERROR_MIN_M, ERROR_MAX_M = 0.005, 12.0
"""Ends of a logarithmic axis of errors, which begin at zero."""
CLOUDS = {"report-icp": "3.7", "report-icp-3dof": "3.8", "report-gicp": "3.9"}
REPORT_FIGURES = {
    "random-walk": CLOUDS,
    "constant-drift": CLOUDS,  # the report does not say which of both
    "random-walk+yaw-random-walk": {"gicp": "5.2, 5.3"},
}
"""The report's figures of clouds: noise → method → number."""
SMOOTHED_S = 10.0


@style()
def figure_segment_errors(results: Sequence[Result]) -> Figure:
    """A row for each noise: the trajectories (left), the distance to the truth with and without correction (right).

    ``results`` hold one flight under any noises, each with the correction ``none`` among others. Trajectories are the
    true one, the drifting one and that of the last correction.
    """
    noises = list(dict.fromkeys(result.settings.noise_name for result in results))
    figure = Figure(figsize=(12.5, 4.4 * len(noises)))
    grid = figure.add_gridspec(len(noises), 2, width_ratios=(1, 2.4))
    first = None
    for row, noise in enumerate(noises):
        of_noise = [result for result in results if result.settings.noise_name == noise]
        last = of_noise[-1]
        scene, curve = figure.add_subplot(grid[row, 0]), figure.add_subplot(grid[row, 1], sharey=first)
        first = first or curve
        _draw_flight(scene, last)
        _draw_errors(curve, {_with_numbers(result): result for result in of_noise})
        _draw_report(curve, plot_of(last.settings))
        curve.plot([], [], color=COLOURS["truth"], label="true path (left)")
        curve.set(ylabel="distance to the truth (m)", title=caption(of_noise), xlabel="time (s)")
        curve.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), fontsize=10)
    return figure


def _draw_flight(panel: Axes, result: Result) -> None:
    """Draw the tower with the true, the drifting and the corrected path of a run, in perspective."""
    truth, tower = result.truth.trajectory, result.truth.tower
    draw_bars(panel, tower.axes, tower.vertices, colors=COLOURS["member"], linewidths=0.5)
    paths = {"truth": truth, "none": result.prior, result.settings.odometry.method: result.corrected}
    draw_paths(panel, {name: path.position for name, path in paths.items()}, tower.vertices)


def _with_numbers(result: Result) -> str:
    """Name of a method with the mean and the largest of its error."""
    error = position_error_m(result.corrected, result.truth.trajectory)
    return f"{LABELS[result.settings.odometry.method]}: mean {error.mean():.3f} m, max {error.max():.3f} m"


def _draw_errors(panel: Axes, results: Mapping[str, Result]) -> None:
    """Draw the distance to the truth of some runs, by label, over time."""
    for label, result in results.items():
        error = position_error_m(result.corrected, result.truth.trajectory)
        stamps, colour = result.corrected.stamp_s, COLOURS[result.settings.odometry.method]
        panel.plot(stamps, error, color=colour, label=label)
    panel.set(xlim=(0, stamps[-1]))


def _draw_report(panel: Axes, plot: ReportPlot | None) -> None:
    """Draw the curves of the report's plot behind errors, whose axis turns logarithmic."""
    look: dict[str, Any] = {"color": COLOURS["report"], "linewidth": 1.0, "zorder": 1}
    if plot:
        panel.plot(*report_curve(plot, "drift"), ":", label="the report: no correction", **look)
        panel.plot(*report_curve(plot), label="the report: corrected", **look)
    panel.set(yscale="log", ylim=(ERROR_MIN_M, ERROR_MAX_M))


@style()
def figure_errors(results: Sequence[Result], rows: Sequence[Sequence[str]], smoothed_s: float = 0.0) -> Figure:
    """Rows of methods × columns of flights, all with the same axes: the distance to the truth over time, raw and
    corrected, or its running root mean square over a time.

    ``results`` hold one noise and sensor; drawn is the first of each method and flight, as far as they are there. Grey
    are the curves of the report's plot of the same samples.
    """
    cases: dict[tuple[str, str], Result] = {}
    for result in results:
        cases.setdefault((result.settings.odometry.method, result.settings.flight.trajectory), result)
    flights = list(dict.fromkeys(flight for _, flight in cases))
    figure = Figure(figsize=(5.4 * len(flights) + 0.4, (2.6 if len(rows) > 2 else 3.6) * len(rows) + 1.0))
    panels = figure.subplots(len(rows), len(flights), squeeze=False, sharex="col", sharey=True)
    for (row, column), panel in np.ndenumerate(panels):
        flight = flights[column]
        drawn = [cases[method, flight] for method in rows[row] if (method, flight) in cases]
        first = drawn[0] if drawn else results[0]
        raw = running_rms_m(replace(first, corrected=first.prior), smoothed_s)
        panel.plot(first.prior.stamp_s, raw, "--", color=COLOURS["none"], linewidth=1.2, label=LABELS["none"])
        panel.set_title(flight, fontsize=11)
        for result in drawn:
            error, method = running_rms_m(result, smoothed_s), result.settings.odometry.method
            panel.plot(result.corrected.stamp_s, error, color=COLOURS[method], label=LABELS[method])
            if len(rows[row]) == 1:
                title = f"{LABELS[method]}, {flight}: mean {error.mean():.2f} m, max {error.max():.2f} m"
                panel.set_title(title, fontsize=11)
        over = f", RMS over {smoothed_s:g} s" if smoothed_s else ""
        last_s = max(case.prior.stamp_s[-1] for (_, name), case in cases.items() if name == flight)
        panel.set(xlim=(0, last_s), ylabel=f"error (m){over}", xlabel="time (s)")
        _draw_report(panel, plot_of(first.settings))
        panel.label_outer()
    least_m = min(running_rms_m(result, smoothed_s).median() for result in cases.values())
    panels[0, 0].set_ylim(bottom=min(ERROR_MIN_M, 0.5 * least_m))
    gather_legend(figure, ncols=3)
    figure.suptitle(caption(results))
    return figure


def running_rms_m(result: Result, smoothed_s: float) -> pd.Series:
    """Position error of each scan ``(K,)`` as a root mean square over a time around it, metres."""
    square = pd.Series(position_error_m(result.corrected, result.truth.trajectory) ** 2)
    window = max(1, round(smoothed_s * result.settings.tof.rate_hz))
    return np.sqrt(square.rolling(window, center=True, min_periods=1).mean())


@style()
def figure_comparison(clouds: Mapping[str, tuple[Array, Array]], result: Result) -> Figure:
    """The cloud built with each method, in its colour, and the true one (black), from the front and from the side.

    ``result`` is that of any of the methods: it names the flight. Points of both clouds lie in turn above each other.
    """
    everything = np.concatenate([cloud for pair in clouds.values() for cloud in pair])
    low, high = np.add(np.quantile(everything, [0.0005, 0.9995], axis=0), [[-0.4], [0.4]])
    wide = (high - low)[:2]
    scale = min(6.0 / (high - low)[2], (14.0 / len(clouds) - 0.9) / wide.sum(), 5.0 / wide.sum())
    figure = Figure(figsize=(len(clouds) * (wide.sum() * scale + 0.9) + 0.4, (high - low)[2] * scale + 2.0))
    figure.suptitle(caption([result]))
    frames = figure.subfigures(1, len(clouds), squeeze=False)[0]
    for frame, (method, (built, true)) in zip(frames, clouds.items(), strict=True):
        panels = frame.subplots(1, 2, sharey=True, width_ratios=wide)
        for across, panel in enumerate(panels):
            _draw_clouds(panel, built, true, method, across)
            panel.set(xlim=(low[across], high[across]), ylim=(low[2], high[2]))
        panels[0].set_ylabel("z (m)")
        shown = REPORT_FIGURES.get(result.settings.noise_name, {}).get(method)
        frame.suptitle(LABELS[method] + (f" (report's {shown})" if shown else ""), fontsize=12)
    gather_legend(figure, ncols=3)
    return figure


def _draw_clouds(panel: Axes, built: Array, true: Array, method: str, across: int) -> None:
    """The cloud built with a method and the true one, seen along a horizontal axis, their points mixed."""
    clouds = {"truth": thinned(true, POINTS_MAX), method: thinned(built, POINTS_MAX)}
    points = np.concatenate(list(clouds.values()))
    colours = np.repeat([COLOURS[name] for name in clouds], [len(cloud) for cloud in clouds.values()])
    order = np.random.default_rng(0).permutation(len(points))  # neither cloud hides the other
    panel.scatter(points[order, across], points[order, 2], s=0.35, c=colours[order], linewidths=0, rasterized=True)
    for name, label in {"truth": "at the true poses", method: f"at the poses of {LABELS[method]}"}.items():
        panel.plot([], [], "o", color=COLOURS[name], label=label)
    panel.set(aspect="equal", xlabel=f"{'xy'[across]} (m)")
    panel.grid(alpha=0.2)


@style()
def figure_bend(bends: Mapping[str, Bend], axis: Array, result: Result) -> Figure:
    """Tilt, turn and offset of each method's cloud against height, logarithmic; the offset is that of a vertical
    ``axis``, the turn linear below 0.1°. ``result`` names the flight."""
    figure = Figure(figsize=(11, 5.6))
    panels = figure.subplots(1, 3, sharey=True)
    for method, fit in bends.items():
        offset = np.linalg.norm(fit.offset_m(axis), axis=1)
        for panel, values in zip(panels, (fit.tilt_deg, fit.yaw_deg, offset), strict=True):
            panel.plot(values, fit.height_m, "o-", color=COLOURS[method], markersize=4, label=LABELS[method])
    panels[0].set(xlabel="tilt of the vertical (°)", ylabel="height (m)", xscale="log", ylim=(0, None))
    panels[1].set(xlabel="turn about the vertical (°)")
    panels[1].set_xscale("symlog", linthresh=0.1)
    panels[2].set(xlabel="offset (m)", xscale="log")
    gather_legend(figure, ncols=4)
    figure.suptitle(caption([result]))
    return figure
