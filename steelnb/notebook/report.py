"""The curves of the report's plots, beside those of runs."""

from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from steelnb import experiment
from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.metrics import position_error_m
from steelnb.notebook.cases import plot_of
from steelnb.notebook.results import find_root
from steelnb.notebook.tables import CASE_COLUMNS, case_of, cloud_table
from steelnb.plots.style import log_axis
from steelnb.settings import Noise
from steelnb.settings.report_plots import STEP_S, ReportPlot, read_report_plots
from steelnb.simulation.noise import drift_size

REPORT_FIGURE = {"vertical": "3_2", "orbit": "3_3", "random-walk": "3_5", "constant-drift": "3_6"}
"""The report's figure, as in file names: by flight for segment odometry, by noise for point-cloud odometry."""
FLOOR_M = 0.005
"""Where the axes of the report's errors begin (`log_errors`)."""
REPORT_CURVES = Path("notebooks", "report-curves.csv")
"""The curves of the report's plots, read off its PDF. The path is relative to the root of the project."""


@cache
def _report_curves() -> pd.DataFrame:
    return pd.read_csv(find_root() / REPORT_CURVES, dtype={"figure": str})


def report_curve(plot: ReportPlot, curve: str = "corrected", until_s: float = np.inf) -> tuple[Array, Array]:
    """Times (s) and errors (m), each ``(N,)``, of the curve ``corrected`` or ``drift`` in one of the report's plots.
    Samples of another run in the same plot and those after ``until_s`` are left out."""
    named = {"figure": plot.figure, "trajectory": plot.trajectory, "method": plot.method, "curve": curve}
    rows = _report_curves()
    rows = rows[(rows[list(named)] == pd.Series(named)).all(axis=1)]
    time_s, error_m = plot.time_at(rows["step"].to_numpy()), rows["error_m"].to_numpy()
    return time_s[time_s <= until_s], error_m[time_s <= until_s]  # false for NaN


def seed_drift(stamp_s: Array, noise: Noise) -> Array:
    """`drift_size` ``(N,)`` with the seed ``report``; NaN for a noise that it has no draws for."""
    try:
        noise.check_report()
    except InputError:
        return np.full(len(stamp_s), np.nan)
    return drift_size(stamp_s, noise, "report")


def sample_runs() -> pd.DataFrame:
    """The samples of the report's slow programs as runs, so that claims on time are judged like the others: ``scan_s``
    is the time from a sample to the next one, which the program spent on a scan. A sample stands for a ``seed``, its
    ``variant`` is ``samples``, and it has no duration. Raises `InputError`."""
    runs = []
    for plot in read_report_plots():
        if plot.steps_per_sample:
            continue  # a fast program, which used nearly every scan
        program = {"average": "segments"}.get(plot.method, plot.method)
        rows = pd.DataFrame({"scan_s": STEP_S * np.diff(plot.steps)}).rename_axis("seed").reset_index()
        flown = {"trajectory": plot.flight or plot.trajectory, "noise": plot.noise, "method": f"report-{program}"}
        runs.append(rows.assign(sensor="report", variant="samples", duration_s=0.0, status="ok", **flown))
    return pd.concat(runs, ignore_index=True)


def report_table(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """`cloud_table` with the mean, maximum and last error (m) of the corrected curve in the report's plot of the same
    experiment, up to the end of the run: ``report_mean_m``, ``report_max_m``, ``report_final_m``. NaN without a plot.
    """
    none = np.array([0.0]), np.array([np.nan])
    errors = [_reported(result).get("report", none)[1] for result in results]
    columns = ["report_mean_m", "report_max_m", "report_final_m"]
    numbers = pd.DataFrame([(error.mean(), error.max(), error[-1]) for error in errors], columns=columns)
    return cloud_table(results).join(numbers)


def _reported(result: experiment.Result) -> dict[str, tuple[Array, Array]]:
    """The curves ``report-drift`` and ``report`` of the report's plot of a run, to half a second after its end."""
    plot, end_s = plot_of(result.settings), float(result.corrected.stamp_s[-1]) + 0.5
    if plot is None:
        return {}
    return {"report-drift": report_curve(plot, "drift", end_s), "report": report_curve(plot, until_s=end_s)}


def curves(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """Errors over time in long form, one row per sample: the columns of `case_of`, ``curve``, ``time_s``, ``error_m``.

    Each run has a ``curve`` with the name of its method, and ``none``, its drift. If the report has a plot of the same
    experiment (`plot_of`), the curves ``report`` and ``report-drift`` of that plot are added.
    """
    parts = []
    for result in results:
        lines = _reported(result)  # first, and so behind the others
        for name, path in {"none": result.prior, result.settings.odometry.method: result.corrected}.items():
            lines[name] = path.stamp_s, position_error_m(path, result.truth.trajectory)
        for name, (time_s, error_m) in lines.items():
            samples = {"curve": name, "time_s": time_s, "error_m": error_m}
            parts.append(pd.DataFrame({**case_of(result.settings), **samples}))
    return pd.concat(parts, ignore_index=True)


def log_errors(panels: Iterable[Axes], curves: pd.DataFrame) -> None:
    """Make the axes of the errors of some `curves` logarithmic. They begin at `FLOOR_M`, or at a tenth of the lowest
    curve's largest error if that is lower; at 0, if a curve is 0 throughout."""
    largest = curves.groupby([*CASE_COLUMNS, "curve"])["error_m"].max()
    low, with_0 = min(FLOOR_M, 0.1 * float(largest[largest > 0].min())), (largest == 0).any()  # FLOOR_M for NaN
    for panel in panels:
        log_axis(panel, "y", low, with_0)
        panel.set_ylim(-0.2 * low if with_0 else low)
