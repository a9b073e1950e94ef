"""Notebook 12: claims that a number can answer; from the runs of a study to an estimate, its interval and a verdict."""

import itertools
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field, model_validator
from scipy import stats

from steelnb.batch import flat
from steelnb.errors import InputError
from steelnb.row import CASE
from steelnb.settings import Settings, read_tables
from steelnb.types import Array

HOLDS, FAILS, OPEN, NOT_RUN = "holds", "does not hold", "inconclusive", "not run"
CONFIDENCE = 0.95
UNITS = {"_m_s": "m/s", "_m": "m", "_deg": "°", "_ms": "ms"}
TOWERS = ("", "tower.waist_width_m=2.4", "tower.waist_width_m=3.0")
"""The report's tower as preset, 1.7 m wide at the waist, and wider: the report does not give that width."""
USUAL: dict[str, Any] = {"sensor": "report-4cm", "duration_s": 200.0, "variant": list(TOWERS), "blind": ""}
"""Values of the runs that a claim is about, unless its ``where`` says otherwise."""
DERIVED: dict[str, Callable[[pd.DataFrame], Any]] = {
    "raw_at_180_s_m": lambda runs: [
        np.interp(180.0, time, error) if time[-1] >= 179.0 else np.nan
        for time, error in zip(runs["curve_time_s"], runs["curve_raw_m"], strict=True)
    ],
    "converged_wrongly": lambda runs: (runs["wrong_share"] > 0.05).to_numpy(),
    "remaining_share": lambda runs: (runs["ate_rmse_m"] / runs["raw_ate_rmse_m"]).to_numpy(),
    "growth_beyond_drift_m_s": lambda runs: (runs["growth_lost_m_s"] - runs["raw_growth_lost_m_s"]).to_numpy(),
}
"""Metrics of the runs that follow from their columns. ``converged_wrongly``: more than 5 % of the scans
with pairs ended too far off, notebook 04's rule; ``remaining_share``: corrected by uncorrected error;
``growth_beyond_drift_m_s``: growth of the error while no bar is matched, less that of the drift at the same scans."""
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
    by: Annotated[list[str], Field(min_length=1)] = ["trajectory", "noise", "variant"]  # noqa: RUF012

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
    """A claim's verdict, and the numbers that it rests on.

    ``cells`` has a row for each cell: its values of ``by``, ``estimate``, ``low``, ``high``, ``n_seeds`` and
    ``verdict``, by its 95 % interval. A claim that was not run has no cells; ``missing`` says what is.
    """

    id: str
    claim: Claim
    verdict: str
    cells: pd.DataFrame
    missing: str = ""

    @property
    def n_seeds(self) -> int:
        """The most seeds of a cell."""
        return int(self.cells["n_seeds"].max()) if len(self.cells) else 0

    @property
    def where(self) -> str:
        """The cells as claimed, where they are neither none nor all."""
        return describe_cells(self.cells, self.claim.by) if len(set(self.cells["verdict"]) | {HOLDS}) > 1 else ""


def read_claims(path: Path) -> dict[str, Claim]:
    """The claims of a file, by name. Raises `InputError`."""
    return read_tables(path, Claim, "a file of claims")


def judge_all(claims: dict[str, Claim], runs: pd.DataFrame) -> list[Verdict]:
    """A verdict on each claim, `NOT_RUN` where the runs lack what it is about."""
    verdicts = []
    for name, claim in claims.items():
        try:
            verdicts.append(judge(name, claim, runs))
        except InputError as fault:
            missing = str(fault).removeprefix(f"[{name}]: ").partition(";")[0]
            cells = pd.DataFrame(columns=[*claim.by, "estimate", "low", "high", "n_seeds", "verdict"])
            verdicts.append(Verdict(name, claim, NOT_RUN, cells, missing))
    return verdicts


def judge(name: str, claim: Claim, runs: pd.DataFrame) -> Verdict:
    """Estimate what a claim is about over the seeds of some runs, in each cell.

    A claim speaks of all its cells: it `HOLDS` if the whole interval is as claimed in every one, it `FAILS` if no part
    of it is in one, and is `OPEN` otherwise. A cell in which fewer than two seeds have a number says nothing. Raises
    `InputError`.
    """
    good = runs[runs["status"] == "ok"]
    first = _select(name, good, {**USUAL, **claim.where, **claim.a})
    rows = []
    for cell in dict.fromkeys(zip(*(first[column] for column in claim.by), strict=True)):
        at = dict(zip(claim.by, cell, strict=True))
        here = first[np.logical_and.reduce([first[column] == value for column, value in at.items()])]
        sides = [_by_seed(name, here, claim.metric)]
        if claim.form != "level":
            other = {key: value for key, value in claim.b.items() if key != "metric"}
            there = _select(name, good, {**USUAL, **claim.where, **claim.a, **at, **other})
            sides.append(_by_seed(name, there, str(claim.b.get("metric", claim.metric))))
        values = pd.concat(sides, axis=1, join="inner").to_numpy()
        values = values[np.isfinite(values).all(axis=1)]
        if len(values) >= (4 if claim.form == "correlation" else 2):
            estimate, low, high = interval(claim.form, values)
            word = HOLDS if claim.satisfied(low, high) else FAILS if claim.outside(low, high) else OPEN
            rows.append((*map(str, cell), estimate, low, high, len(values), word))
    if not rows:
        raise InputError(f"[{name}]: fewer than two seeds have a number; expected runs of more seeds")
    cells = pd.DataFrame(rows, columns=[*claim.by, "estimate", "low", "high", "n_seeds", "verdict"])
    found = set(cells["verdict"])
    return Verdict(name, claim, HOLDS if found == {HOLDS} else FAILS if FAILS in found else OPEN, cells)


def interval(form: str, values: Array) -> tuple[float, float, float]:
    """The number of some seeds ``values (seed, side)`` and its 95 % interval.

    Student's t for means, exact for shares (Clopper and Pearson 1934), Fisher's z for Spearman's rank correlation,
    which is 0 ± 0 where a side is constant; without width where all seeds are alike.
    """
    a, b = values[:, 0], values[:, -1]
    if form == "correlation":
        if min(np.ptp(a), np.ptp(b)) < 1e-12:
            return 0.0, 0.0, 0.0
        ranked = stats.pearsonr(stats.rankdata(a), stats.rankdata(b))
        rank = ranked.confidence_interval(CONFIDENCE)
        return float(ranked.statistic), float(rank.low), float(rank.high)
    if form == "level" and np.isin(a, (0.0, 1.0)).all():
        share = stats.binomtest(int(a.sum()), len(a)).proportion_ci(CONFIDENCE)
        return float(a.mean()), float(share.low), float(share.high)
    number = a - b if form == "difference" else a / b if form == "ratio" else a
    mean = float(number.mean())
    if np.ptp(number) < 1e-12:
        return mean, mean, mean
    around = stats.ttest_1samp(number, 0.0).confidence_interval(CONFIDENCE)
    return mean, float(around.low), float(around.high)


def verdict_table(verdicts: Sequence[Verdict]) -> pd.DataFrame:
    """One row a claim, as the README shows them: the ``lowest`` and ``highest`` estimate of its cells, how many these
    are, in how many the number is as claimed and in how many it is not, and ``where`` it is."""
    return pd.DataFrame(
        {
            "claim": each.claim.claim,
            "section": each.claim.section,
            "metric": each.claim.measure,
            "lowest": each.cells["estimate"].min(),
            "highest": each.cells["estimate"].max(),
            "n_seeds": each.n_seeds,
            "cells": len(each.cells),
            "as_claimed": int((each.cells["verdict"] == HOLDS).sum()),
            "not_as_claimed": int((each.cells["verdict"] == FAILS).sum()),
            "verdict": each.verdict,
            "where": each.where or each.missing,
        }
        for each in verdicts
    )


def verdict_metrics(verdicts: Sequence[Verdict]) -> dict[str, float]:
    """The finite numbers of all verdicts in one flat map, ``<name>.<lowest, highest, n_seeds, …>``."""
    rows = verdict_table(verdicts).set_index(pd.Index([each.id for each in verdicts]))
    return flat(rows, columns=("lowest", "highest", "n_seeds", "cells", "as_claimed", "not_as_claimed"))


def describe_cells(cells: pd.DataFrame, by: Sequence[str]) -> str:
    """The cells in which a claim holds, by the fewest columns that tell them from the others."""
    holding = cells[cells["verdict"] == HOLDS]
    choices = [list(names) for count in range(1, len(by)) for names in itertools.combinations(by, count)]
    enough = (n for n in choices if len(cells.merge(holding[n].drop_duplicates(), on=n)) == len(holding))
    rows = holding[next(enough, list(by))].drop_duplicates()
    return "; ".join(cell_name(row) for row in rows.itertuples(index=False))


def cell_name(values: Iterable[str]) -> str:
    """A cell by its values; settings without their table: ``zigzag, random-walk, waist_width_m=2.4``."""
    return ", ".join(re.sub(r"\w+\.(?=\w+=)", "", value) for value in values if value) or "as preset"


def _select(name: str, runs: pd.DataFrame, chosen: dict[str, Any]) -> pd.DataFrame:
    """The runs with some values, or one of some, in each column. Raises `InputError` if there are none."""
    for column, value in chosen.items():
        wanted = value if isinstance(value, list) else [value]
        runs = runs[runs[column].isin(wanted)]
        if runs.empty:
            raise InputError(f"[{name}]: no runs with {column} = {value!r}; expected a value that the study has")
    return runs


def _by_seed(name: str, runs: pd.DataFrame, metric: str) -> pd.Series:
    """A metric by seed, a mean where a seed has several runs. Raises `InputError` for an unknown one."""
    if metric in DERIVED:
        try:
            values = pd.Series(DERIVED[metric](runs), index=runs["seed"].to_numpy(), dtype=float)
        except KeyError as missing:
            raise InputError(f"[{name}]: no column {missing}; expected a number that runs have") from None
    elif metric in runs and pd.api.types.is_numeric_dtype(runs[metric]):
        values = pd.Series(runs[metric].to_numpy(dtype=float), index=runs["seed"].to_numpy())
    else:
        raise InputError(f"[{name}]: metric = {metric!r}: expected a number that runs have")
    return values.groupby(level=0).mean()
