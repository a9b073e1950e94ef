import dataclasses

import numpy as np
import pandas as pd
import pytest

from steelnb import batch, experiment
from steelnb.metrics import position_error_m
from steelnb.plots import LABELS
from steelnb.report import odometry_figures, structure_figures, world
from steelnb.settings import ExperimentSettings
from steelnb.types import Flight


@pytest.fixture(scope="module")
def runs():
    noises, methods = ["random-walk", "constant-drift:0.0004"], ["none", "average", "least_squares"]
    return batch.run_all(batch.make_cases(["zigzag"], "starling2", noises, methods, 3, 16.0))


def test_correction_beats_no_correction_and_least_squares_beats_the_average(runs):
    error = batch.table(runs).set_index(["noise", "method"])["error_mean_m"]
    for noise in ("random-walk", "constant-drift:0.0004"):
        assert error[noise, "average"] < 0.7 * error[noise, "none"]
        assert error[noise, "least_squares"] < 0.7 * error[noise, "average"]
    assert error.xs("least_squares", level="method").max() < 0.03


def test_the_map_is_better_with_correction(runs):
    table = batch.table(runs).set_index(["noise", "method"])
    drifting, corrected = (table.loc[("constant-drift:0.0004", method)] for method in ("none", "least_squares"))
    assert corrected["segment_precision"] > drifting["segment_precision"] + 0.2
    assert corrected["segment_recall"] > 0.6


def test_a_comparison_is_its_single_runs(runs):
    settings = ExperimentSettings.preset("zigzag", "random-walk", "least_squares", "starling2", 3, 16.0)
    seen = []
    alone = experiment.run(settings, seen.append)
    assert alone.metrics == runs[2].metrics
    np.testing.assert_array_equal(alone.corrected.T_world_drone, runs[2].corrected.T_world_drone)
    assert seen[-1] == 1.0
    assert seen == sorted(seen)


def test_the_flight_holds_no_truth():
    assert {field.name for field in dataclasses.fields(Flight)} == {
        "scans", "prior", "imu", "T_drone_sensor", "name", "facts", "skipped", "images"
    }  # fmt: skip
    settings = ExperimentSettings.preset(duration_s=2.0)
    flight, truth = experiment.simulate(settings)
    assert (
        np.abs(flight.prior.position[1:] - truth.trajectory.at(flight.scans.stamp_s).position[1:]).min(axis=1).max() > 0
    )


def test_tables_have_the_columns_that_others_read(runs):
    table = batch.table(runs)
    assert list(table.columns[:10]) == [
        "trajectory", "noise", "method", "sensor", "seed", "raw_ate_rmse_m", "raw_error_final_m", "ate_rmse_m",
        "error_mean_m", "error_max_m",
    ]  # fmt: skip
    assert "error_final_m" in table
    timing = batch.timing(runs)
    frames = timing[timing["stage"] == "frame"]
    assert len(frames) == len(runs)
    whole = [1e3 * np.median(np.sum(list(run.seconds.values()), axis=0)) for run in runs]
    assert frames["median_ms"].tolist() == pytest.approx(whole)
    assert all(np.isfinite(value) for value in batch.metrics(runs).values())


def test_drift_curves_agree_with_their_expectation():
    for noise in ("random-walk", "constant-drift", "yaw-random-walk", "random-walk+constant-drift"):
        stamp, errors = world.drift_curves(noise, range(150), 30.0)
        rms = np.sqrt((errors[:, -1] ** 2).mean())
        assert rms == pytest.approx(world.expected_drift(noise, stamp)[-1], rel=0.15)
    table = world.drift_table({"random-walk": world.drift_curves("random-walk", range(20), 60.0)}, every_s=20.0)
    assert table["time_s"].tolist() == [20.0, 40.0, 60.0]


def test_figures_show_every_curve_with_units(runs):
    figure = odometry_figures.figure_segment_errors(runs)
    panels = [axis for axis in figure.axes if axis.get_ylabel()]
    assert len(panels) == 2
    for panel, three in zip(panels, (runs[:3], runs[3:]), strict=True):
        lines = [line for line in panel.lines if len(line.get_ydata()) == 80]
        for line, run in zip(lines, three, strict=True):
            truth = run.truth.trajectory.at(run.corrected.stamp_s).position
            np.testing.assert_allclose(line.get_ydata(), np.linalg.norm(run.corrected.position - truth, axis=1))
        assert panel.get_ylabel() == "distance to the truth (m)"
    for panel, run in zip(structure_figures.figure_maps(runs[:3]).axes, runs[:3], strict=True):
        true, wrong, right = (len(lines.get_segments()) for lines in panel.collections)
        assert (true, wrong + right) == (len(run.truth.tower.members), len(run.segments))
        assert right / len(run.segments) == pytest.approx(run.metrics["segment_precision"])
    methods = [run.settings.odometry.method for run in runs[:3]]
    # Half of the most accurate run's median error, if that is less than 5 mm.
    least_m = min(0.005, *(0.5 * np.median(position_error_m(run.corrected, run.truth.trajectory)) for run in runs[:3]))
    for panel, run in zip(odometry_figures.figure_errors(runs[:3], [[m] for m in methods]).axes, runs[:3], strict=True):
        low, high = panel.get_ylim()
        assert (low, high) == (pytest.approx(least_m), 12.0), "all panels have one scale"
        assert max(line.get_ydata().max() for line in panel.lines) < high, "nothing leaves the panel"
        names = {line.get_label() for line in panel.lines}
        assert {"no correction", LABELS[run.settings.odometry.method]} <= names
    (panel,) = odometry_figures.figure_errors(runs[1:3], [methods], smoothed_s=2.0).axes
    shown = [LABELS[run.settings.odometry.method] for run in runs[:3]]
    assert [line.get_label() for line in panel.lines[:3]] == shown
    flown = {"zigzag": runs[0].truth.trajectory}
    assert world.figure_tower(runs[0].truth.tower, flown).axes[1].get_xlabel() == "x (m)"


def test_the_caption_of_a_figure_names_flights_noise_sensor_and_seeds(runs):
    s = runs[0].settings
    flight = f"{s.flight.trajectory} flight, "
    assert batch.caption(runs[:2]) == f"{flight}{s.noise_name}, sensor {s.sensor}, seed {s.seed}"
    table = batch.table(runs)
    more = pd.concat([table, table.assign(seed=-1, tower="light")])
    assert batch.caption(more[["trajectory", "seed"]]) == f"{flight}2 seeds"
    assert batch.caption(more[-1:]).endswith("tower light, sensor " + s.sensor + ", seed -1")
