import numpy as np
import pytest

from steelnb import experiment
from steelnb.notebook import report, tables
from steelnb.notebook.cases import grid
from steelnb.notebook.runs import run_all
from steelnb.settings import ExperimentSettings


@pytest.fixture(scope="module")
def runs():
    noises, methods = ["random-walk", "constant-drift:0.0004"], ["none", "average", "least_squares"]
    flown = {"seeds": [3], "trajectories": ["zigzag"], "sensors": ["starling2"], "duration_s": 11.0}
    return run_all([run.settings for run in grid(noises=noises, methods=methods, **flown)])


def test_correction_beats_no_correction_and_least_squares_beats_the_average(runs):
    error = tables.table(runs).set_index(["noise", "method"])["error_mean_m"]
    for noise in ("random-walk", "constant-drift:0.0004"):
        assert error[noise, "average"] < 0.7 * error[noise, "none"]
        assert error[noise, "least_squares"] < 0.7 * error[noise, "average"]
    assert error.xs("least_squares", level="method").max() < 0.03


def test_the_map_is_better_with_correction(runs):
    table = tables.table(runs).set_index(["noise", "method"])
    drifting, corrected = (table.loc[("constant-drift:0.0004", method)] for method in ("none", "least_squares"))
    assert corrected["segment_precision"] > drifting["segment_precision"] + 0.2
    assert corrected["segment_recall"] > 0.6


def test_a_comparison_is_its_single_runs(runs):
    settings = ExperimentSettings.preset("zigzag", "random-walk", "least_squares", "starling2", 3, 11.0)
    seen = []
    alone = experiment.run(settings, seen.append)
    assert alone.metrics == runs[2].metrics
    np.testing.assert_array_equal(alone.corrected.T_world_drone, runs[2].corrected.T_world_drone)
    assert seen[-1] == 1.0
    assert seen == sorted(seen)


def test_the_time_of_a_frame_is_that_of_all_its_stages(runs):
    timing = tables.timing(runs)
    frames = timing[timing["stage"] == "frame"]
    assert len(frames) == len(runs)
    whole = [1e3 * np.median(np.sum(list(run.seconds.values()), axis=0)) for run in runs]
    assert frames["median_ms"].tolist() == pytest.approx(whole)


def test_curves_hold_the_error_of_every_scan_without_and_with_correction(runs):
    curves = report.curves(runs)
    assert set(curves["curve"]) == {"none", "average", "least_squares"}
    for run in runs:
        own = curves[(curves["method"] == run.settings.odometry.method) & (curves["noise"] == run.settings.noise_name)]
        for name, path in (("none", run.prior), (run.settings.odometry.method, run.corrected)):
            truth = run.truth.trajectory.at(path.stamp_s).position
            drawn = own[own["curve"] == name]
            np.testing.assert_array_equal(drawn["time_s"], path.stamp_s)
            np.testing.assert_allclose(drawn["error_m"], np.linalg.norm(path.position - truth, axis=1))
