"""Bands of the errors of a program: draws of the sensor's noise beside the report's curve."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.core.errors import InputError
from steelnb.metrics import position_error_m
from steelnb.notebook.cases import plot_of
from steelnb.notebook.report import report_curve
from steelnb.notebook.tables import CASE_COLUMNS, case_of
from steelnb.settings import ExperimentSettings

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
    Raises `InputError` for fewer than two draws."""
    if count < 2:
        raise InputError(f"draws = {count}: expected at least two, for a band")
    parts = []
    for done, case in enumerate(cases, 1):
        parts.append(_draws_of(case, count))
        if on_progress:
            on_progress(done / len(cases))
    return pd.concat(parts, ignore_index=True)


def _draws_of(case: ExperimentSettings, count: int) -> pd.DataFrame:
    """The rows of `draw_programs` of one case."""
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
