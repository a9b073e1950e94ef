"""Notebook 16: flights that a planner steers beside those along waypoints: sight, error, and what was seen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from scipy.spatial import cKDTree

from steelnb import experiment
from steelnb.errors import InputError
from steelnb.experiment import Result
from steelnb.report.batch import Progress, caption, case_of, share_of
from steelnb.report.odometry_figures import SMOOTHED_S, running_rms_m
from steelnb.report.style import (
    COLOURS,
    Figure,
    draw_bars,
    draw_lines,
    frame_perspective,
    gather_legend,
    project_perspective,
    style,
)
from steelnb.settings import ExperimentSettings
from steelnb.simulation.tower import Tower
from steelnb.simulation.truth import SLICE_M, Truth
from steelnb.types import Array, Flight

FLIGHTS: dict[str, tuple[Any, dict[str, Any]]] = {
    "zigzag": ("zigzag", {}),
    "wide loops": ("loops", {"flight.standoff_m": 2.4}),
    "loops": ("loops", {}),
    "planned": ("planned", {}),
    "up a face": ("planned", {"flight.goal": "face", "flight.height_max_m": 15.0, "flight.speed_m_s": 0.18}),
}
"""Name → trajectory and overrides. `wide loops` has loops about as wide as the report's, 3.5 to 4.3 m to either side of
the tower's axis; `planned` goes around as far, as high and as fast as `loops`; `up a face` as high and as fast as
`zigzag`."""
FEW = 300
"""Returns from steel below which a scan has lost sight."""
STEEL_M = 0.15
"""A return counts for the slice of a member whose middle is so near."""
EVERY = 5
"""Of the returns, every fifth tells what was seen."""
EVERY_STEP = 25
"""Of a path at 125 Hz, what is drawn."""
STRIP = 6
"""Frames of a film strip."""


@dataclass(frozen=True)
class Flown:
    """A flight and what came of it: ``returns (K,)`` from steel, ``seen (K,)`` the share of the steel's length seen so
    far."""

    flight: Flight
    result: Result
    returns: Array
    seen: Array


def make_flights(
    names: Sequence[str], noise: str, method: str, sensor: str, seed: int, duration_s: float,
    overrides: Mapping[str, Any] | None = None,
) -> dict[str, ExperimentSettings]:  # fmt: skip
    """Settings of each flight of `FLIGHTS`, by name. Raises `InputError`."""
    if unknown := [name for name in names if name not in FLIGHTS]:
        raise InputError(f"flights: unknown {unknown[0]!r}; expected some of {', '.join(map(repr, FLIGHTS))}")
    return {
        name: ExperimentSettings.preset(
            FLIGHTS[name][0], noise, method, sensor, seed, duration_s, {**FLIGHTS[name][1], **(overrides or {})}
        )
        for name in names
    }


def fly_all(cases: Mapping[str, ExperimentSettings], on_progress: Progress | None = None) -> dict[str, Flown]:
    """Simulate and estimate each flight, and look at what it saw. Raises `CollisionError`."""
    found = {}
    for k, (name, settings) in enumerate(cases.items()):
        flight, truth = experiment.simulate(settings, share_of(on_progress, 2 * k, 2 * len(cases)))
        within = share_of(on_progress, 2 * k + 1, 2 * len(cases))
        result = experiment.estimate(settings, flight, truth, within)
        found[name] = Flown(flight, result, *sight(flight, truth, settings.odometry.preprocess.floor_m))
    return found


def sight(flight: Flight, truth: Truth, floor_m: float) -> tuple[Array, Array]:
    """Of each scan, its returns higher than ``floor_m`` at the true pose, and the share of the steel seen so far."""
    tree = cKDTree(_slices(truth.tower.axes))
    seen, returns, shares = np.zeros(tree.n, dtype=bool), [], []
    T_world_sensor = truth.trajectory.at(flight.prior.stamp_s).T_world_drone @ flight.T_drone_sensor
    for scan, T in zip(flight.scans, T_world_sensor, strict=True):
        points = scan.points.reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
        points = points[points[:, 2] > floor_m]  # a pixel without a return is NaN
        near = tree.query(points[::EVERY], distance_upper_bound=STEEL_M)[1]
        seen[near[near < tree.n]] = True
        returns.append(len(points))
        shares.append(seen.mean())
    return np.array(returns), np.array(shares)


def _slices(axes: Array) -> Array:
    """Middles ``(S, 3)`` of the slices of all members ``(M, 2, 3)``."""
    middles = []
    for begin, end in axes:
        count = max(1, round(float(np.linalg.norm(end - begin)) / SLICE_M))
        middles.append(begin + (np.arange(count)[:, None] + 0.5) / count * (end - begin))
    return np.concatenate(middles)


def flight_table(flown: Mapping[str, Flown]) -> pd.DataFrame:
    """A row a flight; lengths in metres, ``few_share`` of the scans with fewer than `FEW` returns from steel,
    ``no_pair_share`` of those without a pair, ``recall`` of the bars seen well enough, ``members_seen`` of all,
    ``clearance_m`` the least true distance from the middle of a member."""
    rows = []
    for name, each in flown.items():
        result, slices = each.result, cKDTree(_slices(each.result.truth.tower.axes))
        rows.append(
            {
                "flight": name,
                **case_of(result.settings),
                "flown_s": float(result.corrected.stamp_s[-1]),
                "few_share": float((each.returns < FEW).mean()),
                "no_pair_share": float((result.matches[1:] == 0).mean()),
                "ate_rmse_m": result.metrics["ate_rmse_m"],
                "raw_ate_rmse_m": result.metrics["raw_ate_rmse_m"],
                "seen_share": float(each.seen[-1]),
                "members_seen": float(result.truth.visibility.observed().mean()),
                "recall": result.metrics.get("segment_recall", 0.0),
                "clearance_m": float(slices.query(result.truth.trajectory.position)[0].min()),
            }
        )
    return pd.DataFrame(rows).drop(columns="trajectory")


@style()
def figure_paths(flown: Mapping[str, Flown]) -> Figure:
    """The true path of each flight about the tower, from its start (dark) to its end (light)."""
    columns = min(len(flown), 3)
    rows = -(-len(flown) // columns)
    figure = Figure(figsize=(3.6 * columns, 4.6 * rows))
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel in panels[len(flown) :]:
        panel.set_axis_off()
    for panel, (name, each) in zip(panels, flown.items(), strict=False):
        truth = each.result.truth
        _draw_path(panel, truth.tower, truth.trajectory.position)
        panel.set_title(f"{name}: {1e3 * each.result.metrics['ate_rmse_m']:.0f} mm", fontsize=12)
    figure.suptitle(_caption(flown), fontsize=12)
    return figure


def _draw_path(panel: Axes, tower: Tower, position: Array) -> None:
    around = np.concatenate([tower.axes.reshape(-1, 3), [[-4.5, -4.5, 0.0], [4.5, 4.5, 0.0]]])
    draw_bars(panel, tower.axes, around, colors=COLOURS["member"], linewidths=0.6)
    flat = project_perspective(position[::EVERY_STEP], around)
    time = np.linspace(0, 1, len(flat) - 1)
    draw_lines(panel, np.stack([flat[:-1], flat[1:]], axis=1), array=time, cmap="viridis", linewidths=1.4)
    frame_perspective(panel, around)


@style()
def figure_time(flown: Mapping[str, Flown]) -> Figure:
    """Returns from steel, error and coverage of each flight over time."""
    figure = Figure(figsize=(9.0, 8.0))
    returns, errors, seen = figure.subplots(3, 1, sharex=True)
    for name, each in flown.items():
        stamp_s, look = each.result.corrected.stamp_s, {"color": COLOURS[name], "lw": 1.2, "label": name}
        returns.plot(stamp_s, np.maximum(each.returns, 1), **look)
        errors.plot(stamp_s, 1e3 * running_rms_m(each.result, SMOOTHED_S), **look)
        seen.plot(stamp_s, 100 * each.seen, **look)
    returns.axhline(FEW, color=COLOURS["report"], lw=1.0, ls=":")
    returns.set(ylabel="returns from steel", yscale="log")
    errors.set(ylabel=f"error of the position (mm),\nRMS over {SMOOTHED_S:g} s", yscale="log")
    seen.set(xlabel="time (s)", ylabel="steel seen so far (%)", ylim=(0, 101), xlim=(0, None))
    gather_legend(figure, ncols=min(len(flown), 6), fontsize=11)
    figure.suptitle(_caption(flown), fontsize=12)
    return figure


@style()
def figure_strip(name: str, each: Flown) -> Figure:
    """Six moments of a flight: what the camera sees, by range, above where the drone is and has been."""
    figure = Figure(figsize=(11.0, 5.4))
    panels = figure.subplots(2, STRIP, height_ratios=[1.0, 1.6])
    truth, stamps = each.result.truth, each.result.corrected.stamp_s
    moments = np.linspace(0.02, 0.98, STRIP) * stamps[-1]
    scans = [each.flight.scans[int(k)] for k in np.searchsorted(stamps, moments)]
    for (view, path), scan, stamp_s in zip(panels.T, scans, moments, strict=True):
        range_m = np.linalg.norm(scan.points, axis=-1)
        shown = view.imshow(range_m, cmap="viridis_r", vmin=0, vmax=each.result.settings.tof.range_max_m)
        view.set_title(f"{stamp_s:.0f} s")
        view.set_axis_off()
        at = truth.trajectory.stamp_s <= stamp_s
        _draw_path(path, truth.tower, truth.trajectory.position[at])
    figure.colorbar(shown, ax=list(panels[0]), label="range (m)", shrink=0.9)
    figure.suptitle(f"{name}, {_caption({name: each})}", fontsize=12)
    return figure


def _caption(flown: Mapping[str, Flown]) -> str:
    cases = pd.DataFrame([case_of(each.result.settings) for each in flown.values()])
    return f"{caption(cases.drop(columns='trajectory'))}, {cases['method'].iloc[0]}"
