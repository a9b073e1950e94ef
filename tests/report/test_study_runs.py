"""Runs of a study that are compared, their tables and their figure, from made-up runs."""

import pandas as pd
import pytest

from steelnb.report.study_runs import figure_runs, over_seeds, whole_flights, world_of, world_runs

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


def test_worlds_are_named_for_readers():
    assert world_of("flight.standoff_m=2.4", "random-walk", "starling2", "loops") == "stand-off + 1 m"
    assert world_of("flight.standoff_m=2.1", "random-walk", "starling2", "zigzag") == "stand-off + 1 m"
    assert world_of("", "random-walk+tilt", "starling2", "loops") == "roll and pitch off by 1°"
    estimated = world_of("tilt_sigma_rad=0.0175", "random-walk+tilt", "starling2", "loops")
    assert estimated == "roll and pitch off by 1°, estimated"
    assert world_of("", "random-walk", "starling2", "loops") == "as preset"
    assert world_of("", "random-walk", "report-4cm", "loops") == "the report's sensor"
    assert world_of("", "random-walk", "starling2-honest", "loops") == "a sensor with all faults of real ones"
    assert world_of("hough.dx_m=3", "random-walk", "report-4cm", "loops") == "hough.dx_m=3"


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


def test_the_figure_has_a_row_a_world_and_a_dot_a_run():
    runs = world_runs(flown(), "loops")
    (panel,) = figure_runs(runs, "world", limits_m={"goal": 0.03}).axes
    assert [label.get_text() for label in panel.get_yticklabels()] == list(dict.fromkeys(runs["world"]))
    dots = [line for line in panel.lines if line.get_marker() == "o"]
    assert sorted(x for line in dots for x in line.get_xdata()) == pytest.approx([1, 2, 4, 5, 8, 100, 100])
    assert [line.get_xdata()[0] for line in panel.lines if line.get_linestyle() == "--"] == [3.0]


def test_panels_and_markers_tell_flights_sensors_and_noises_apart():
    runs = pd.DataFrame(
        [
            run(trajectory=flight, sensor=sensor, noise=noise, method=method)
            for flight in ("zigzag", "loops") for sensor in ("starling2", "report-4cm")
            for noise in ("random-walk", "constant-drift") for method in ("gicp", "icp")
        ]
    )  # fmt: skip
    figure = figure_runs(runs, "method", "noise", down="trajectory", across="sensor")
    assert [panel.get_title() for panel in figure.axes][:2] == ["zigzag, starling2", "zigzag, report-4cm"]
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["ICP", "GICP"]
    markers = [line.get_marker() for line in figure.axes[0].lines if line.get_linestyle() == "None"]
    assert markers == ["o", "^", "o", "^"]
