"""Intervals and tests over seeds, against tables and simulation."""

import numpy as np
import pytest
from scipy import stats

from steelnb.report.intervals import correlation_over_seeds, holm, mean_over_seeds, share_of_seeds


def test_an_interval_covers_the_truth_as_often_as_it_says():
    random = np.random.default_rng(3)
    samples = [mean_over_seeds(random.normal(size=30)) for _ in range(200)]
    covered = sum(each.low < 0 < each.high for each in samples)
    assert 0.88 <= covered / 200 <= 0.99  # 0.93 expected: thirty seeds are few
    rejected = sum(each.p_not_above(0.0) < 0.1 for each in samples)
    assert 0.05 <= rejected / 200 <= 0.16
    values = random.normal(size=30)
    assert mean_over_seeds(values).low == mean_over_seeds(values).low
    alike = mean_over_seeds(np.full(5, 0.7))
    assert (alike.low, alike.estimate, alike.high) == (0.7, 0.7, 0.7)
    assert (alike.p_not_above(0.6), alike.p_not_above(0.7), alike.p_not_below(0.7)) == (0.0, 1.0, 1.0)


def test_a_share_of_seeds_has_the_exact_binomial_interval():
    happened = np.zeros(30)
    found = share_of_seeds(happened)
    assert (found.estimate, found.low, found.high) == pytest.approx((0, 0, 1 - 0.025 ** (1 / 30)))
    assert found.p_not_below(0.1) == pytest.approx(0.9**30)
    happened[7] = 1
    # Clopper and Pearson's tables, 1 of 30.
    assert share_of_seeds(happened)[:3] == pytest.approx((1 / 30, 0.000844, 0.1722), abs=5e-5)


def test_a_correlation_has_an_interval_that_covers_it_and_a_test_of_independence():
    random = np.random.default_rng(4)
    covered = rejected = 0
    for _ in range(300):
        a = random.normal(size=30)
        found = correlation_over_seeds(a, 0.6 * a + 0.8 * random.normal(size=30))
        covered += found.low < 6 / np.pi * np.arcsin(0.3) < found.high  # Spearman's of a normal pair
        rejected += correlation_over_seeds(a, random.normal(size=30)).p_not_above(0.0) < 0.05
    assert 0.9 <= covered / 300 <= 0.98
    assert 0.02 <= rejected / 300 <= 0.09
    same = correlation_over_seeds(a, a)
    assert same.estimate == pytest.approx(1.0)
    assert same.p_not_above(0.0) < 1e-6
    assert correlation_over_seeds(a, np.ones(30)).estimate == 0.0


def test_holm_is_as_published_and_never_below_the_single_p_values():
    # Holm 1979: multiply the smallest by the number of tests, the next by one less, and never fall.
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([]) == []
    many = stats.uniform.rvs(size=50, random_state=1)
    assert (np.array(holm(many)) >= many).all()
    assert max(holm(many)) <= 1.0
