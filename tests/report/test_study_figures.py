"""Bands over the seeds of a study, from made-up runs."""

import numpy as np
import pandas as pd
import pytest

from steelnb.report.study_figures import percentile_bands


def curves(seeds=11, **case) -> pd.DataFrame:
    """Runs whose error is time through a hundred, times one to eleven."""
    time = np.linspace(0, 200, 101)
    usual = {"trajectory": "loops", "noise": "random-walk", "method": "icp", "sensor": "report-4cm", "status": "ok"}
    given = {**usual, **case}
    return pd.DataFrame(
        {
            **given,
            "seed": seed,
            "curve_time_s": time,
            "curve_raw_m": time / 50,
            "curve_error_m": time / 100 * (seed + 1),
        }
        for seed in range(seeds)
    )


def test_a_band_is_median_and_percentiles_over_the_seeds():
    time, (low, median, high) = percentile_bands(curves(), "curve_error_m")
    assert time[-1] == 200
    assert np.allclose(median, time / 100 * 6)
    assert np.allclose(low, time / 100 * 2)
    assert np.allclose(high, time / 100 * 10)


def test_a_flight_that_ended_early_is_left_out_after_its_end():
    runs = curves(3)
    for name in ("curve_time_s", "curve_error_m"):
        runs.at[2, name] = runs.at[2, name][:51]  # the worst seed, 100 s
    time, (_, median, _) = percentile_bands(runs, "curve_error_m")
    assert median[time == 100] == pytest.approx(2.0)
    assert median[-1] == pytest.approx(3.0)
