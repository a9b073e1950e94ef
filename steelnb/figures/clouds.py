"""Figures 3.5–3.10 and 5.1–5.3: errors of the odometry by clouds, and the clouds it builds."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from steelnb.config import CORRECTIONS
from steelnb.datatypes import Array
from steelnb.experiment import Result
from steelnb.figures.report import REPORT_CLOUD_ODOMETRY
from steelnb.figures.style import COLOURS, LABELS, Figure, style
from steelnb.metrics import Bend, basin_radius_m, position_error_m
from steelnb.study import RIGHT_M, Basin

MAX_POINTS = 60_000
FLIGHTS = {"orbit": "around", "vertical": "vertical"}
"""The report's names of the flights, in the order of its columns."""


def figure_cloud_errors(results: Sequence[Result]) -> Figure:
    """Rows of methods × columns of flights: the distance to the truth over the scans, raw and corrected.

    ``results`` hold one noise and sensor. The grey band is the range that the report's figure shows; the vertical axis
    ends a little above what is corrected, so the raw drift may leave the panel.
    """
    cases: dict[tuple[str, str], Result] = {
        (result.settings.odometry.method, result.settings.flight.trajectory): result for result in results
    }
    methods = list(dict.fromkeys(method for method, _ in cases))
    flights = [name for name in FLIGHTS if any(name == flight for _, flight in cases)]
    settings = results[0].settings
    report = REPORT_CLOUD_ODOMETRY.get(settings.noise_name, {})
    with style():
        figure = Figure(figsize=(5.4 * len(flights) + 0.4, 2.6 * len(methods) + 1.0))
        panels = figure.subplots(len(methods), len(flights), squeeze=False)
        for row, method in enumerate(methods):
            for panel, flight in zip(panels[row], flights, strict=True):
                result = cases[method, flight]
                raw = position_error_m(result.prior, result.truth.trajectory)
                error = position_error_m(result.corrected, result.truth.trajectory)
                seen = report.get(method, {}).get(flight)
                if seen:
                    panel.axhspan(*seen, color=COLOURS["report"], alpha=0.18, linewidth=0)
                panel.plot(raw, color=COLOURS["none"], linewidth=1.2)
                panel.plot(error, color=COLOURS[method], linewidth=1.8)
                top = max(error.max(), seen[1] if seen else 0.0, min(raw.max(), 1.0))
                panel.set(xlim=(0, len(error) - 1), ylim=(0, 1.12 * top))
                panel.set_title(
                    f"{LABELS[method]}, {FLIGHTS[flight]}: mean {error.mean():.2f} m, max {error.max():.2f} m",
                    fontsize=11,
                )
                if flight == flights[0]:
                    panel.set_ylabel("error (m)")
                if row == len(methods) - 1:
                    panel.set_xlabel(f"ToF scan ({settings.tof.rate_hz:g} Hz)")
        keys: list[Line2D | Patch] = [Line2D([], [], color=COLOURS["none"], label="raw")]
        keys += [Line2D([], [], color=COLOURS[m], lw=2, label=LABELS[m]) for m in methods]
        if report:
            keys.append(Patch(color=COLOURS["report"], alpha=0.3, label="report's figure"))
        figure.legend(handles=keys, loc="outside lower center", ncols=len(keys))
        figure.suptitle(f"{settings.noise_name}, sensor {settings.sensor}, seed {settings.seed}", fontsize=13)
    return figure


def figure_cloud_methods(rows: pd.DataFrame) -> Figure:
    """Mean (dot) to largest (bar's end) error of every method and kind of map, a panel for each flight and noise.

    ``rows`` are those of `steelnb.study.cloud_table`. The dashed line is the mean of the raw drift's root mean square.
    """
    groups = list(rows.groupby(["trajectory", "noise"], sort=False))
    names = sorted(
        dict.fromkeys(zip(rows["method"], rows["map"], strict=True)), key=lambda name: list(LABELS).index(name[0])
    )
    with style():
        figure = Figure(figsize=(5.2 * len(groups) + 2.2, 0.42 * len(names) + 1.9))
        panels = figure.subplots(1, len(groups), squeeze=False, sharey=True)[0]
        for panel, ((flight, noise), group) in zip(panels, groups, strict=True):
            for row in group.to_dict("records"):
                y = names.index((row["method"], row["map"]))
                colour = COLOURS[row["method"]]
                panel.plot([row["error_mean_m"], row["error_max_m"]], [y, y], color=colour, linewidth=3, alpha=0.45)
                panel.plot(row["error_mean_m"], y, "o", color=colour, markersize=8)
            panel.axvline(group["raw_ate_rmse_m"].iloc[0], color=COLOURS["none"], linestyle="--", linewidth=1.2)
            panel.set(xscale="log", xlabel="error (m): dot mean, bar to the largest", title=f"{flight}, {noise}")
            panel.set_xticks([0.01, 0.03, 0.1, 0.3, 1, 3], ["0.01", "0.03", "0.1", "0.3", "1", "3"])
            panel.set_xlim(min(0.012, 0.8 * rows["error_mean_m"].min()), 1.3 * rows["error_max_m"].max())
            panel.minorticks_off()
        panels[0].set_yticks(range(len(names)), [f"{LABELS[m]}\n{kind} map" for m, kind in names], fontsize=9)
        panels[0].set_ylim(len(names) - 0.5, -0.5)
        figure.legend(handles=[Line2D([], [], color=COLOURS["none"], ls="--", label="raw drift (RMS)")],
                      loc="outside lower center")  # fmt: skip
    return figure


def _cloud(panel: Axes, built: Array, true: Array, across: int, size: float = 0.35) -> None:
    """The built cloud (green) over the true one (orange), seen along a horizontal axis."""
    order = np.linspace(0, len(true) - 1, min(len(true), MAX_POINTS)).astype(int)
    for cloud, colour in ((true, COLOURS["true cloud"]), (built, COLOURS["built"])):
        panel.scatter(cloud[order, across], cloud[order, 2], s=size, c=colour, linewidths=0, rasterized=True)
    panel.set(aspect="equal", xlabel=f"{'xy'[across]} (m)")
    panel.grid(alpha=0.2)


def _cloud_keys(figure: Figure) -> None:
    keys = [
        Line2D([], [], color=COLOURS[name], marker="o", ls="", ms=6, label=label)
        for name, label in {"built": "built at the estimated poses", "true cloud": "at the true poses"}.items()
    ]
    figure.legend(handles=keys, loc="outside lower center", ncols=2)


def figure_cloud_comparison(clouds: Mapping[str, tuple[Array, Array]]) -> Figure:
    """Built (green) over true cloud (orange) from the front and from the side, for each label."""
    everything = np.concatenate([cloud for pair in clouds.values() for cloud in pair])
    low, high = np.quantile(everything, [0.0005, 0.9995], axis=0)
    low, high = low - 0.4, high + 0.4
    wide = (high - low)[:2]
    scale = min(6.0 / (high - low)[2], (14.0 / len(clouds) - 0.9) / wide.sum(), 5.0 / wide.sum())
    with style():
        figure = Figure(figsize=(len(clouds) * (wide.sum() * scale + 0.9) + 0.4, (high - low)[2] * scale + 1.5))
        frames = figure.subfigures(1, len(clouds), squeeze=False)[0]
        for frame, (label, (built, true)) in zip(frames, clouds.items(), strict=True):
            panels = frame.subplots(1, 2, sharey=True, width_ratios=wide)
            for across, panel in enumerate(panels):
                _cloud(panel, built, true, across)
                panel.set(xlim=(low[across], high[across]), ylim=(low[2], high[2]))
            panels[0].set_ylabel("z (m)")
            panels[0].set_title(label, loc="left")
        _cloud_keys(figure)
    return figure


def figure_bend(bends: Mapping[str, Bend], axis: Array) -> Figure:
    """Tilt, turn and offset of each method's cloud against height; the offset is that of a vertical ``axis``."""
    with style():
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


def figure_basins(basins: Mapping[str, Basin]) -> Figure:
    """Where each start beside the true pose ends: the final error, a panel for each registration.

    Dark is home, light ended elsewhere or, where it is as light as its start is far, stayed; grey is refused by the
    odometry. The dashed circle is the largest within which every start came home.
    """
    with style():
        figure = Figure(figsize=(4.0 * len(basins) + 0.9, 5.0))
        panels = figure.subplots(1, len(basins), squeeze=False, sharey=True)[0]
        for panel, (label, basin) in zip(panels, basins.items(), strict=True):
            x, z = np.unique(basin.offset_m[:, 0]), np.unique(basin.offset_m[:, 2])
            error = np.where(basin.used, basin.error_m, np.nan).reshape(len(z), len(x))
            image = panel.pcolormesh(x, z, error, cmap="viridis", vmin=0, vmax=1.0, shading="nearest")
            refused = np.where(basin.used, np.nan, 1.0).reshape(len(z), len(x))
            panel.pcolormesh(x, z, refused, cmap=ListedColormap(["#dddddd"]), shading="nearest")
            radius = basin_radius_m(basin.offset_m, basin.right)
            panel.add_patch(Circle((0, 0), radius, fill=False, color="white", linestyle="--", linewidth=1.8))
            panel.plot(0, 0, "+", color="white", markersize=9)
            panel.set(aspect="equal", xlabel="start off along x (m)")
            panel.set_title(
                f"{label}: radius {radius:.2f} m\nwrong {basin.wrong.mean():.0%} (stayed {basin.stayed.mean():.0%})\n"
                f"refused {(~basin.used).mean():.0%}",
                fontsize=11,
            )
            panel.grid(False)
        panels[0].set_ylabel("start off along z (m)")
        bar = figure.colorbar(image, ax=list(panels), shrink=0.75, extend="max")
        bar.set_label(f"error at the end (m); right below {RIGHT_M:g}")
        figure.legend(handles=[Patch(color="#dddddd", label="refused: the odometry keeps the prior"),
                               Line2D([], [], color="#888888", ls="--", label="all starts within come home")],
                      loc="outside lower center", ncols=2)  # fmt: skip
    return figure


def figure_false_convergence(
    results: Mapping[str, Result], clouds: Mapping[str, tuple[Array, Array]], scan: int, reach_m: float = 2.2
) -> Figure:
    """The error over the scans (left) and, for each label, the built over the true cloud around where the drone was at
    ``scan`` (right)."""
    first = next(iter(results.values()))
    truth = first.truth.trajectory
    drone = truth.at(first.corrected.stamp_s).position[scan]
    cloud = next(iter(clouds.values()))[1]
    centre = np.median(cloud[np.linalg.norm(cloud - drone, axis=1) < 2 * reach_m], axis=0)
    with style():
        figure = Figure(figsize=(5.6 + 4.2 * len(clouds), 5.2))
        panels = figure.subplots(1, 1 + len(clouds), width_ratios=[1.35, *[1.0] * len(clouds)])
        curve = panels[0]
        for label, result in results.items():
            error = position_error_m(result.corrected, truth)
            curve.plot(error, color=COLOURS[result.settings.odometry.method], label=label)
        curve.axvline(scan, color=COLOURS["report"], linewidth=1.0)
        for blind in first.settings.tof.blind_s:
            curve.axvspan(*(np.array(blind) * first.settings.tof.rate_hz), color=COLOURS["report"], alpha=0.2, lw=0)
        curve.set(xlabel=f"ToF scan ({first.settings.tof.rate_hz:g} Hz)", ylabel="error (m)", xlim=(0, len(error) - 1))
        curve.set_ylim(0, 1.35 * curve.get_ylim()[1])
        curve.legend(loc="upper left", fontsize=10)
        for panel, (label, (built, true)) in zip(panels[1:], clouds.items(), strict=True):
            near = (np.abs(true - centre)[:, [0, 2]] < 1.3 * reach_m).all(axis=1)
            _cloud(panel, built[near], true[near], 0, size=2.0)
            panel.set(xlim=centre[0] + reach_m * np.array([-1, 1]), ylim=centre[2] + reach_m * np.array([-1, 1]))
            panel.set(title=label, ylabel="z (m)")
        _cloud_keys(figure)
    return figure


def figure_error_curves(results: Sequence[Result]) -> Figure:
    """The error of every method over the scans, a panel for each flight, dashed for corrections by segments.

    Logarithmic, since methods differ tenfold.
    """
    flights = list(dict.fromkeys(result.settings.flight.trajectory for result in results))
    with style():
        figure = Figure(figsize=(5.6 * len(flights) + 0.4, 5.4))
        panels = figure.subplots(1, len(flights), squeeze=False, sharey=True)[0]
        for panel, flight in zip(panels, flights, strict=True):
            of_flight = [result for result in results if result.settings.flight.trajectory == flight]
            raw = position_error_m(of_flight[0].prior, of_flight[0].truth.trajectory)
            panel.plot(raw, color=COLOURS["truth"], linestyle=":", label="raw")
            for result in of_flight:
                method = result.settings.odometry.method
                error = position_error_m(result.corrected, result.truth.trajectory)
                dash = "--" if method in CORRECTIONS else "-"
                panel.plot(np.maximum(error, 1e-4), dash, color=COLOURS[method], lw=1.1, label=LABELS[method])
            panel.set(yscale="log", xlim=(0, len(raw) - 1), title=f"{flight} flight", ylim=(5e-3, None))
            panel.set_xlabel(f"ToF scan ({of_flight[0].settings.tof.rate_hz:g} Hz)")
            panel.set_yticks([0.01, 0.03, 0.1, 0.3, 1, 3], ["0.01", "0.03", "0.1", "0.3", "1", "3"])
        panels[0].set_ylabel("error (m)")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    return figure
