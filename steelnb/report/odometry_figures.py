"""Notebooks 02 to 06: figures of odometries (3.2, 3.3, 3.5–3.10, 5.2, 5.3): errors, methods side by side, clouds."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from steelnb.experiment import Result
from steelnb.metrics import Bend, position_error_m
from steelnb.report.batch import REPORT_CLOUD_ODOMETRY, REPORT_SEGMENT_ODOMETRY
from steelnb.report.style import COLOURS, LABELS, Figure, draw_bars, draw_legend, frame_3d, style, thinned
from steelnb.settings import SEGMENT_METHODS
from steelnb.types import Array

POINTS_MAX = 60_000
FLIGHTS = {"orbit": "around", "vertical": "vertical"}
"""The report's names of the flights, in the order of its columns."""
DECADES = ([0.01, 0.03, 0.1, 0.3, 1, 3], ["0.01", "0.03", "0.1", "0.3", "1", "3"])
"""Ticks of a logarithmic axis of errors in metres."""


@style()
def figure_segment_errors(results: Sequence[Result]) -> Figure:
    """A row for each noise: the trajectories (left), the distance to the truth with and without correction (right).

    ``results`` hold one flight under any noises, each with the correction ``none`` among others. The dashed line and
    the grey band are the report's usual and largest corrected error.
    """
    noises = list(dict.fromkeys(result.settings.noise_name for result in results))
    flight = results[0].settings.flight.trajectory
    report = REPORT_SEGMENT_ODOMETRY[flight]
    figure = Figure(figsize=(11, 4.6 * len(noises)))
    grid = figure.add_gridspec(len(noises), 2, width_ratios=(1, 1.7))
    for row, noise in enumerate(noises):
        of_noise = [result for result in results if result.settings.noise_name == noise]
        best = of_noise[-1]
        truth, tower = best.truth.trajectory, best.truth.tower
        scene = figure.add_subplot(grid[row, 0], projection="3d")
        draw_bars(scene, tower.axes, colors="#bbbbbb", linewidths=0.4)
        scene.plot(*best.prior.position.T, color=COLOURS["none"], linewidth=1.0, label="Noisy")
        scene.plot(*truth.position.T, color=COLOURS["truth"], linewidth=1.4, label="Truth")
        adjusted = COLOURS[best.settings.odometry.method]
        scene.plot(*best.corrected.position.T, color=adjusted, linewidth=1.0, label="Adjust")
        frame_3d(scene, np.concatenate([tower.vertices, truth.position, best.prior.position]), -50, zoom=1.1)
        scene.legend(loc="upper left", bbox_to_anchor=(-0.15, 1.0), fontsize=10)

        curve = figure.add_subplot(grid[row, 1])
        _draw_errors(curve, {_with_numbers(result): result for result in of_noise})
        curve.axhline(report["mean_m"], color=COLOURS["report"], linestyle="--", linewidth=1.2)
        label = f"report: about {report['mean_m']} m, max {report['max_m']} m"
        curve.axhspan(0, report["max_m"], color=COLOURS["report"], alpha=0.12, linewidth=0, label=label)
        curve.set(ylabel="distance to the truth (m)", ylim=(0, 1.45 * curve.get_ylim()[1]))
        curve.set_title(f"{flight} flight, {noise}, sensor {best.settings.sensor}, seed {best.settings.seed}")
        curve.legend(loc="upper left", fontsize=10)
    return figure


def _with_numbers(result: Result) -> str:
    """Name of a method with the mean and the largest of its error."""
    error = position_error_m(result.corrected, result.truth.trajectory)
    return f"{LABELS[result.settings.odometry.method]}: mean {error.mean():.3f} m, max {error.max():.3f} m"


def _draw_errors(panel: Axes, results: Mapping[str, Result], **look: Any) -> None:
    """Draw the distance to the truth of some runs, by label, over the scans."""
    for label, result in results.items():
        error = position_error_m(result.corrected, result.truth.trajectory)
        panel.plot(error, color=COLOURS[result.settings.odometry.method], label=label, **look)
    panel.set(xlabel=f"ToF scan ({result.settings.tof.rate_hz:g} Hz)", xlim=(0, len(error) - 1))


@style()
def figure_cloud_errors(results: Sequence[Result]) -> Figure:
    """Rows of methods × columns of flights: the distance to the truth over the scans, raw and corrected.

    ``results`` hold one noise and sensor. The grey band is the range that the report's figure shows; the vertical axis
    ends a little above what is corrected, so the raw drift may leave the panel.
    """
    cases = {(result.settings.odometry.method, result.settings.flight.trajectory): result for result in results}
    methods = list(dict.fromkeys(str(method) for method, _ in cases))
    flights = [name for name in FLIGHTS if any(name == flight for _, flight in cases)]
    settings = results[0].settings
    report = REPORT_CLOUD_ODOMETRY.get(settings.noise_name, {})
    figure = Figure(figsize=(5.4 * len(flights) + 0.4, 2.6 * len(methods) + 1.0))
    panels = figure.subplots(len(methods), len(flights), squeeze=False)
    for (row, column), panel in np.ndenumerate(panels):
        method, flight = methods[row], flights[column]
        result = cases[method, flight]  # type: ignore[index]
        raw, error = (position_error_m(path, result.truth.trajectory) for path in (result.prior, result.corrected))
        shown = report.get(method, {}).get(flight)
        if shown:
            panel.axhspan(*shown, color=COLOURS["report"], alpha=0.18, linewidth=0)
        panel.plot(raw, color=COLOURS["none"], linewidth=1.2)
        panel.plot(error, color=COLOURS[method], linewidth=1.8)
        top = max(error.max(), shown[1] if shown else 0.0, min(raw.max(), 1.0))
        panel.set(xlim=(0, len(error) - 1), ylim=(0, 1.12 * top))
        numbers = f"mean {error.mean():.2f} m, max {error.max():.2f} m"
        panel.set_title(f"{LABELS[method]}, {FLIGHTS[flight]}: {numbers}", fontsize=11)
    for panel in panels[:, 0]:
        panel.set_ylabel("error (m)")
    for panel in panels[-1]:
        panel.set_xlabel(f"ToF scan ({settings.tof.rate_hz:g} Hz)")
    keys: dict[str, dict[str, Any]] = {"raw": {"color": COLOURS["none"]}}
    keys |= {LABELS[method]: {"color": COLOURS[method], "lw": 2} for method in methods}
    if report:
        keys["report's figure"] = {"facecolor": COLOURS["report"], "edgecolor": COLOURS["report"], "alpha": 0.3}
    draw_legend(figure, keys)
    figure.suptitle(f"{settings.noise_name}, sensor {settings.sensor}, seed {settings.seed}", fontsize=13)
    return figure


@style()
def figure_methods(rows: pd.DataFrame) -> Figure:
    """Mean (dot) to largest (bar's end) error of every method and kind of map, a panel for each flight and noise.

    ``rows`` are those of `batch.cloud_table`. The dashed line is the root mean square of the raw drift.
    """
    groups = list(rows.groupby(["trajectory", "noise"], sort=False))
    kinds = dict.fromkeys(zip(rows["method"], rows["map"], strict=True))
    names = sorted(kinds, key=lambda name: list(LABELS).index(name[0]))
    figure = Figure(figsize=(5.2 * len(groups) + 2.2, 0.42 * len(names) + 1.9))
    panels = figure.subplots(1, len(groups), squeeze=False, sharey=True)[0]
    for panel, ((flight, noise), group) in zip(panels, groups, strict=True):
        place = [names.index(name) for name in zip(group["method"], group["map"], strict=True)]
        colours = [COLOURS[name] for name in group["method"]]
        panel.hlines(place, group["error_mean_m"], group["error_max_m"], colors=colours, linewidth=3, alpha=0.45)
        panel.scatter(group["error_mean_m"], place, s=64, c=colours, zorder=3)
        panel.axvline(group["raw_ate_rmse_m"].iloc[0], color=COLOURS["none"], linestyle="--", linewidth=1.2)
        panel.set(xscale="log", xlabel="error (m): dot mean, bar to the largest", title=f"{flight}, {noise}")
        panel.set_xticks(*DECADES)
        panel.set_xlim(min(0.012, 0.8 * rows["error_mean_m"].min()), 1.3 * rows["error_max_m"].max())
        panel.minorticks_off()
    panels[0].set_yticks(range(len(names)), [f"{LABELS[m]}\n{kind} map" for m, kind in names], fontsize=9)
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    draw_legend(figure, {"raw drift (RMS)": {"color": COLOURS["none"], "ls": "--"}})
    return figure


@style()
def figure_error_curves(results: Sequence[Result]) -> Figure:
    """The error of every method over the scans, a panel for each flight, dashed for corrections by segments.

    Logarithmic, since methods differ tenfold.
    """
    flights = list(dict.fromkeys(result.settings.flight.trajectory for result in results))
    figure = Figure(figsize=(5.6 * len(flights) + 0.4, 5.4))
    panels = figure.subplots(1, len(flights), squeeze=False, sharey=True)[0]
    for panel, flight in zip(panels, flights, strict=True):
        of_flight = [result for result in results if result.settings.flight.trajectory == flight]
        raw = position_error_m(of_flight[0].prior, of_flight[0].truth.trajectory)
        panel.plot(raw, color=COLOURS["truth"], linestyle=":", label="raw")
        for result in of_flight:
            method = result.settings.odometry.method
            _draw_errors(panel, {LABELS[method]: result}, lw=1.1, ls="--" if method in SEGMENT_METHODS else "-")
        panel.set(yscale="log", title=f"{flight} flight", ylim=(5e-3, None))
        panel.set_yticks(*DECADES)
    panels[0].set_ylabel("error (m)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    return figure


@style()
def figure_comparison(clouds: Mapping[str, tuple[Array, Array]]) -> Figure:
    """Built (green) over true cloud (orange) from the front and from the side, for each label."""
    everything = np.concatenate([cloud for pair in clouds.values() for cloud in pair])
    low, high = np.quantile(everything, [0.0005, 0.9995], axis=0)
    low, high = low - 0.4, high + 0.4
    wide = (high - low)[:2]
    scale = min(6.0 / (high - low)[2], (14.0 / len(clouds) - 0.9) / wide.sum(), 5.0 / wide.sum())
    figure = Figure(figsize=(len(clouds) * (wide.sum() * scale + 0.9) + 0.4, (high - low)[2] * scale + 1.5))
    frames = figure.subfigures(1, len(clouds), squeeze=False)[0]
    for frame, (label, (built, true)) in zip(frames, clouds.items(), strict=True):
        panels = frame.subplots(1, 2, sharey=True, width_ratios=wide)
        for across, panel in enumerate(panels):
            _draw_clouds(panel, built, true, across)
            panel.set(xlim=(low[across], high[across]), ylim=(low[2], high[2]))
        panels[0].set_ylabel("z (m)")
        panels[0].set_title(label, loc="left")
    _draw_cloud_legend(figure)
    return figure


@style()
def figure_slip(
    results: Mapping[str, Result], clouds: Mapping[str, tuple[Array, Array]], scan: int, reach_m: float = 2.2
) -> Figure:
    """The error over the scans (left) and, for each label, the built over the true cloud around where the drone was at
    ``scan`` (right)."""
    first = next(iter(results.values()))
    drone = first.truth.trajectory.at(first.corrected.stamp_s).position[scan]
    cloud = next(iter(clouds.values()))[1]
    centre = np.median(cloud[np.linalg.norm(cloud - drone, axis=1) < 2 * reach_m], axis=0)
    figure = Figure(figsize=(5.6 + 4.2 * len(clouds), 5.2))
    curve, *panels = figure.subplots(1, 1 + len(clouds), width_ratios=[1.35, *[1.0] * len(clouds)])
    _draw_errors(curve, results)
    curve.axvline(scan, color=COLOURS["report"], linewidth=1.0)
    for gap in first.settings.tof.blind_s:
        curve.axvspan(*np.array(gap) * first.settings.tof.rate_hz, color=COLOURS["report"], alpha=0.2, lw=0)
    curve.set(ylabel="error (m)", ylim=(0, 1.35 * curve.get_ylim()[1]))
    curve.legend(loc="upper left", fontsize=10)
    for panel, (label, (built, true)) in zip(panels, clouds.items(), strict=True):
        near = (np.abs(true - centre)[:, [0, 2]] < 1.3 * reach_m).all(axis=1)
        _draw_clouds(panel, built[near], true[near], 0, size=2.0)
        panel.set(xlim=centre[0] + reach_m * np.array([-1, 1]), ylim=centre[2] + reach_m * np.array([-1, 1]))
        panel.set(title=label, ylabel="z (m)")
    _draw_cloud_legend(figure)
    return figure


def _draw_clouds(panel: Axes, built: Array, true: Array, across: int, size: float = 0.35) -> None:
    """The built cloud (green) over the true one (orange), seen along a horizontal axis."""
    for cloud, colour in ((true, COLOURS["true cloud"]), (built, COLOURS["built"])):
        shown = thinned(cloud, POINTS_MAX)
        panel.scatter(shown[:, across], shown[:, 2], s=size, c=colour, linewidths=0, rasterized=True)
    panel.set(aspect="equal", xlabel=f"{'xy'[across]} (m)")
    panel.grid(alpha=0.2)


def _draw_cloud_legend(figure: Figure) -> None:
    """The legend of `_draw_clouds`."""
    labels = {"built": "built at the estimated poses", "true cloud": "at the true poses"}
    looks = {label: {"color": COLOURS[name], "marker": "o", "ls": "", "ms": 6} for name, label in labels.items()}
    draw_legend(figure, looks)


@style()
def figure_bend(bends: Mapping[str, Bend], axis: Array) -> Figure:
    """Tilt, turn and offset of each method's cloud against height; the offset is that of a vertical ``axis``."""
    figure = Figure(figsize=(11, 5.2))
    panels = figure.subplots(1, 3, sharey=True)
    for method, fit in bends.items():
        offset = np.linalg.norm(fit.offset_m(axis), axis=1)
        for panel, values in zip(panels, (fit.tilt_deg, fit.yaw_deg, offset), strict=True):
            panel.plot(values, fit.height_m, "o-", color=COLOURS[method], markersize=4, label=LABELS[method])
    panels[0].set(xlabel="tilt of the vertical (°)", ylabel="height (m)", xlim=(0, None), ylim=(0, None))
    panels[1].set(xlabel="turn about the vertical (°)")
    panels[2].set(xlabel="offset (m)", xlim=(0, None))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(bends))
    return figure
