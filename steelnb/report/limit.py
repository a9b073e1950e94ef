"""Notebook 14: the bound of the pose errors of a flight beside what the methods reach, with and without range noise."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from steelnb.experiment import Result
from steelnb.metrics.limit import batch, causal, gather, one_scan, see
from steelnb.report.batch import caption, case_of
from steelnb.report.odometry_figures import SMOOTHED_S, running_rms_m
from steelnb.report.style import BLACK, COLOURS, DARK_GREY, GREY, LABELS, Figure, gather_legend, style
from steelnb.types import Array

EXACT = {"tof.sigma_floor_m": 0.0, "tof.sigma_relative": 0.0}
"""Overrides that take the range noise away; what error is left is bias, and the drift that came through."""
CAUSAL_POSES = 15
"""Poses whose causal bound is worked out, evenly over the flight beside the first few: each costs as much as the bound
of a flight until then. Its square is taken as linear between them, and as no less than that of all scans."""
AFTERWARDS = ("smoothed",)
"""Methods that use the whole flight, and are held against its bound; all others against the causal one."""
BOUNDS: dict[str, dict[str, Any]] = {
    "causal": {"color": BLACK, "linestyle": "--", "label": "bound: scans so far, surface unknown"},
    "batch": {"color": BLACK, "linestyle": "-", "label": "bound: all scans, surface unknown"},
    "one scan": {"color": DARK_GREY, "linestyle": ":", "label": "bound: one scan, surface known"},
}
"""The bounds, as a table names them and a figure draws them."""


Limits = dict[str, Array]
"""By name of a bound, the standard deviation of the position ``(K,)`` at each scan, metres; infinite where a scan does
not tell all of it."""


def bounds(result: Result) -> Limits:
    """The bounds of a flight and sensor, named as in `BOUNDS`, whatever estimated it (`steelnb.metrics.limit`).

    Raises `InputError` for a sensor without noise.
    """
    stamp_s, truth = result.corrected.stamp_s, result.truth
    T_world_drone = truth.trajectory.at(stamp_s).T_world_drone
    information = gather(see(truth.tower, T_world_drone, result.settings.tof))
    last = len(stamp_s) - 1
    scans = np.unique(np.append(np.minimum([1, 2, 4, 8, 16, 32], last), np.linspace(0, last, CAUSAL_POSES).astype(int)))
    square = {
        "causal": causal(information, stamp_s, scans.tolist()) ** 2,
        "batch": batch(information, stamp_s) ** 2,
        "one scan": one_scan(information) ** 2,
    }
    total = {name: each[:, :3].sum(axis=1) for name, each in square.items()}
    total["causal"] = np.maximum(np.interp(stamp_s, stamp_s[scans], total["causal"]), total["batch"])
    return {name: np.sqrt(each) for name, each in total.items()}


def ate_mm(sigma_m: Array) -> float:
    """Root mean square of a bound over the poses, millimetres: over many flights, no absolute trajectory error can have
    a root mean square below it."""
    return float(1e3 * np.sqrt((sigma_m**2).mean()))


def limit_table(runs: Sequence[Result], exact: Sequence[Result], limits: Limits) -> pd.DataFrame:
    """A row a bound and a method: the unaligned absolute trajectory error with range noise, ``ate_mm``, and without,
    ``noise_free_mm``, and ``times_bound``, the former as a multiple of the bound that the method is held against.

    ``runs`` are of one flight, ``exact`` some of them without range noise; NaN where there is none.
    """
    without = {result.settings.odometry.method: 1e3 * result.metrics["ate_rmse_m"] for result in exact}
    rows = [{"name": name, "kind": "bound", "ate_mm": ate_mm(sigma_m)} for name, sigma_m in limits.items()]
    for result in runs:
        method, error_mm = result.settings.odometry.method, 1e3 * result.metrics["ate_rmse_m"]
        times = error_mm / ate_mm(limits[against(method)])
        numbers = {"ate_mm": error_mm, "noise_free_mm": without.get(method), "times_bound": times}
        rows.append({"name": method, "kind": "method", **numbers})
    columns = ["name", "kind", "ate_mm", "noise_free_mm", "times_bound"]
    case = {key: value for key, value in case_of(runs[0].settings).items() if key != "method"}
    table = pd.DataFrame(rows, columns=columns).astype({"noise_free_mm": float, "times_bound": float})
    return table.assign(**case)


def against(method: str) -> str:
    """The bound that a method is held against."""
    return "batch" if method in AFTERWARDS else "causal"


@style()
def figure_limit(runs: Sequence[Result], exact: Sequence[Result], limits: Limits) -> Figure:
    """The error of each method over time as a running root mean square, and the bounds below it; at the right edge
    the error of the whole flight without range noise; logarithmic, in millimetres."""
    figure = Figure(figsize=(9.0, 5.6))
    curve = figure.add_subplot()
    for result in runs:
        method = result.settings.odometry.method
        rms_mm = 1e3 * running_rms_m(result, SMOOTHED_S)
        curve.plot(result.corrected.stamp_s, rms_mm, color=COLOURS[method], label=LABELS[method])
    stamp_s = runs[0].corrected.stamp_s
    for name, look in BOUNDS.items():
        shown = np.isfinite(limits[name]) & (limits[name] > 0)  # the first pose is known
        curve.plot(stamp_s, np.where(shown, 1e3 * limits[name], np.nan), **look)
    reached_mm = [1e3 * result.metrics["ate_rmse_m"] for result in (*runs, *exact)]
    lowest_mm = 0.5 * min(*map(ate_mm, limits.values()), *reached_mm)
    largest_mm = 1.6 * max(1e3 * result.metrics["error_max_m"] for result in runs)
    curve.fill_between(stamp_s, 0.01 * lowest_mm, 1e3 * limits["batch"], color=GREY, alpha=0.18, lw=0)
    curve.set(yscale="log", xlim=(0, float(stamp_s[-1])))
    curve.set_ylim(lowest_mm, largest_mm)
    curve.set(xlabel="time (s)", ylabel=f"error of the position (mm), RMS over {SMOOTHED_S:g} s")
    for k, result in enumerate(exact):
        label = "ATE without range noise" if k == 0 else None
        look = {"color": COLOURS[result.settings.odometry.method], "mfc": "white", "mew": 1.6, "clip_on": False}
        curve.plot(stamp_s[-1], 1e3 * result.metrics["ate_rmse_m"], "o", ms=8, zorder=4, label=label, **look)
    gather_legend(figure, ncols=3, fontsize=10)
    figure.suptitle(caption(runs), fontsize=12)
    return figure
