"""The table of other worlds, from made-up runs."""

import pandas as pd
import pytest

from steelnb.report.worlds import figure_worlds, world_of, world_runs, world_table, worlds_sentence

NARROW = "tower.base_width_m=1.6"


def run(variant="", method="best", seed=1, ate_m=0.02, noise="random-walk", sensor="starling2", **more):
    row = {
        "trajectory": "orbit", "noise": noise, "sensor": sensor, "duration_s": 200.0, "variant": variant, "blind": "",
        "method": method, "seed": seed, "status": "ok", "ate_rmse_m": ate_m, "raw_ate_rmse_m": 0.3,
    }  # fmt: skip
    return row | more


def flown() -> pd.DataFrame:
    rows = [run(seed=seed, ate_m=0.01 * seed) for seed in (1, 2)]
    rows += [run(NARROW, seed=seed, ate_m=1.0) for seed in (1, 2)]
    rows += [run("flight.standoff_m=2.4", ate_m=0.05), run(noise="random-walk+tilt", ate_m=0.08)]
    rows += [run(sensor="report", ate_m=0.04), run(sensor="report", method="icp"), run(NARROW, blind="60-65 s")]
    rows += [run(trajectory="vertical"), run(noise="constant-drift"), run(seed=9, status="failed")]
    return pd.DataFrame(rows)


def test_worlds_are_named_for_readers():
    assert world_of("flight.standoff_m=2.4", "random-walk", "starling2", "orbit") == "stand-off + 1 m"
    assert world_of("flight.standoff_m=2.1", "random-walk", "starling2", "vertical") == "stand-off + 1 m"
    assert world_of("", "random-walk+tilt", "starling2", "orbit") == "roll and pitch off by 1°"
    estimated = world_of("tilt_sigma_rad=0.0175", "random-walk+tilt", "starling2", "orbit")
    assert estimated == "roll and pitch off by 1°, estimated"
    assert world_of("", "random-walk", "starling2", "orbit") == "as preset"
    assert world_of("", "random-walk", "report", "orbit") == "the report's sensor"
    assert world_of("", "random-walk", "starling2-honest", "orbit") == "a sensor with all faults of real ones"
    assert world_of("hough.dx_m=3", "random-walk", "report", "orbit") == "hough.dx_m=3"


def test_a_world_in_which_the_correction_is_worse_than_the_drift_is_named():
    runs = world_runs(flown(), "orbit")
    assert len(runs) == 7, "one flight, random walk, methods of both sensors, ended well, always in sight"
    table = world_table(runs).set_index("world")
    order = ["as preset", "roll and pitch off by 1°", "stand-off + 1 m", "tower 1.6 m wide at the base"]
    assert table.index.tolist() == [*order, "the report's sensor"]
    assert table["ate_mean_m"].tolist() == pytest.approx([0.015, 0.08, 0.05, 1.0, 0.04])
    assert table["worse_than_drift"].tolist() == [0, 0, 0, 2, 0]
    text = worlds_sentence(world_table(runs))
    assert text.startswith(
        "Mean ATE in the other worlds: best: 4.0 to 100.0 cm. Worse than the drift: best with tower 1.6"
    )
    assert "(2 of 2 seeds, 100 cm against 30)" in text
    assert worlds_sentence(world_table(runs[runs["variant"] != NARROW])).endswith("None is worse than the drift.")


def test_the_figure_has_a_row_a_world_and_a_dot_a_run():
    runs = world_runs(flown(), "orbit")
    (panel,) = figure_worlds(runs).axes
    assert [label.get_text() for label in panel.get_yticklabels()] == list(world_table(runs)["world"])
    dots = [line for line in panel.lines if line.get_marker() == "o"]
    assert sorted(x for line in dots for x in line.get_xdata()) == pytest.approx([1, 2, 4, 5, 8, 100, 100])
