"""Notebooks 02 to 06: figures of odometries (3.2, 3.3, 3.5–3.10, 5.2, 5.3): errors, methods side by side, clouds."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator

from steelnb.experiment import Result
from steelnb.metrics import Bend, position_error_m
from steelnb.report.batch import REPORT_CLOUD_ODOMETRY, REPORT_SEGMENT_ODOMETRY, caption
from steelnb.report.style import (
    BLACK,
    COLOURS,
    GREY,
    LABELS,
    REPORT_BAND,
    Figure,
    draw_bars,
    draw_legend,
    draw_paths,
    gather_legend,
    style,
    thinned,
)
from steelnb.settings import SEGMENT_METHODS
from steelnb.types import Array

POINTS_MAX = 60_000
DECADES = ([0.01, 0.03, 0.1, 0.3, 1, 3], ["0.01", "0.03", "0.1", "0.3", "1", "3"])
"""Ticks of a logarithmic axis of errors in metres."""
ERROR_MIN_M = 0.005
"""Where a logarithmic axis of errors begins, as errors do at zero."""
REPORT_FIGURES = {
    "random-walk": {"icp": "3.7", "icp-3dof": "3.8", "gicp": "3.9"},
    "random-walk+yaw-random-walk": {"gicp": "5.2, 5.3"},
}
"""The report's figures of clouds: noise → method → number."""
SMOOTHED_S, REACH_M = 10.0, 2.2
Range = tuple[float, float]


@style()
def figure_segment_errors(results: Sequence[Result]) -> Figure:
    """A row for each noise: the trajectories (left), the distance to the truth with and without correction (right).

    ``results`` hold one flight under any noises, each with the correction ``none`` among others. Trajectories are the
    true one, the drifting one and that of the last correction.
    """
    noises = list(dict.fromkeys(result.settings.noise_name for result in results))
    report = REPORT_SEGMENT_ODOMETRY[results[0].settings.flight.trajectory]
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
        label = f"report: up to {report['max_m']} m"
        _draw_report(curve, (0.0, report["max_m"]), (report["raw_final_m"],) * 2, label)
        usual = f"report: about {report['mean_m']} m"
        curve.axhline(report["mean_m"], color=COLOURS["report"], linestyle="--", linewidth=1.2, label=usual)
        curve.plot([], [], color=COLOURS["truth"], label="true path (left)")
        curve.set(ylabel="distance to the truth (m)", title=caption(of_noise), xlabel=_scans(last))
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


def _scans(result: Result) -> str:
    return f"ToF scan ({result.settings.tof.rate_hz:g} Hz)"


def _draw_errors(panel: Axes, results: Mapping[str, Result]) -> None:
    """Draw the distance to the truth of some runs, by label, over the scans."""
    for label, result in results.items():
        error = position_error_m(result.corrected, result.truth.trajectory)
        panel.plot(error, color=COLOURS[result.settings.odometry.method], label=label)
    panel.set(xlim=(0, len(error) - 1))


def _draw_report(panel: Axes, shown: Range | None, raw_end: Range | None, label: str) -> None:
    """Draw what the report shows behind errors, whose axis turns logarithmic: the range of its corrected error as a
    band, and at the right edge that of the drift at its end."""
    if shown:
        panel.axhspan(max(shown[0], 0.1 * ERROR_MIN_M), shown[1], **REPORT_BAND, label=label)
    if raw_end:
        look: dict[str, Any] = {"color": COLOURS["none"], "marker": "D", "ms": 7, "mec": "white", "clip_on": False}
        place = panel.get_xlim()[1]
        panel.plot([place, place], raw_end, lw=2.5, zorder=5, label="report: drift at the end", **look)
    panel.set(yscale="log")
    panel.set_yticks(*DECADES)
    panel.minorticks_off()
    panel.set_ylim(ERROR_MIN_M, 6.0)


@style()
def figure_cloud_errors(results: Sequence[Result], methods: Sequence[str]) -> Figure:
    """Rows of methods × columns of flights, all with the same axes: the distance to the truth over the scans, raw and
    corrected. ``results`` hold one noise and sensor; drawn is the first of each of the ``methods`` and flight. The grey
    band is the range that the report's figure shows."""
    cases: dict[tuple[str, str], Result] = {}
    for result in results:
        cases.setdefault((result.settings.odometry.method, result.settings.flight.trajectory), result)
    flights = list(dict.fromkeys(flight for _, flight in cases))
    report = REPORT_CLOUD_ODOMETRY.get(results[0].settings.noise_name, {})
    figure = Figure(figsize=(5.4 * len(flights) + 0.4, 2.6 * len(methods) + 1.0))
    panels = figure.subplots(len(methods), len(flights), squeeze=False, sharex="col", sharey=True)
    for (row, column), panel in np.ndenumerate(panels):
        method, flight = methods[row], flights[column]
        result = cases[method, flight]
        raw, error = (position_error_m(path, result.truth.trajectory) for path in (result.prior, result.corrected))
        panel.plot(raw, color=COLOURS["none"], linewidth=1.2, label=LABELS["none"])
        panel.plot(error, color=COLOURS[method], linewidth=1.8, label=LABELS[method])
        panel.set(xlim=(0, len(error) - 1), ylabel="error (m)", xlabel=_scans(result))
        shown, raw_end = (report.get(name, {}).get(flight) for name in (method, "none"))
        _draw_report(panel, shown, raw_end, "report: corrected error")
        panel.set_title(f"{LABELS[method]}, {flight}: mean {error.mean():.2f} m, max {error.max():.2f} m", fontsize=11)
        panel.label_outer()
    gather_legend(figure, ncols=3)
    figure.suptitle(caption(results))
    return figure


@style()
def figure_methods(rows: pd.DataFrame) -> Figure:
    """Mean (dot) to largest (bar's end) error of every method and kind of map, a panel for each flight and noise.

    ``rows`` are those of `batch.cloud_table`. The dashed line is the root mean square of the raw drift.
    """
    groups = list(rows.groupby(["trajectory", "noise"], sort=False))
    kinds = dict.fromkeys(zip(rows["method"], rows["map"], strict=True))
    names = sorted(kinds, key=lambda name: list(LABELS).index(name[0]))
    figure = Figure(figsize=(5.2 * len(groups) + 2.2, 0.42 * len(names) + 2.2))
    panels = figure.subplots(1, len(groups), squeeze=False, sharey=True)[0]
    for panel, ((flight, noise), group) in zip(panels, groups, strict=True):
        place = [names.index(name) for name in zip(group["method"], group["map"], strict=True)]
        colours = [COLOURS[name] for name in group["method"]]
        panel.hlines(place, group["error_mean_m"], group["error_max_m"], colors=colours, linewidth=3, alpha=0.45)
        panel.scatter(group["error_mean_m"], place, s=64, c=colours, zorder=3)
        panel.axvline(group["raw_ate_rmse_m"].iloc[0], color=COLOURS["none"], linestyle="--", linewidth=1.2)
        panel.set(xscale="log", xlabel="error (m)", title=f"{flight}, {noise}")
        panel.set_xticks(*DECADES)
        largest_m = rows[["error_max_m", "raw_ate_rmse_m"]].to_numpy().max()
        panel.set_xlim(min(0.012, 0.8 * rows["error_mean_m"].min()), 1.3 * largest_m)
        panel.minorticks_off()
    panels[0].set_yticks(range(len(names)), [f"{LABELS[m]}\n{kind} map" for m, kind in names], fontsize=9)
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    keys: dict[str, dict[str, Any]] = {
        "mean": {"color": GREY, "marker": "o", "ls": "", "ms": 8},
        "up to the largest": {"color": GREY, "lw": 3, "alpha": 0.45},
        "drift without correction, RMS": {"color": COLOURS["none"], "ls": "--"},
    }
    draw_legend(figure, keys)
    figure.suptitle(caption(rows))
    return figure


@style()
def figure_error_curves(results: Sequence[Result]) -> Figure:
    """The error of every method over the scans as a running root mean square: a column for each flight, corrections by
    segments above, by clouds below, and ``combined``, by both, in both rows.

    Logarithmic, since methods differ tenfold; all panels have the same axes.
    """
    flights = list(dict.fromkeys(result.settings.flight.trajectory for result in results))
    figure = Figure(figsize=(5.6 * len(flights) + 0.4, 8.0))
    panels = figure.subplots(2, len(flights), squeeze=False, sharex="col", sharey=True)
    for (row, column), panel in np.ndenumerate(panels):
        of_flight = [result for result in results if result.settings.flight.trajectory == flights[column]]
        shown = {"none": of_flight[0].prior}
        for result in of_flight:
            method = result.settings.odometry.method
            if method == "combined" or (method in SEGMENT_METHODS) == (row == 0):
                shown[method] = result.corrected
        for method, path in shown.items():
            square = pd.Series(position_error_m(path, of_flight[0].truth.trajectory) ** 2)
            window = round(SMOOTHED_S * of_flight[0].settings.tof.rate_hz)
            rms = np.sqrt(square.rolling(window, center=True, min_periods=1).mean())
            panel.plot(rms, color=COLOURS[method], linestyle="--" if method == "none" else "-", label=LABELS[method])
        panel.set_xlim(0, len(square) - 1)
        panel.set(xlabel=_scans(of_flight[0]), ylabel=f"error (m), RMS over {SMOOTHED_S:g} s")
        panel.set(
            yscale="log", title=f"{flights[column]} flight, by {('segments', 'clouds')[row]}", ylim=(ERROR_MIN_M, None)
        )
        panel.set_yticks(*DECADES)
        panel.label_outer()
    gather_legend(figure, ncols=4)
    figure.suptitle(caption(results))
    return figure


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
    gather_legend(figure, ncols=len(clouds) + 1)
    return figure


@style()
def figure_slip(results: Mapping[str, Result], clouds: Mapping[str, tuple[Array, Array]], scan: int) -> Figure:
    """The error over the scans (left) and, for each label, the built and the true cloud around where the drone was at
    ``scan`` (right)."""
    first = next(iter(results.values()))
    drone = first.truth.trajectory.at(first.corrected.stamp_s).position[scan]
    cloud = next(iter(clouds.values()))[1]
    centre = np.median(cloud[np.linalg.norm(cloud - drone, axis=1) < 2 * REACH_M], axis=0)
    figure = Figure(figsize=(5.6 + 4.2 * len(clouds), 5.6))
    curve, *panels = figure.subplots(1, 1 + len(clouds), width_ratios=[1.35, *[1.0] * len(clouds)])
    _draw_errors(curve, results)
    curve.axvline(scan, color=BLACK, linewidth=1.0, linestyle=":", label="largest slip")
    for k, gap in enumerate(first.settings.tof.blind_s):
        label = "no sight of the tower" if k == 0 else None
        span = np.array(gap) * first.settings.tof.rate_hz
        curve.axvspan(*span, color=COLOURS["report"], alpha=0.2, lw=0, label=label)
    curve.set(xlabel=_scans(first), ylabel="error (m)", ylim=(0, 1.45 * curve.get_ylim()[1]))
    for panel, (label, (built, true)) in zip(panels, clouds.items(), strict=True):
        near = (np.abs(true - centre)[:, [0, 2]] < 1.3 * REACH_M).all(axis=1)
        _draw_clouds(panel, built[near], true[near], results[label].settings.odometry.method, 0, size=2.0)
        panel.set(xlim=centre[0] + REACH_M * np.array([-1, 1]), ylim=centre[2] + REACH_M * np.array([-1, 1]))
        panel.set(title=label, ylabel="z (m)")
    gather_legend(figure, ncols=4)
    figure.suptitle(caption([first]))
    return figure


def _draw_clouds(panel: Axes, built: Array, true: Array, method: str, across: int, size: float = 0.35) -> None:
    """The cloud built with a method and the true one, seen along a horizontal axis, their points mixed."""
    clouds = {"truth": thinned(true, POINTS_MAX), method: thinned(built, POINTS_MAX)}
    points = np.concatenate(list(clouds.values()))
    colours = np.repeat([COLOURS[name] for name in clouds], [len(cloud) for cloud in clouds.values()])
    order = np.random.default_rng(0).permutation(len(points))  # neither cloud hides the other
    panel.scatter(points[order, across], points[order, 2], s=size, c=colours[order], linewidths=0, rasterized=True)
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
    for panel in panels:
        panel.minorticks_off()
        panel.xaxis.set_major_formatter("{x:g}")
        if panel.get_xscale() == "log":  # beyond three decades the labels of every half would run into each other
            wide = np.ptp(np.log10(panel.get_xlim())) > 3
            panel.xaxis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 3.0)))
    gather_legend(figure, ncols=len(bends))
    figure.suptitle(caption([result]))
    return figure
