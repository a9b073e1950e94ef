"""Intervals and p-values of a number over the seeds of a study, and their correction for many tests."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from steelnb.types import Array

RESAMPLES = 9999
CONFIDENCE = 0.95


class Sample(NamedTuple):
    """A number, its 95 % interval, the seeds that it comes from, its kind and the value of each seed ``(N,)``."""

    estimate: float
    low: float
    high: float
    n_seeds: int
    kind: str
    values: Array

    def p_not_above(self, limit: float) -> float:
        """One-sided p-value of the hypothesis that the number does not exceed a limit: small where it clearly does.

        Student's t-test of a mean, the exact test of a share, Fisher's z of a correlation.
        """
        if self.kind == "share":
            return float(stats.binomtest(int(self.values.sum()), self.n_seeds, limit, "greater").pvalue)
        if self.kind == "constant":
            return 0.0 if self.estimate > limit else 1.0
        if self.kind == "correlation":
            apart = np.arctanh(np.clip(self.estimate, -0.999999, 0.999999)) - np.arctanh(limit)
            return float(special.ndtr(-apart / _spread(self.estimate, self.n_seeds)))
        return float(stats.ttest_1samp(self.values, limit, alternative="greater").pvalue)

    def p_not_below(self, limit: float) -> float:
        """The same for the hypothesis that the number is not less than a limit."""
        if self.kind == "share":
            return float(stats.binomtest(int(self.values.sum()), self.n_seeds, limit, "less").pvalue)
        if self.kind == "constant":
            return 0.0 if self.estimate < limit else 1.0
        return 1.0 - self.p_not_above(limit)


def share_of_seeds(values: Array) -> Sample:
    """Share of the seeds ``(N,)``, each 0 or 1, in which something happened, with the exact binomial interval (Clopper
    and Pearson 1934): a bootstrap of something rare reaches down to 0 although it happened."""
    exact = stats.binomtest(int(values.sum()), len(values)).proportion_ci(CONFIDENCE, method="exact")
    return Sample(float(values.mean()), float(exact.low), float(exact.high), len(values), "share", values)


def mean_over_seeds(values: Array) -> Sample:
    """Mean of one value a seed ``(N,)``, at least two, and its interval.

    By a bootstrap, bias-corrected and accelerated (Efron 1987), always with the same draws; without width where all
    seeds are alike.
    """
    n, mean = len(values), float(values.mean())
    if np.ptp(values) < 1e-12:
        return Sample(mean, mean, mean, n, "constant", values)
    interval = stats.bootstrap(
        (values,), np.mean, n_resamples=RESAMPLES, confidence_level=CONFIDENCE, rng=np.random.default_rng(0)
    ).confidence_interval
    return Sample(mean, float(interval.low), float(interval.high), n, "mean", values)


def correlation_over_seeds(a: Array, b: Array) -> Sample:
    """Spearman's rank correlation of two values a seed, each ``(N,)`` with N > 3, with its interval by Fisher's z and
    the variance of Bonett and Wright (Psychometrika 65, 2000); 0 ± 0 where a side is constant."""
    constant = np.ptp(a) < 1e-12 or np.ptp(b) < 1e-12
    estimate = 0.0 if constant else float(stats.spearmanr(a, b).statistic)
    reach = special.ndtri(0.5 + 0.5 * CONFIDENCE) * _spread(estimate, len(a))
    middle = np.arctanh(np.clip(estimate, -0.999999, 0.999999))
    low, high = np.tanh([middle - reach, middle + reach])
    return Sample(estimate, float(low), float(high), len(a), "correlation", a)


def holm(p_values: Sequence[float] | Array) -> list[float]:
    """P-values adjusted for being many (Holm, Scand. J. Statist. 6, 1979), in the order given."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p, kind="stable")
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1.0)
    return adjusted.tolist()


def _spread(correlation: float, n: int) -> float:
    return float(np.sqrt((1 + correlation**2 / 2) / max(n - 3, 1)))
