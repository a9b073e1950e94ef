"""Notebook 17: odometries of the literature beside the others, over the flights of a study, and what they match."""

from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.odometry import make_odometry, run
from steelnb.points.features import loam_features, midlines
from steelnb.report.conclusions import bullets
from steelnb.report.style import (
    BLACK,
    BLUE,
    COLOURS,
    GREY,
    LABELS,
    LIGHT_GREY,
    VERMILION,
    Figure,
    draw_bars,
    draw_legend,
    draw_sample,
    frame_perspective,
    project_perspective,
    style,
)
from steelnb.settings import ExperimentSettings, OdometrySettings, TrajectoryName
from steelnb.simulation import Truth
from steelnb.types import Array, Estimate, Flight

METHODS = (
    "average", "least_squares_yaw", "icp", "icp-3dof", "gicp", "kiss-icp", "small-gicp", "deepvo", "orb",
    "orb-monocular", "loam", "loam-midlines", "best", "combined", "combined-camera", "faces", "smoothed",
)  # fmt: skip
"""In the order of the table: by segments, the ICP family, published ones by their own wheels, the literature's, by all
points."""
LOAM = ("loam", "loam-midlines")
LITERATURE = ("kiss-icp", "small-gicp", "deepvo", "orb", "orb-monocular", *LOAM, "combined-camera")
FLIGHTS = ("vertical", "orbit")
SENSORS = {"starling2": "Starling 2", "starling2-honest": "with a real one's faults", "report": "the report's"}
NOISES = {"random-walk": "o", "constant-drift": "^", "random-walk+yaw-random-walk": "s"}
"""Noise → its marker."""
FLOOR_M = OdometrySettings.preset(LOAM[0]).preprocess.floor_m
LOST_SHARE = 0.9
"""An odometry whose error is above this share of the drift's has lost its way."""


def literature_runs(study: pd.DataFrame, sensors: list[str], noises: list[str], methods: list[str]) -> pd.DataFrame:
    """Whole flights without gaps or other settings among the rows of a study, in the order of the three lists."""
    chosen = (study["status"] == "ok") & (study["variant"] == "") & (study["blind"] == "") & (study["duration_s"] > 100)
    axes = {"sensor": sensors, "noise": noises, "method": methods, "trajectory": list(FLIGHTS)}
    for name, wanted in axes.items():
        chosen &= study[name].isin(wanted)
    runs = study[chosen]
    ranks = [runs[name].map(axes[name].index).to_numpy() for name in ("noise", "method", "trajectory", "sensor")]
    return runs.iloc[np.lexsort(np.array([runs["seed"].to_numpy(), *ranks]))]


def literature_table(runs: pd.DataFrame) -> pd.DataFrame:
    """A row for each sensor, flight, noise and method: the number of seeds, mean and worst ATE, and that of the drift,
    metres."""
    groups = runs.groupby(["sensor", "trajectory", "noise", "method"], sort=False)
    return groups.agg(
        seeds=("seed", "count"), ate_mean_m=("ate_rmse_m", "mean"), ate_worst_m=("ate_rmse_m", "max"),
        raw_ate_mean_m=("raw_ate_rmse_m", "mean"),
    ).reset_index()  # fmt: skip


@style()
def figure_literature(runs: pd.DataFrame) -> Figure:
    """ATE of each run on a logarithmic scale: a column for each sensor, a row for each flight, a line of dots for each
    method and a marker for each noise, with their mean; the drift without correction as a band behind."""
    sensors, flights = list(dict.fromkeys(runs["sensor"])), list(dict.fromkeys(runs["trajectory"]))
    methods = [method for method in METHODS if method in set(runs["method"])]
    figure = Figure(figsize=(3.2 + 3.0 * len(sensors), 1.5 + 0.32 * len(methods) * len(flights)))
    grid = figure.subplots(len(flights), len(sensors), sharex=True, sharey=True, squeeze=False)
    for (row, column), panel in np.ndenumerate(grid):
        here = runs[(runs["trajectory"] == flights[row]) & (runs["sensor"] == sensors[column])]
        drift = 1e3 * here["raw_ate_rmse_m"]
        if len(here):
            panel.axvspan(drift.min(), drift.max(), color=LIGHT_GREY, alpha=0.35, linewidth=0)
        for k, method in enumerate(methods):
            own = here[here["method"] == method]
            for noise, marker in NOISES.items():
                values = 1e3 * own.loc[own["noise"] == noise, "ate_rmse_m"].to_numpy()
                if len(values):
                    draw_sample(
                        panel, k, values, COLOURS[method], marker=marker, width=0.5, across=True, ms=4, alpha=0.8
                    )
        panel.set_xscale("log")
        panel.set_yticks(range(len(methods)), [LABELS[method] for method in methods])
        panel.set_ylim(len(methods) - 0.5, -0.5)
        panel.xaxis.set_major_formatter("{x:g}")
        panel.grid(axis="y", visible=False)
        if row == 0:
            panel.set_title(SENSORS.get(sensors[column], sensors[column]))
        if row == len(flights) - 1:
            panel.set_xlabel("ATE (mm)")
        if column == len(sensors) - 1:
            panel.annotate(flights[row], (1.02, 0.5), xycoords="axes fraction", rotation=270, va="center")
    keys: dict[str, dict[str, Any]] = {
        noise.replace("+yaw-random-walk", " + yaw walk"): {"color": GREY, "marker": marker, "ls": ""}
        for noise, marker in NOISES.items() if noise in set(runs["noise"])
    }  # fmt: skip
    keys |= {"mean": {"color": BLACK, "lw": 2.0}, "without correction": {"fc": LIGHT_GREY, "alpha": 0.35}}
    draw_legend(figure, keys, fontsize=10)
    return figure


def fly(
    trajectory: TrajectoryName, noise: str, sensor: str, seed: int, duration_s: float
) -> tuple[Flight, Truth, dict[str, Estimate]]:
    """A flight with a camera, its truth, and what both kinds of LOAM make of it."""
    given: dict[str, Any] = {"sensor": sensor, "seed": seed, "duration_s": duration_s}
    flight, truth = experiment.simulate(ExperimentSettings.preset(trajectory, noise, "orb", **given))
    odometries = {method: ExperimentSettings.preset(trajectory, noise, method, **given).odometry for method in LOAM}
    estimates = {
        method: run(flight, make_odometry(settings, flight.T_drone_sensor, flight.imu))
        for method, settings in odometries.items()
    }
    return flight, truth, estimates


@style()
def figure_features(flight: Flight, truth: Truth, estimates: dict[str, Estimate], scan: int) -> Figure:
    """Above, what each odometry takes from one scan, over its range image; below, the map of each over the tower. What
    lies below `FLOOR_M` is left out, as odometries do."""
    image = flight.scans[scan].points
    T_world_sensor = estimates[LOAM[1]].corrected.T_world_drone[scan] @ flight.T_drone_sensor
    found = loam_features(image)
    taken = {
        "loam": {"edges": (found.point[found.plane == 0], VERMILION), "planes": (found.point[found.plane == 1], BLUE)},
        "loam-midlines": {"midlines": (midlines(image), VERMILION)},
    }
    steel = _above_floor(image.reshape(-1, 3), T_world_sensor)
    figure = Figure(figsize=(3.9 * len(LOAM), 9.2))
    grid = figure.subplots(2, len(LOAM), height_ratios=(1, 1.2))
    distance = np.linalg.norm(steel, axis=1)
    for panel, below, method in zip(*grid, LOAM, strict=True):
        shown = {"c": distance, "s": 3, "cmap": "Greys_r", "vmin": 0, "vmax": 1.4 * distance.max(), "lw": 0}
        panel.scatter(*_picture(steel), rasterized=True, **shown)
        for name, (points, colour) in taken[method].items():
            points = _above_floor(points, T_world_sensor)
            panel.plot(*_picture(points), ".", ms=3.5, color=colour, label=f"{len(points)} {name}")
        panel.set(title=LABELS[method], aspect="equal")
        panel.set_axis_off()
        panel.legend(loc="upper left", fontsize=9, markerscale=2.5)
        _draw_map(below, truth, estimates[method], method)
    return figure


def _above_floor(points: Array, T_world_sensor: Array) -> Array:
    """The points ``(N, 3)`` of the sensor's frame that are finite and above the floor."""
    return points[points @ T_world_sensor[2, :3] + T_world_sensor[2, 3] >= FLOOR_M]


def _picture(points: Array) -> Array:
    """Where points ``(N, 3)`` of the sensor's frame are seen, ``(2, N)``: to the right and upwards."""
    return np.stack([-points[:, 1] / points[:, 0], points[:, 2] / points[:, 0]])


def _draw_map(panel: Any, truth: Truth, estimate: Estimate, method: str) -> None:
    """The points of a map over the part of the tower that it covers."""
    points, axes = estimate.points, truth.tower.axes
    low, high = points[:, 2].min() - 0.5, points[:, 2].max() + 0.5
    near = axes[(axes[..., 2].max(axis=1) > low) & (axes[..., 2].min(axis=1) < high)]
    clipped = np.array([_between(bar, low, high) for bar in near])
    draw_bars(panel, clipped, clipped.reshape(-1, 3), color=LIGHT_GREY, linewidth=2.2)
    panel.plot(*project_perspective(points, clipped.reshape(-1, 3)).T, ".", ms=1.6, color=COLOURS[method])
    frame_perspective(panel, clipped.reshape(-1, 3))
    panel.set_title(f"map of {len(points)} points", fontsize=11)


def _between(bar: Array, low: float, high: float) -> Array:
    """The part of a bar ``(2, 3)`` between two heights."""
    start, end = bar
    rise = end[2] - start[2]
    if abs(rise) < 1e-9:
        return bar
    share = np.clip(np.sort([(low - start[2]) / rise, (high - start[2]) / rise]), 0, 1)
    return np.asarray(start + share[:, None] * (end - start))


def literature_sentences(runs: pd.DataFrame) -> str:
    """What the runs of `literature_runs` say of each of the literature's odometries, and beside which other it lies, on
    the seeds that both flew."""
    lines = []
    for sensor, of_sensor in runs.groupby("sensor", sort=False):
        where, table = SENSORS.get(str(sensor), str(sensor)), literature_table(of_sensor)
        for method in LITERATURE:
            own, flown = table[table["method"] == method], of_sensor[of_sensor["method"] == method]
            if own.empty:
                continue
            span = f"{1e3 * own['ate_mean_m'].min():.0f} to {1e3 * own['ate_mean_m'].max():.0f} mm"
            lost = (own["ate_mean_m"] > LOST_SHARE * own["raw_ate_mean_m"]).sum()
            beside = []
            for other in ("gicp", "best", "combined", "faces"):
                rows = of_sensor[of_sensor["method"] == other]
                both = flown.merge(rows, on=["trajectory", "noise", "seed"], suffixes=("", "_other"))
                if len(both):
                    means = both.groupby(["trajectory", "noise"])[["ate_rmse_m", "ate_rmse_m_other"]].mean()
                    ratio = np.exp(np.log(means["ate_rmse_m"] / means["ate_rmse_m_other"]).mean())
                    beside.append(f"{float(f'{ratio:.2g}'):g} times that of {LABELS[other]}")
            tail = f"; its error is {', '.join(beside)} (geometric mean)" if beside else ""
            worse = f", and in {lost} of {len(own)} cases it is no better than the drift" if lost else ""
            lines.append(f"{LABELS[method]}, sensor {where}: {span} over flights and noises{worse}{tail}.")
    return bullets(lines)
