"""The report's plots beside runs of its experiments: curves, bands of draws, and the assembled clouds."""

from collections.abc import Iterable, Sequence
from functools import cache, partial
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from steelnb import experiment
from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.metrics import bend, position_error_m
from steelnb.metrics.clouds import paired_clouds
from steelnb.notebook.cases import CASE_COLUMNS, case_of, plot_of
from steelnb.notebook.results import find_root
from steelnb.notebook.runs import Flights, run_all
from steelnb.notebook.tables import cloud_table
from steelnb.plots.style import log_axis
from steelnb.settings import ExperimentSettings, Noise
from steelnb.settings.report_plots import STEP_S, ReportPlot, read_report_plots
from steelnb.simulation import Tower
from steelnb.simulation.drift import drift_size

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


BAND = (10, 90)
"""Percentiles of a band of draws."""
BAND_COLUMNS = (
    "mean_m", "mean_low_m", "mean_high_m", "max_m", "final_m", "report_mean_m", "report_max_m", "report_final_m",
    "share_below", "correlation",
)  # fmt: skip
"""Numbers of `band_table`."""


def draw_programs(
    cases: Sequence[ExperimentSettings], count: int, on_progress: experiment.OnProgress | None = None
) -> pd.DataFrame:
    """Errors over time of ``count`` draws of the sensor's noise of each case, with the same drift and flight, beside
    the report's curve: long form with the columns of `case_of`, ``plot``, ``curve``, ``draw``, ``sample``, ``time_s``
    and ``error_m``.

    ``curve``: ``draws``; ``draw``, the first one again; ``report``, where the report has a plot of the experiment.
    Raises `InputError` where there are no draws (`experiment.draws`)."""
    return pd.concat(run_all(cases, on_progress, partial(_draws_of, count)), ignore_index=True)


def _draws_of(
    count: int, case: ExperimentSettings, flights: Flights, on_progress: experiment.OnProgress | None
) -> pd.DataFrame:
    """The rows of `draw_programs` of one case: a task of `run_all`."""
    rows, plot, stamp_s = [], plot_of(case), np.zeros(0)
    for draw, (settings, flight, truth) in enumerate(experiment.draws(case, count)):
        found = experiment.estimate(settings, flight, truth).corrected
        stamp_s, error_m = found.stamp_s, position_error_m(found, truth.trajectory)
        sample = plot.sample_at(stamp_s) if plot else np.arange(len(stamp_s))
        logged = np.isfinite(sample)
        one = sample[logged], stamp_s[logged], error_m[logged]
        rows += [("draws", draw, *one)] + [("draw", draw, *one)] * (draw == 0)
    if plot:
        time_s, error_m = report_curve(plot, until_s=float(stamp_s[-1]) + 0.5)
        rows.append(("report", 0, plot.sample_at(time_s), time_s, error_m))
    named = {**case_of(case), "plot": plot.name if plot else ""}
    columns = ("curve", "draw", "sample", "time_s", "error_m")
    return pd.concat([pd.DataFrame({**named, **dict(zip(columns, row, strict=True))}) for row in rows])


def band_table(drawn: pd.DataFrame) -> pd.DataFrame:
    """One row per case of `draw_programs`: the mean, largest and last error of the report's curve (``report_…``), their
    median over the draws, and the `BAND` of the means (``mean_low_m``, ``mean_high_m``).

    ``share_below``: share of the draws with a smaller mean than the report; ``correlation``: between the report's curve
    and the median of the draws at its samples; ``as_in_the_report``: the report's mean lies inside the band or within
    30 % of the median."""
    rows = []
    for case, part in drawn.groupby([*CASE_COLUMNS, "plot"], sort=False):
        curve = part[part["curve"] == "draws"].pivot(index="time_s", columns="draw", values="error_m")
        shown = part[part["curve"] == "report"]
        ours = np.array([np.interp(shown["time_s"], curve.index, curve[draw]) for draw in curve])
        if not len(shown):  # the report has no such plot: our own samples
            ours = curve.to_numpy().T
        means, middle, theirs = ours.mean(axis=1), np.median(ours, axis=0), shown["error_m"].to_numpy()
        low, high = np.percentile(means, BAND)
        row = dict(zip([*CASE_COLUMNS, "plot"], case, strict=True)) | {
            "draws": len(means), "mean_m": np.median(means), "mean_low_m": low, "mean_high_m": high,
            "max_m": np.median(ours.max(axis=1)), "final_m": np.median(ours[:, -1]),
        }  # fmt: skip
        if len(theirs):
            mean = theirs.mean()
            row |= {
                "report_mean_m": mean, "report_max_m": theirs.max(), "report_final_m": theirs[-1],
                "share_below": (means < mean).mean(), "correlation": np.corrcoef(middle, theirs)[0, 1],
                "as_in_the_report": low <= mean <= high or abs(mean / row["mean_m"] - 1) <= 0.3,
            }  # fmt: skip
        rows.append(row)
    return pd.DataFrame(rows).reindex(columns=[*CASE_COLUMNS, "plot", "draws", *BAND_COLUMNS, "as_in_the_report"])


def band_curves(drawn: pd.DataFrame) -> pd.DataFrame:
    """The band of each case of `draw_programs` over time, for plots of your own: ``low_m``, ``median_m`` and ``high_m``
    (`BAND`), and ``draw_m``, the first draw."""
    rows = drawn[drawn["curve"] == "draws"]
    by = [*CASE_COLUMNS, "plot", "sample", "time_s"]
    band = rows.groupby(by, sort=False)["error_m"].quantile([BAND[0] / 100, 0.5, BAND[1] / 100]).unstack()
    band.columns = pd.Index(["low_m", "median_m", "high_m"])
    first = rows[rows["draw"] == rows["draw"].min()].set_index(by)["error_m"].rename("draw_m")
    return band.join(first).reset_index()


BENDS = ("bend_deg", "tilt_max_deg", "yaw_max_deg", "offset_max_m", "blur_mean_m")
"""The numbers of a bend."""


def assembled_clouds(results: Sequence[experiment.Result]) -> list[tuple[Array, Array]]:
    """The points of each run at its estimated and at the true poses (`paired_clouds`). Flights are simulated
    again, once for all runs of a flight that follow each other."""
    flights = Flights()
    return [
        paired_clouds(flights(one.settings)[0], one, one.truth, one.settings.odometry.preprocess) for one in results
    ]


def cloud_bends(clouds: Iterable[tuple[Array, Array]], tower: Tower) -> pd.DataFrame:
    """Bend of each pair of `assembled_clouds`, one row per pair: `metrics.bend` about the vertical axis of a tower. NaN
    for a cloud that has too few points, as those of a flight of seconds."""
    axis, rows = tower.vertices[:, :2].mean(axis=0), []
    for pair in clouds:
        try:
            rows.append(bend(*pair, axis))
        except InputError:
            rows.append({})
    return pd.DataFrame(rows, columns=BENDS)
