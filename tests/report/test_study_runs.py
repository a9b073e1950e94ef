"""Runs of a study that are compared, and their tables, from made-up runs."""

import pandas as pd
import pytest

from steelnb.report.study_runs import over_seeds, whole_flights, world_runs

NARROW = "tower.base_width_m=1.6"


def run(variant="", method="best", seed=1, ate_m=0.02, noise="random-walk", sensor="starling2", **more):
    row = {
        "trajectory": "loops", "noise": noise, "sensor": sensor, "duration_s": 200.0, "variant": variant, "blind": "",
        "method": method, "seed": seed, "status": "ok", "ate_rmse_m": ate_m, "raw_ate_rmse_m": 0.3,
    }  # fmt: skip
    return row | more


def flown() -> pd.DataFrame:
    rows = [run(seed=seed, ate_m=0.01 * seed) for seed in (1, 2)]
    rows += [run(NARROW, seed=seed, ate_m=1.0) for seed in (1, 2)]
    rows += [run("flight.standoff_m=2.4", ate_m=0.05), run(noise="random-walk+tilt", ate_m=0.08)]
    rows += [run(sensor="report-4cm", ate_m=0.04), run(sensor="report-4cm", method="icp"), run(NARROW, blind="60-65 s")]
    rows += [run(trajectory="zigzag"), run(noise="constant-drift"), run(seed=9, status="failed")]
    return pd.DataFrame(rows)


def test_runs_are_whole_flights_in_the_order_asked_for():
    runs = whole_flights(flown(), variant=[NARROW, ""], trajectory=["loops"], sensor=["report-4cm", "starling2"])
    assert runs["sensor"].tolist() == ["starling2"] * 2 + ["report-4cm"] * 2 + ["starling2"] * 4
    assert runs["seed"].tolist()[:2] == [1, 2]
    assert whole_flights(flown(), trajectory=["planned"]).empty


def test_the_worlds_of_one_flight_in_their_order_with_means_over_the_seeds():
    runs = world_runs(flown(), "loops")
    assert len(runs) == 7, "one flight, random walk, methods of both sensors, ended well, always in sight"
    table = over_seeds(runs, ["world", "method"]).set_index("world")
    order = ["as preset", "roll and pitch off by 1°", "stand-off + 1 m", "tower 1.6 m wide at the base"]
    assert table.index.tolist() == [*order, "the report's sensor"]
    assert table["ate_mean_m"].tolist() == pytest.approx([0.015, 0.08, 0.05, 1.0, 0.04])
    assert table["ate_worst_m"]["as preset"] == 0.02
    assert table["seeds"].tolist() == [2, 1, 1, 2, 1]
