"""Claims of notebook 12: for each, an estimate from the runs of a study, its confidence interval and a verdict."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field, model_validator
from scipy import stats

from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.metrics import WRONG_SHARE
from steelnb.notebook.cases import RUN_COLUMNS
from steelnb.plots import LABELS
from steelnb.settings import Settings, read_tables
from steelnb.settings.report_plots import SENSOR_STEPS, STEP_S

HOLDS, FAILS, OPEN, NOT_RUN = "holds", "does not hold", "inconclusive", "not run"
CONFIDENCE = 0.95
UNITS = {"_m_s": "m/s", "_m": "m", "_deg": "°", "_ms": "ms", "_s": "s"}
USUAL: dict[str, Any] = {"sensor": "report", "duration_s": 240.0, "variant": ""}
"""Values of the runs that a claim is about, unless its ``where`` says otherwise."""
DERIVED: dict[str, Callable[[pd.DataFrame], Any]] = {
    "raw_at_180_s_m": lambda runs: [
        np.interp(180.0, time, error) if time[-1] >= 179.0 else np.nan
        for time, error in zip(runs["curve_time_s"], runs["curve_raw_m"], strict=True)
    ],
    "converged_wrongly": lambda runs: runs["wrong_share"] > WRONG_SHARE,
    "growth_beyond_drift_m_s": lambda runs: runs["growth_lost_m_s"] - runs["raw_growth_lost_m_s"],
    "scan_missed": lambda runs: np.where(runs["scan_s"].isna(), np.nan, runs["scan_s"] > 1.5 * SENSOR_STEPS * STEP_S),
}
"""Metrics derived from the columns of the runs. ``converged_wrongly``: ``wrong_share`` exceeds `metrics.WRONG_SHARE`;
``growth_beyond_drift_m_s``: growth rate of the error at scans without correspondences, less that of the drift at the
same scans; ``scan_missed``: the next scan came before the program was done with this one."""
WORDS = {
    "raw_at_180_s_m": "drift after 180 s", "ate_rmse_m": "root mean square error", "error_mean_m": "mean error",
    "lost_share": "share of scans without a match", "growth_beyond_drift_m_s": "growth of the error beyond the drift's",
    "wrong_share": "share of scans more than 25 cm off", "converged_wrongly": "share of flights that went wrong",
    "segment_recall": "recall of the map", "segment_precision": "precision of the map", "bend_deg": "bend",
    "turned_mean_deg": "mean rotation", "turned_final_deg": "final rotation", "scan_s": "time for a scan",
    "scan_missed": "share of scans after which one was missed", "frame_median_ms": "time for a scan",
    "f1": "F1 score", "recall": "recall", "precision": "precision", "offset_m": "median distance to the true axis",
    "right": "share of scans that end at their true pose", "raw_ate_rmse_m": "root mean square drift",
}  # fmt: skip
"""What tables and figures call the metrics."""
COLUMNS = [
    "name", "topic", "claim", "section", "measure", "cell", "estimate", "low", "high", "n_seeds", "threshold",
    "threshold_to", "verdict",
]  # fmt: skip
Chosen = dict[str, str | float | list[str]]


class Claim(Settings):
    """One table of the claims' file.

    The ``metric`` is taken from the runs that match ``where``, for each cell of ``by`` and each seed. ``form`` makes it
    a number: its mean ``level``, its mean ``difference`` between the runs ``a`` and the runs ``b`` of the same seed,
    the ``ratio`` of their means, or its rank ``correlation`` over the seeds with the metric that ``b`` names. The claim
    is that this number is ``below`` or ``above`` the ``threshold``, or ``between`` two of them. Claims of one ``topic``
    share a figure.
    """

    topic: str
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
            if name not in RUN_COLUMNS and (name != "metric" or name in (*self.by, *self.where, *self.a)):
                raise ValueError(f"unknown column {name!r}; expected one of {', '.join(RUN_COLUMNS)}")
        if len(self.threshold) != (2 if self.comparison == "between" else 1):
            raise ValueError(f"threshold = {self.threshold}: expected two numbers for 'between', else one")
        if (self.form == "level") == bool(self.b) or (self.form == "correlation" and "metric" not in self.b):
            raise ValueError("b: a level has none, a difference or ratio names runs, a correlation a metric")
        return self

    def verdict(self, low: float, high: float) -> str:
        """`HOLDS` if all of an interval is as claimed, `FAILS` if no part of it is, else `OPEN`."""
        first, last = self.threshold[0], self.threshold[-1]
        if self.comparison == "between":
            inside, outside = first <= low and high <= last, high < first or last < low
        else:
            under, over = high < first, low > first
            inside, outside = (under, over) if self.comparison == "below" else (over, under)
        return HOLDS if inside else FAILS if outside else OPEN

    @property
    def measure(self) -> str:
        """The metric in `WORDS`, both sides and the unit, ``mean error, GICP − ICP (m)``; a ratio or correlation has no
        unit."""
        word, other = (WORDS.get(name, name) for name in (self.metric, str(self.b.get("metric"))))
        unit = next((f" ({unit})" for ending, unit in UNITS.items() if self.metric.endswith(ending)), "")
        if self.form == "level":
            return word + unit
        if self.form == "correlation":
            return f"{word}, rank correlation with {other}"
        sign = " − " if self.form == "difference" else " / "
        text = word + sign + other if "metric" in self.b else f"{word}, {sign.join(map(self._named, (self.a, self.b)))}"
        return text + (unit if self.form == "difference" else "")

    def _named(self, side: Chosen) -> str:
        """The value that tells this side from the other; ``each`` if the cells name it."""
        value = {**USUAL, **self.where, **side}[next(iter(self.b))]
        return "each" if isinstance(value, list) else LABELS.get(str(value), str(value)) or "as preset"


def read_claims(path: Path) -> dict[str, Claim]:
    """The claims of a file, by name. Raises `InputError`."""
    return read_tables(path, Claim, "a file of claims")


def judge(claims: dict[str, Claim], runs: pd.DataFrame) -> pd.DataFrame:
    """Estimate what each claim is about over the seeds of some runs: one row per claim and cell.

    The columns are ``name``, ``topic``, ``claim``, ``section``, ``measure``, ``cell`` (its values of ``by`` as text),
    ``estimate`` with its 95 % interval from ``low`` to ``high``, ``n_seeds``, ``threshold`` and, for a range,
    ``threshold_to``, and its `Claim.verdict`. A claim whose runs are missing has one row, `NOT_RUN`, whose ``cell``
    says what is missing.
    """
    good, rows = runs[runs["status"] == "ok"], []
    for name, claim in claims.items():
        limits = dict(zip(("threshold", "threshold_to"), claim.threshold, strict=False))
        named = {**claim.model_dump(include={"topic", "claim", "section"}), "measure": claim.measure, **limits}
        try:
            cells = claim_cells(claim, good)
        except InputError as fault:
            cells = [{"cell": str(fault).partition(";")[0], "n_seeds": 0, "verdict": NOT_RUN}]
        rows += [{"name": name, **named, **cell} for cell in cells]
    return pd.DataFrame(rows, columns=COLUMNS)


def claim_cells(claim: Claim, runs: pd.DataFrame) -> list[dict[str, Any]]:
    """The cells of one claim, as the rows of `judge`. A cell needs at least two seeds with a number, for a correlation
    four. Raises `InputError` if no cell has them."""
    chosen, rows = {**USUAL, **claim.where, **claim.a}, []
    for cell, here in _select(runs, chosen).groupby(claim.by, sort=False):
        at = dict(zip(claim.by, cell, strict=True))
        sides = [_by_seed(here, claim.metric)]
        if claim.form != "level":
            other = {key: value for key, value in claim.b.items() if key != "metric"}
            there = _select(runs, {**chosen, **at, **other})
            sides.append(_by_seed(there, str(claim.b.get("metric", claim.metric))))
        values = pd.concat(sides, axis=1, join="inner").to_numpy()
        values = values[np.isfinite(values).all(axis=1)]
        if len(values) >= (4 if claim.form == "correlation" else 2):
            estimate, low, high = interval(claim.form, values)
            name = ", ".join(str(value) for value in cell if value) or "as preset"
            numbers = {"estimate": estimate, "low": low, "high": high, "n_seeds": len(values)}
            rows.append({"cell": name, **numbers, "verdict": claim.verdict(low, high)})
    if not rows:
        raise InputError("fewer than two seeds have a number; expected runs of more seeds")
    return rows


def interval(form: str, values: Array) -> tuple[float, float, float]:
    """The number of some seeds ``values (seed, side)`` and its 95 % interval.

    Student's t for means, of zero width if all seeds agree; Fieller's (1954) for ratios of means; exact for shares
    (Clopper and Pearson 1934); Fisher's z for Spearman's rank correlation, which is 0 ± 0 if a side is constant.
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
    if form == "ratio":
        return _ratio(a, b)
    number = a - b if form == "difference" else a
    mean = float(number.mean())
    if np.ptp(number) < 1e-12:
        return mean, mean, mean
    around = stats.ttest_1samp(number, 0.0).confidence_interval(CONFIDENCE)
    return mean, float(around.low), float(around.high)


def _ratio(a: Array, b: Array) -> tuple[float, float, float]:
    """The ratio of two means over the same seeds and its interval: all numbers r for which the mean of a − r b is
    compatible with 0. It is unbounded if the mean of b is."""
    t = float(stats.t.ppf(0.5 + CONFIDENCE / 2, len(a) - 1))
    (aa, ab), (_, bb) = t**2 * np.cov(a, b) / len(a)
    mean_a, mean_b = float(a.mean()), float(b.mean())
    square, middle = mean_b**2 - bb, mean_a * mean_b - ab
    if square <= 0:
        return (mean_a / mean_b if mean_b else np.nan), -np.inf, np.inf
    root = max(middle**2 - square * (mean_a**2 - aa), 0.0) ** 0.5
    return mean_a / mean_b, float((middle - root) / square), float((middle + root) / square)


def verdict_table(cells: pd.DataFrame) -> pd.DataFrame:
    """One row per claim, from the cells of `judge`: the ``lowest`` and ``highest`` estimate, the largest ``n_seeds``,
    the number of ``cells``, and how many are ``as_claimed`` and ``not_as_claimed``.

    A claim is about all its cells: it `HOLDS` if every cell does, it `FAILS` if one does, and is `OPEN` otherwise.
    """
    counts = {"as_claimed": HOLDS, "not_as_claimed": FAILS, "not_run": NOT_RUN}
    counted = cells.assign(**{name: cells["verdict"] == verdict for name, verdict in counts.items()})
    table = counted.groupby(["name", "topic", "claim", "section", "measure"], sort=False, as_index=False).agg(
        lowest=("estimate", "min"), highest=("estimate", "max"), n_seeds=("n_seeds", "max"), cells=("cell", "size"),
        **{name: (name, "sum") for name in counts},
    )  # fmt: skip
    found = [table["not_run"] > 0, table["not_as_claimed"] > 0, table["as_claimed"] == table["cells"]]
    return table.assign(verdict=np.select(found, [NOT_RUN, FAILS, HOLDS], OPEN)).drop(columns="not_run")


def _select(runs: pd.DataFrame, chosen: dict[str, Any]) -> pd.DataFrame:
    """The runs with the chosen value, or one of several, in each column. Raises `InputError` if there are none."""
    for column, value in chosen.items():
        wanted = value if isinstance(value, list) else [value]
        runs = runs[runs[column].isin(wanted)]
        if runs.empty:
            raise InputError(f"no runs with {column} = {value!r}; expected a value that the study has")
    return runs


def _by_seed(runs: pd.DataFrame, metric: str) -> pd.Series:
    """A metric by seed, averaged over the runs of a seed. Raises `InputError` for an unknown metric."""
    try:
        values = np.asarray(DERIVED.get(metric, lambda rows: rows[metric])(runs), dtype=float)
    except (KeyError, ValueError):
        raise InputError(f"metric = {metric!r}: expected a number that runs have") from None
    return pd.Series(values, index=runs["seed"].to_numpy()).groupby(level=0).mean()
