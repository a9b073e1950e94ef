"""Notebooks 03, 04 and 06: tables and figures (3.5–3.9, 5.2–5.3) of the odometry by clouds and the clouds it builds."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from steelnb.experiment import Result
from steelnb.metrics import Bend, position_error_m
from steelnb.report.batch import case_of
from steelnb.report.style import COLOURS, LABELS, Figure, draw_legend, style, thinned
from steelnb.settings import SEGMENT_METHODS, ExperimentSettings
from steelnb.types import Array

REPORT_CLOUD_ODOMETRY: dict[str, dict[str, dict[str, tuple[float, float]]]] = {
    "random-walk": {
        "none": {"orbit": (0.7, 0.8), "vertical": (0.7, 0.8)},
        "icp": {"orbit": (0.1, 0.3), "vertical": (0.0, 1.0)},
        "icp-3dof": {"orbit": (0.0, 0.85), "vertical": (0.02, 0.35)},
        "gicp": {"orbit": (0.25, 0.54), "vertical": (0.10, 0.25)},
    },
    "constant-drift": {
        "none": {"orbit": (2.5, 4.6), "vertical": (2.5, 4.6)},
        "icp": {"orbit": (0.1, 0.85), "vertical": (0.0, 1.5)},
        "icp-3dof": {"orbit": (0.3, 0.4), "vertical": (0.1, 0.5)},
        "gicp": {"orbit": (0.25, 0.4), "vertical": (0.0, 0.1)},
    },
}
"""Figures 3.5 and 3.6: noise → method → flight → range (m) of the corrected error; for ``none``, the drift's end."""
REPORT_TIME_RATIO = 3.0
"""Section 3.3.3: GICP is "nearly three times more time-consuming"."""
POINTS_MAX = 60_000
FLIGHTS = {"orbit": "around", "vertical": "vertical"}
"""The report's names of the flights, in the order of its columns."""
DECADES = ([0.01, 0.03, 0.1, 0.3, 1, 3], ["0.01", "0.03", "0.1", "0.3", "1", "3"])
"""Ticks of a logarithmic axis of errors in metres."""


def ranking(rows: pd.DataFrame, methods: Sequence[str], by: str = "error_mean_m") -> pd.DataFrame:
    """The order of some methods, a row for each flight and noise.

    ``rows`` has a row a run; columns are the value of each method, ``order`` from best to worst, ``as_claimed``,
    whether each of ``methods`` is better than the one before it, and ``pairs_as_claimed`` of all pairs, 0 to 1.
    """
    chosen = rows[rows["method"].isin(methods)].drop_duplicates(["trajectory", "noise", "method"])
    wide = chosen.pivot_table(index=["trajectory", "noise"], columns="method", values=by, sort=False)[list(methods)]
    pairs = list(itertools.combinations(methods, 2))
    agree = np.mean([wide[later] < wide[earlier] for earlier, later in pairs], axis=0)
    order = [" < ".join(wide.columns[np.argsort(values)]) for values in wide.to_numpy()]
    return wide.assign(order=order, as_claimed=agree == 1.0, pairs_as_claimed=agree).reset_index()


def beside_report(rows: pd.DataFrame, shown: dict[str, dict[str, tuple[float, float]]]) -> pd.DataFrame:
    """The corrected error of each run next to the range (low, high) that a figure of the report shows.

    ``shown`` maps method → flight → range; runs that it does not name are left out, as are repeated ones.
    """
    ranges = [(flight, method, *span) for method, spans in shown.items() for flight, span in spans.items()]
    report = pd.DataFrame(ranges, columns=["trajectory", "method", "report_low_m", "report_high_m"])
    columns = ["trajectory", "noise", "method", "error_mean_m", "error_max_m", "error_final_m"]
    first = rows.drop_duplicates(["trajectory", "noise", "method"])[columns]
    beside = first.merge(report, on=["trajectory", "method"])
    return beside.assign(within_report=beside["error_max_m"] <= beside["report_high_m"])


def time_ratio(times: pd.DataFrame, method: str, to: str) -> pd.DataFrame:
    """Median milliseconds of a frame of two methods and their ratio, a row for each flight and noise."""
    frames = times[times["stage"] == "frame"].drop_duplicates(["trajectory", "noise", "method"])
    wide = frames.pivot_table(index=["trajectory", "noise"], columns="method", values="median_ms", sort=False)
    return wide[[to, method]].assign(ratio=wide[method] / wide[to]).reset_index()


def bend_table(bends: Mapping[str, tuple[ExperimentSettings, Bend]], axis: Array) -> pd.DataFrame:
    """One row a run and slice of height: tilt, turn, offset on the vertical through ``axis``, blur and points."""
    slices = [
        pd.DataFrame(
            {
                **case_of(settings),
                "height_m": fit.height_m,
                "tilt_deg": fit.tilt_deg,
                "yaw_deg": fit.yaw_deg,
                "offset_m": np.linalg.norm(fit.offset_m(axis), axis=1),
                "blur_m": fit.blur_m,
                "points": fit.count,
            }
        )
        for settings, fit in bends.values()
    ]
    return pd.concat(slices, ignore_index=True)


def bend_summary(bends: Mapping[str, Bend], ate_m: Mapping[str, float], axis: Array) -> pd.DataFrame:
    """One row a method: the numbers of `Bend.metrics`, and the error of the trajectory, ``ate_rmse_m``."""
    return pd.DataFrame({name: {**fit.metrics(axis), "ate_rmse_m": ate_m[name]} for name, fit in bends.items()}).T


@style()
def figure_errors(results: Sequence[Result]) -> Figure:
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
    for row, method in enumerate(methods):
        for panel, flight in zip(panels[row], flights, strict=True):
            result = cases[method, flight]  # type: ignore[index]
            raw = position_error_m(result.prior, result.truth.trajectory)
            error = position_error_m(result.corrected, result.truth.trajectory)
            shown = report.get(method, {}).get(flight)
            if shown:
                panel.axhspan(*shown, color=COLOURS["report"], alpha=0.18, linewidth=0)
            panel.plot(raw, color=COLOURS["none"], linewidth=1.2)
            panel.plot(error, color=COLOURS[method], linewidth=1.8)
            top = max(error.max(), shown[1] if shown else 0.0, min(raw.max(), 1.0))
            panel.set(xlim=(0, len(error) - 1), ylim=(0, 1.12 * top))
            numbers = f"mean {error.mean():.2f} m, max {error.max():.2f} m"
            panel.set_title(f"{LABELS[method]}, {FLIGHTS[flight]}: {numbers}", fontsize=11)
            if flight == flights[0]:
                panel.set_ylabel("error (m)")
            if row == len(methods) - 1:
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
        for row in group.to_dict("records"):
            y = names.index((row["method"], row["map"]))
            colour = COLOURS[row["method"]]
            panel.plot([row["error_mean_m"], row["error_max_m"]], [y, y], color=colour, linewidth=3, alpha=0.45)
            panel.plot(row["error_mean_m"], y, "o", color=colour, markersize=8)
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
            error = position_error_m(result.corrected, result.truth.trajectory)
            dash = "--" if method in SEGMENT_METHODS else "-"
            panel.plot(np.maximum(error, 1e-4), dash, color=COLOURS[method], lw=1.1, label=LABELS[method])
        panel.set(yscale="log", xlim=(0, len(raw) - 1), title=f"{flight} flight", ylim=(5e-3, None))
        panel.set_xlabel(f"ToF scan ({of_flight[0].settings.tof.rate_hz:g} Hz)")
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
            draw_clouds(panel, built, true, across)
            panel.set(xlim=(low[across], high[across]), ylim=(low[2], high[2]))
        panels[0].set_ylabel("z (m)")
        panels[0].set_title(label, loc="left")
    draw_cloud_legend(figure)
    return figure


def draw_clouds(panel: Axes, built: Array, true: Array, across: int, size: float = 0.35) -> None:
    """The built cloud (green) over the true one (orange), seen along a horizontal axis."""
    for cloud, colour in ((true, COLOURS["true cloud"]), (built, COLOURS["built"])):
        shown = thinned(cloud, POINTS_MAX)
        panel.scatter(shown[:, across], shown[:, 2], s=size, c=colour, linewidths=0, rasterized=True)
    panel.set(aspect="equal", xlabel=f"{'xy'[across]} (m)")
    panel.grid(alpha=0.2)


def draw_cloud_legend(figure: Figure) -> None:
    """The legend of `draw_clouds`."""
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
