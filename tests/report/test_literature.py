import itertools

import numpy as np
import pandas as pd
import pytest

from steelnb.report import literature

ATE_MM = {"loam": 120.0, "loam-midlines": 12.0, "best": 24.0, "combined": 8.0, "orb": 9.0}


@pytest.fixture
def study():
    """Rows of a study in any order, and some that do not belong to it."""
    cases = itertools.product(("orbit", "vertical"), ("random-walk", "constant-drift"), (22, 21), ATE_MM)
    rows = [
        {"sensor": "starling2", "trajectory": flight, "noise": noise, "seed": seed, "method": method, "variant": "",
         "blind": "", "status": "ok", "duration_s": 200.0, "raw_ate_rmse_m": 0.4,
         "ate_rmse_m": 1e-3 * ATE_MM[method] * (1.5 if seed == 22 else 0.5)}
        for flight, noise, seed, method in cases
    ]  # fmt: skip
    lost = [{**row, "sensor": "report", "ate_rmse_m": 0.39} for row in rows if row["method"] == "loam"]
    others = [
        {**rows[0], "variant": "clouds.dof=se3"}, {**rows[0], "blind": "60-65"}, {**rows[0], "status": "failed"},
        {**rows[0], "duration_s": 40.0}, {**rows[0], "trajectory": "planned"}, {**rows[0], "method": "icp"},
    ]  # fmt: skip
    return pd.DataFrame([*lost, *rows, *others])


def chosen(study):
    noises, methods = ["random-walk", "constant-drift"], ["orb", "loam", "loam-midlines", "best", "combined"]
    return literature.literature_runs(study, ["starling2", "report"], noises, methods)


def test_runs_are_whole_flights_in_the_order_asked_for(study):
    runs = chosen(study)
    assert len(runs) == 48
    assert (runs["ate_rmse_m"] > 0).all()
    assert list(dict.fromkeys(runs["sensor"])) == ["starling2", "report"]
    assert list(dict.fromkeys(runs["trajectory"])) == ["vertical", "orbit"]
    assert list(dict.fromkeys(runs["method"])) == ["orb", "loam", "loam-midlines", "best", "combined"]
    assert runs["seed"].iloc[:2].tolist() == [21, 22]


def test_the_table_has_mean_and_worst_of_the_seeds(study):
    table = literature.literature_table(chosen(study))
    assert len(table) == 24
    row = table[(table["method"] == "best") & (table["trajectory"] == "orbit")].iloc[0]
    assert (row["seeds"], row["noise"]) == (2, "random-walk")
    np.testing.assert_allclose(row[["ate_mean_m", "ate_worst_m", "raw_ate_mean_m"]].astype(float), [0.024, 0.036, 0.4])


def test_sentences_say_how_far_off_beside_the_others_and_what_is_lost(study):
    runs = chosen(study)
    alone = runs[runs["method"] == "best"].assign(seed=23, ate_rmse_m=9.0)  # a seed that no other flew
    said = literature.literature_sentences(pd.concat([runs, alone])).splitlines()
    assert len(said) == 4
    midlines = next(line for line in said if "midlines" in line)
    assert "12 to 12 mm" in midlines
    assert "0.5 times that of best" in midlines
    assert "1.5 times that of combined" in midlines
    assert "no better than the drift" not in midlines
    assert "in 4 of 4 cases it is no better than the drift" in next(line for line in said if "the report's" in line)


def test_the_figure_has_a_panel_for_each_flight_and_sensor_and_every_run_in_it(study):
    runs = chosen(study)
    figure = literature.figure_literature(runs)
    assert len(figure.axes) == 4
    dots = sum(
        len(line.get_xdata()) for panel in figure.axes for line in panel.lines if line.get_linestyle() == "None"
    )  # fmt: skip
    assert dots == len(runs)
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()][1] == "LOAM"
