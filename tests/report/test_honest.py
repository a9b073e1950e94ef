"""`report.honest`: range errors on steel alone, Allan deviations of known processes, and runs that are comparable."""

import numpy as np
import pandas as pd
import pytest

from steelnb.report import honest
from steelnb.report.results import find_root
from steelnb.runs import read_grids
from steelnb.settings import ImuSettings


@pytest.fixture(scope="module")
def errors():
    return honest.range_errors("zigzag", 1, 0.4)


def test_each_fault_alone_does_what_it_is_named_after(errors):
    table = honest.error_table(errors).set_index("fault")
    assert list(table.index) == [honest.NOISE, honest.AMPLITUDE, *honest.FAULTS, honest.ALL]
    assert table.loc[honest.NOISE, "lost_share"] == 0
    assert table.loc[honest.AMPLITUDE, "lost_share"] > 0.1
    assert table.loc["wiggling", "p95_mm"] == pytest.approx(5.0, abs=0.1)  # its amplitude
    assert table.loc["multipath", "mean_mm"] > 1  # ranges come out too long
    assert table.loc["footprint: mixed pixels", "mean_mm"] < -1  # what is near returns more light
    assert table.loc[honest.ALL, "median_mm"] > table.loc[honest.NOISE, "median_mm"]


def test_only_steel_counts(errors):
    shape = {error_m.shape for error_m in errors.values()}
    assert shape == {(2, 240, 180)}
    on_steel = ~np.isnan(errors[honest.NOISE])
    assert 0.02 < on_steel.mean() < 0.3  # the ground fills the lower half of these images
    assert not on_steel[:, -40:].any()


def test_the_allan_deviation_of_white_noise_and_of_a_walk():
    random, step_s, tau_s = np.random.default_rng(3), 0.01, np.array([0.01, 0.1, 1.0, 10.0])
    white = 0.2 / np.sqrt(step_s) * random.standard_normal((400_000, 3))
    walk = np.cumsum(0.05 * np.sqrt(step_s) * random.standard_normal((400_000, 3)), axis=0)
    np.testing.assert_allclose(honest.allan_deviation(white, step_s, tau_s), 0.2 / np.sqrt(tau_s), rtol=0.05)
    np.testing.assert_allclose(
        honest.allan_deviation(walk, step_s, tau_s[1:]), 0.05 * np.sqrt(tau_s[1:] / 3), rtol=0.05
    )


def test_the_simulated_imu_is_that_of_its_settings():
    settings = ImuSettings.preset(honest.HONEST)
    assert settings is not None
    table = honest.imu_table(settings, 1, 900.0)
    short = table[table["tau_s"] < 5]
    for name in ("gyro", "accelerometer"):
        np.testing.assert_allclose(short[name], short[f"{name}_settings"], rtol=0.05)


def row(sensor, variant="", method="best", seed=1, ate_m=0.02, **changed):
    usual = {"trajectory": "zigzag", "noise": "random-walk", "variant": variant, "blind": "", "status": "ok"}
    numbers = {"duration_s": 200.0, "ate_rmse_m": ate_m, "raw_ate_rmse_m": 0.4}
    return {**usual, "sensor": sensor, "method": method, "seed": seed, **numbers, **changed}


def test_runs_that_differ_in_more_than_the_sensor_are_left_out():
    runs = pd.DataFrame(
        [
            row(honest.IDEAL), row(honest.HONEST, ate_m=0.06), row(honest.HONEST, seed=2, ate_m=0.1),
            row(honest.IDEAL, method="faces"), row(honest.HONEST, noise="random-walk+tilt"),
            row(honest.IDEAL, variant="flight.standoff_m=2"), row(honest.HONEST, status="failed"),
            row(honest.HONEST, duration_s=20.0), row("report-4cm"), row(honest.IDEAL, blind="60-65"),
            row(honest.HONEST, variant=honest.BEFORE, ate_m=0.3), row(honest.IDEAL, variant=honest.BEFORE),
        ]
    )  # fmt: skip
    found = honest.honest_runs(runs)
    assert found.sort_index()["case"].to_dict() == {
        0: "ideal",
        1: "honest",
        2: "honest",
        10: "honest, ideal's settings",
    }


def test_the_study_runs_the_cases_that_are_compared():
    plan = read_grids(find_root() / "notebooks" / "study.toml")
    flown = {(run.settings.sensor, run.variant) for run in plan}
    assert set(honest.CASES) <= flown


def test_the_figures_show_both_sensors(errors):
    frame = honest.figure_frame(errors)
    assert [panel.get_title() for panel in frame.axes[:2]] == ["ideal", "honest"]
    assert len(frame.axes[2].lines) == len(errors)
