"""Notebooks 02 and 12: why the error of Figure 3.2 climbs above the waist, and for which towers it does not."""

import re
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.patches import Rectangle

from steelnb.batch import caption, case_of, plot_of, report_curve, report_range
from steelnb.experiment import Result
from steelnb.fusion import associate
from steelnb.metrics import position_error_m
from steelnb.metrics.matching import match_members
from steelnb.odometry.segments import segments_in
from steelnb.plots import COLOURS, GREY, LABELS, Figure, draw_grid, draw_legend, gather_legend, style
from steelnb.points import preprocess_scan
from steelnb.settings import SegmentSettings
from steelnb.types import Flight

KINDS = ("leg", "ring", "bracing", "arm", "secondary")
ANGLE_MAX_RAD, DISTANCE_MAX_M = 0.26, 0.2
"""A segment of one noisy scan, whose points lie on the near faces, belongs to the member within these."""
WINDOW_S = 10.0
AXES = {"waist": "tower.waist_width_m", "standoff": "flight.standoff_m", "crop": "preprocess.crop_m"}


def pairs_of(run: Result, flight: Flight, every: int = 5) -> pd.DataFrame:
    """The pairs of segment and mapped bar of every so many scans, a row a pair: ``time_s``, the ``kind`` of the member
    that the segment lies on (at the true pose), and whether that is the member of the mapped ``bar``, ``same``.

    A bar of the map belongs to the member of the first segment that is paired with it.
    """
    settings, tower = run.settings.odometry, run.truth.tower
    if not isinstance(settings, SegmentSettings):
        raise ValueError(f"method {settings.method!r}: expected one that finds bars")
    true = run.truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    rows = []
    for k in range(0, len(flight.scans), every):
        T_world_drone = run.corrected.T_world_drone[k]
        points = preprocess_scan(flight.scans[k], T_world_drone, flight.T_drone_sensor, settings.preprocess)
        seen = segments_in(points, settings.hough)
        member = match_members(seen.transformed(true[k]), tower.axes, ANGLE_MAX_RAD, DISTANCE_MAX_M).member
        bar = associate(seen.transformed(T_world_drone), run.segments, settings.fusion)
        found = (member >= 0) & (bar >= 0)
        rows += [(flight.prior.stamp_s[k], m, b) for m, b in zip(member[found], bar[found], strict=True)]
    pairs = pd.DataFrame(rows, columns=["time_s", "member", "bar"])
    kinds = np.array([member.kind for member in tower.members])
    first = pairs.groupby("bar")["member"].transform("first")
    return pairs.assign(kind=kinds[pairs["member"]], same=pairs["member"] == first)


def waist_s(run: Result) -> float:
    """The last time at which the drone is below the waist of the tower, the end of the flight if it never passes it."""
    below = run.truth.trajectory.position[:, 2] < run.settings.tower.waist_height_m
    return float(run.truth.trajectory.stamp_s[below][-1]) if below.any() else 0.0


@style()
def figure_waist(run: Result, pairs: pd.DataFrame, every: int = 5) -> Figure:
    """The error over time, and below it the pairs a scan by kind of member, and those on another member: means over
    10 s. A line marks the waist."""
    figure = Figure(figsize=(9, 6.2))
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=[1.2, 1])
    stamps = run.corrected.stamp_s
    top.plot(
        stamps, position_error_m(run.prior, run.truth.trajectory), color=COLOURS["none"], ls="--", label=LABELS["none"]
    )
    error, method = position_error_m(run.corrected, run.truth.trajectory), run.settings.odometry.method
    top.plot(stamps, error, color=COLOURS[method], label=LABELS[method])
    if plot := plot_of(run.settings):
        top.plot(*report_curve(plot), color=COLOURS["report"], linewidth=1.0, label="the report's curve")
    top.set(ylabel="error (m)", ylim=(0, 1.3 * error.max()))
    edges = np.arange(0.0, stamps[-1] + WINDOW_S, WINDOW_S)
    scans = np.histogram(stamps[::every], edges)[0]
    middle = 0.5 * (edges[1:] + edges[:-1])
    bottom = np.zeros(len(middle))
    for kind in KINDS:
        mean = np.histogram(pairs.loc[pairs["kind"] == kind, "time_s"], edges)[0] / np.maximum(scans, 1)
        below.bar(middle, mean, 0.9 * WINDOW_S, bottom=bottom, color=COLOURS[kind], label=kind)
        bottom += mean
    other = np.histogram(pairs.loc[~pairs["same"], "time_s"], edges)[0] / np.maximum(scans, 1)
    look = {"color": COLOURS["wrong"], "mec": "white", "ms": 7, "lw": 2.4}
    below.plot(middle, other, "o-", label="on another member", **look)
    below.set(xlabel="time (s)", ylabel="pairs a scan", xlim=(0, stamps[-1]))
    for panel in (top, below):
        if run.settings.tower.members is None and waist_s(run) < stamps[-1]:
            panel.axvline(waist_s(run), color=GREY, linewidth=1.2, linestyle=":", label="the waist")
    gather_legend(figure, ncols=5, fontsize=10)
    figure.suptitle(caption(pd.DataFrame([case_of(run.settings)])))
    return figure


def sweep_rows(runs: pd.DataFrame) -> pd.DataFrame:
    """Mean over the seeds of the largest error of the runs of a study whose variants name all of `AXES`: a row a
    combination, with ``waist``, ``standoff``, ``crop``, ``error_max_m`` and ``seeds``."""
    values = {}
    for name, setting in AXES.items():
        values[name] = runs["variant"].str.extract(rf"{re.escape(setting)}=([\d.]+)")[0].astype(float)
    chosen = runs.assign(**values).dropna(subset=list(AXES))
    named = {"error_max_m": ("error_max_m", "mean"), "seeds": ("seed", "nunique")}
    return chosen[chosen["status"] == "ok"].groupby(list(AXES)).agg(**named).reset_index()


@style()
def figure_sweep(rows: pd.DataFrame, runs: pd.DataFrame, limit_m: float | None = None) -> Figure:
    """Largest error over width at the waist and stand-off, a panel a crop; what is within ``limit_m``, default the
    largest of the report's Figure 3.2, is framed."""
    limit_m = limit_m or (report_range("constant-drift", "average", "vertical") or (0.0, 0.0))[1]
    crops = sorted(rows["crop"].unique())
    figure = Figure(figsize=(4.2 * len(crops) + 1.6, 4.4))
    panels = figure.subplots(1, len(crops), squeeze=False, sharey=True)[0]
    frame: dict[str, Any] = {"fc": "none", "ec": COLOURS["wrong"], "linewidth": 3}
    for panel, crop in zip(panels, crops, strict=True):
        grid = rows[rows["crop"] == crop].pivot(index="standoff", columns="waist", values="error_max_m")
        image = draw_grid(panel, grid, (0, rows["error_max_m"].max()), "viridis_r")
        for row, column in np.argwhere(grid.to_numpy() <= limit_m):
            panel.add_patch(Rectangle((column - 0.46, row - 0.46), 0.92, 0.92, **frame))
        panel.set(xlabel="width at the waist (m)", title=f"crop at {crop:g} m")
    panels[0].set_ylabel("stand-off (m)")
    figure.colorbar(image, ax=list(panels), label="largest error (m), mean of the seeds")
    draw_legend(figure, {f"within the report's {limit_m:g} m": frame})
    figure.suptitle(caption(runs))
    return figure
