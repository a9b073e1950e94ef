"""Notebook 08: claims that a number can answer; from the runs of a study to an estimate, its interval and a verdict."""

import itertools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field, model_validator
from scipy import stats

from steelnb.errors import FileMissingError, SettingsError
from steelnb.report import segmentation
from steelnb.report.batch import flat
from steelnb.settings import Settings, read_tables
from steelnb.study.plan import CASE
from steelnb.types import Array

RESAMPLES = 9999
CONFIDENCE = 0.95
HOLDS, FAILS, ONLY_WHEN, NOT_RUN = "holds", "does not hold", "holds only when", "not run"
UNITS = {"_m_s": "m/s", "_m": "m", "_deg": "°", "_ms": "ms"}
USUAL: dict[str, Any] = {"sensor": "report", "duration_s": 200.0, "variant": "", "blind": ""}
"""Values of the runs that a claim is about, unless its ``where`` says otherwise."""
SLIP_M = 0.25
"""An error that grows by more than this within a second, while the scan has pairs, has locked onto something else."""
DERIVED: dict[str, Callable[[pd.DataFrame], Any]] = {
    "raw_at_180_s_m": lambda runs: [
        np.interp(180.0, time, error) if time[-1] >= 179.0 else np.nan
        for time, error in zip(runs["curve_time_s"], runs["curve_raw_m"], strict=True)
    ],
    "slipped": lambda runs: (runs["slip_m"] > SLIP_M).to_numpy(),
}
Chosen = dict[str, str | float | list[str]]


class Claim(Settings):
    """One table of the claims' file.

    ``metric`` of the runs ``where``, in each cell of ``by`` and for each seed, goes into a number by ``form``: its
    ``level``, its ``difference`` or ``ratio`` of the runs ``a`` to the runs ``b`` of the same seed, or its rank
    ``correlation`` over the seeds with the metric that ``b`` names. The claim is that the number lies ``below`` or
    ``above`` the ``threshold``, or ``between`` two of them.
    """

    section: str
    claim: str
    metric: str
    form: Literal["level", "difference", "ratio", "correlation"] = "difference"
    comparison: Literal["below", "above", "between"]
    threshold: Annotated[list[float], Field(min_length=1, max_length=2)]
    where: Chosen = Field(default_factory=dict)
    a: Chosen = Field(default_factory=dict)
    b: Chosen = Field(default_factory=dict)
    by: Annotated[list[str], Field(min_length=1)] = ["trajectory", "noise"]  # noqa: RUF012

    @model_validator(mode="after")
    def _fits(self) -> "Claim":
        for name in (*self.by, *self.where, *self.a, *self.b):
            if name not in CASE and (name != "metric" or name in (*self.by, *self.where, *self.a)):
                raise ValueError(f"unknown column {name!r}; expected one of {', '.join(CASE)}")
        if len(self.threshold) != (2 if self.comparison == "between" else 1):
            raise ValueError(f"threshold = {self.threshold}: expected two numbers for 'between', else one")
        if (self.form == "level") == bool(self.b) or (self.form == "correlation" and "metric" not in self.b):
            raise ValueError("b: a level has none, a difference or ratio names runs, a correlation a metric")
        return self

    def satisfied(self, low: float, high: float) -> bool:
        """True if all of an interval is as claimed."""
        if self.comparison == "between":
            return self.threshold[0] <= low and high <= self.threshold[1]
        return high < self.threshold[0] if self.comparison == "below" else low > self.threshold[0]

    def outside(self, low: float, high: float) -> bool:
        """True if no part of an interval is as claimed."""
        if self.comparison == "between":
            return high < self.threshold[0] or self.threshold[1] < low
        return low > self.threshold[0] if self.comparison == "below" else high < self.threshold[0]

    @property
    def unit(self) -> str:
        """The unit of the claim's number, by the ending of its metric; none for a share, a ratio or a correlation."""
        if self.form in ("ratio", "correlation"):
            return ""
        return next((unit for ending, unit in UNITS.items() if self.metric.endswith(ending)), "")

    @property
    def measure(self) -> str:
        """The metric, form and unit as text: ``error_mean_m, difference (m)``."""
        return f"{self.metric}, {self.form}" + (f" ({self.unit})" if self.unit else "")


@dataclass(frozen=True)
class Verdict:
    """A claim's number with its interval, the number of seeds, the verdict and its condition.

    ``cells`` has a row for each cell: its values of ``by``, ``estimate``, ``low``, ``high`` and ``holds``. A claim that
    was not run has no cells and no numbers (NaN); its condition says what is missing.
    """

    id: str
    claim: Claim
    estimate: float
    low: float
    high: float
    n_seeds: int
    verdict: str
    condition: str
    cells: pd.DataFrame


def read_claims(path: Path) -> dict[str, Claim]:
    """The claims of a file, by name. Raises `FileMissingError` or `SettingsError`."""
    return read_tables(path, Claim, "a file of claims")


def frame_runs(folder: Path) -> pd.DataFrame:
    """The results of the segmentation methods as runs, so that claims on single frames are judged like the others.

    Frames at the usual noise, clutter and density, a row a method and seed, as runs of the ``trajectory`` ``frame``
    without duration or noise; ``f1`` is the harmonic mean of recall and precision, ``frame_median_ms`` the time
    that the folder has for them. Raises `FileMissingError`.
    """
    names = ["scene", "noise_m", "clutter", "kept", "method", "seed"]
    try:
        rows, times = (pd.read_csv(folder / name) for name in ("table.csv", "timing.csv"))
    except OSError as fault:
        raise FileMissingError(f"{fault.filename}: {fault.strerror}; expected results of segmentation-seeds") from None
    times = times.rename(columns={"median_ms": "frame_median_ms"})[[*names, "frame_median_ms"]]
    rows = rows.merge(times, on=names, how="left", validate="one_to_one")
    usual = np.logical_and.reduce([rows[name] == value for name, value in segmentation.USUAL.items()])
    rows = rows[(rows["scene"] == "frame") & usual].reset_index(drop=True)
    both = rows["recall"] + rows["precision"]
    f1 = 2 * rows["recall"] * rows["precision"] / both.where(both > 0, 1.0)
    case = {"sensor": "starling2", "trajectory": "frame", "noise": "", "duration_s": 0.0, "status": "ok"}
    return rows.assign(f1=f1, **{**USUAL, **case})


def judge_all(claims: dict[str, Claim], runs: pd.DataFrame) -> list[Verdict]:
    """A verdict on each claim, `NOT_RUN` where the runs lack what it is about."""
    verdicts = []
    for name, claim in claims.items():
        try:
            verdicts.append(judge(name, claim, runs))
        except SettingsError as fault:
            missing, none = str(fault).removeprefix(f"[{name}]: ").partition(";")[0], float("nan")
            cells = pd.DataFrame(columns=[*claim.by, "estimate", "low", "high", "holds"])
            verdicts.append(Verdict(name, claim, none, none, none, 0, NOT_RUN, missing, cells))
    return verdicts


def judge(name: str, claim: Claim, runs: pd.DataFrame) -> Verdict:
    """Estimate what a claim is about over the seeds of some runs, overall and in each cell.

    A claim holds where all of the interval is as claimed; it holds only when some cells do and others do not. A cell in
    which fewer than two seeds have a number says nothing. Raises `SettingsError`.
    """
    good = runs[runs["status"] == "ok"]
    first = _select(name, good, {**USUAL, **claim.where, **claim.a})
    cells = list(dict.fromkeys(zip(*(first[column] for column in claim.by), strict=True)))
    sides = []
    for cell in cells:
        at = dict(zip(claim.by, cell, strict=True))
        here = first[np.logical_and.reduce([first[column] == value for column, value in at.items()])]
        pair = [_by_seed(name, here, claim.metric)]
        if claim.form != "level":
            other = {key: value for key, value in claim.b.items() if key != "metric"}
            there = _select(name, good, {**USUAL, **claim.where, **claim.a, **at, **other})
            pair.append(_by_seed(name, there, str(claim.b.get("metric", claim.metric))))
        sides.append(pd.concat(pair, axis=1, keys=range(len(pair))))
    seeds = sorted(set().union(*(side.index for side in sides)))
    values = np.array([side.reindex(seeds).to_numpy() for side in sides]).transpose(1, 0, 2)  # (seed, cell, side)
    values[~np.isfinite(values).all(axis=2)] = np.nan
    kept = [c for c in range(len(cells)) if np.isfinite(values[:, c, 0]).sum() >= 2]
    if not kept:
        raise SettingsError(f"[{name}]: fewer than two seeds have a number; expected runs of more seeds")
    rows = []
    for c in kept:
        estimate, low, high = interval(claim.form, values[:, [c]])
        rows.append((*map(str, cells[c]), estimate, low, high, claim.satisfied(low, high)))
    table = pd.DataFrame(rows, columns=[*claim.by, "estimate", "low", "high", "holds"])
    estimate, low, high = interval(claim.form, values[:, kept])
    n_seeds = int(np.count_nonzero(np.isfinite(values[:, kept, 0]).any(axis=1)))
    word = HOLDS if table["holds"].all() else ONLY_WHEN if table["holds"].any() else FAILS
    condition = describe_cells(table, claim.by) if word == ONLY_WHEN else ""
    return Verdict(name, claim, estimate, low, high, n_seeds, word, condition, table)


def interval(form: str, values: Array) -> tuple[float, float, float]:
    """Estimate of ``values (seed, cell, side)`` with its 95 % interval by a bootstrap over the seeds.

    Seeds are drawn with all their cells and both sides, so that differences stay paired. Bias-corrected and accelerated
    (Efron 1987); percentiles where all seeds are so alike that this is not defined. Always the same draws. A share of
    runs, each 0 or 1, has the exact binomial interval (Clopper and Pearson 1934): a bootstrap of something rare reaches
    down to 0 although it happened.
    """
    values = values[np.any(np.isfinite(values).all(axis=2), axis=1)]
    if form == "level" and len(values) and np.isin(values[np.isfinite(values)], (0.0, 1.0)).all():
        happened = values[np.isfinite(values)]
        exact = stats.binomtest(int(happened.sum()), len(happened)).proportion_ci(CONFIDENCE, method="exact")
        return float(happened.mean()), float(exact.low), float(exact.high)
    whole = form == "correlation"  # a number of all seeds; the other forms have one a seed, whose mean is the estimate
    data = np.arange(len(values)) if whole else _numbers(form, values)
    statistic: Callable[..., Any] = (lambda index: _correlation(values[index])) if whole else np.mean
    estimate = float(statistic(data))
    if not whole and np.ptp(data) < 1e-12:
        return estimate, estimate, estimate
    for method in ("BCa", "percentile"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it is not defined is seen from its being NaN
            found = stats.bootstrap(
                (data,), statistic, n_resamples=RESAMPLES // 10 if whole else RESAMPLES, confidence_level=CONFIDENCE,
                method=method, vectorized=not whole, rng=np.random.default_rng(0),
            ).confidence_interval  # fmt: skip
        if np.isfinite([found.low, found.high]).all():
            break
    return estimate, float(found.low), float(found.high)


def verdict_table(verdicts: Sequence[Verdict]) -> pd.DataFrame:
    """One row a claim, as the README shows them."""
    names = ("estimate", "low", "high", "n_seeds", "verdict", "condition")
    return pd.DataFrame(
        {"claim": each.claim.claim, "section": each.claim.section, "metric": each.claim.measure}
        | {name: getattr(each, name) for name in names}
        for each in verdicts
    )


def verdict_metrics(verdicts: Sequence[Verdict]) -> dict[str, float]:
    """The finite numbers of all verdicts in one flat map, ``<name>.<estimate, low, high, n_seeds, …>``."""
    rows = verdict_table(verdicts).set_index(pd.Index([each.id for each in verdicts]))
    rows["cells_holding"] = [each.cells["holds"].astype(float).mean() for each in verdicts]
    return flat(rows, columns=("estimate", "low", "high", "n_seeds", "cells_holding"))


def describe_cells(cells: pd.DataFrame, by: Sequence[str]) -> str:
    """The cells in which a claim holds, by the fewest columns that tell them from the others."""
    holding = cells[cells["holds"]]
    choices = [list(names) for count in range(1, len(by)) for names in itertools.combinations(by, count)]
    enough = (n for n in choices if len(cells.merge(holding[n].drop_duplicates(), on=n)) == len(holding))
    rows = holding[next(enough, list(by))].drop_duplicates()
    return "; ".join(", ".join(filter(None, row)) or "as preset" for row in rows.itertuples(index=False))


def _numbers(form: str, values: Array) -> Array:
    """The level, difference or ratio of each seed ``(N,)``, a mean over its cells."""
    a, b = values[..., 0], values[..., -1]
    each = a - b if form == "difference" else a / b if form == "ratio" else a
    return np.asarray(np.nanmean(each, axis=1))


def _correlation(values: Array) -> float:
    """Spearman's rank correlation between the two sides over the seeds, a mean over the cells; 0 where a side is
    constant."""
    found = []
    for cell in range(values.shape[1]):
        pair = values[np.isfinite(values[:, cell]).all(axis=1), cell]
        ranks = [stats.rankdata(pair[:, side]) for side in (0, 1)]
        alike = len(pair) < 2 or np.ptp(ranks[0]) == 0 or np.ptp(ranks[1]) == 0
        found.append(0.0 if alike else float(np.corrcoef(*ranks)[0, 1]))
    return float(np.mean(found))


def _select(name: str, runs: pd.DataFrame, chosen: dict[str, Any]) -> pd.DataFrame:
    """The runs with some values, or one of some, in each column. Raises `SettingsError` if there are none."""
    for column, value in chosen.items():
        wanted = value if isinstance(value, list) else [value]
        runs = runs[runs[column].isin(wanted)]
        if runs.empty:
            raise SettingsError(f"[{name}]: no runs with {column} = {value!r}; expected a value that the study has")
    return runs


def _by_seed(name: str, runs: pd.DataFrame, metric: str) -> pd.Series:
    """A metric by seed, a mean where a seed has several runs. Raises `SettingsError` for an unknown one."""
    if metric in DERIVED:
        values = pd.Series(DERIVED[metric](runs), index=runs["seed"].to_numpy(), dtype=float)
    elif metric in runs and pd.api.types.is_numeric_dtype(runs[metric]):
        values = pd.Series(runs[metric].to_numpy(dtype=float), index=runs["seed"].to_numpy())
    else:
        raise SettingsError(f"[{name}]: metric = {metric!r}: expected a number that runs have")
    return values.groupby(level=0).mean()
