"""Runs that share a flight, their tables, and the basin of convergence."""

import numpy as np
import pandas as pd
import pytest

from steelnb import experiment
from steelnb.core.errors import InputError
from steelnb.metrics import paired_clouds, position_error_m
from steelnb.notebook import report, tables
from steelnb.notebook.basin import figure_icp_steps, find_basin, from_poor_starts
from steelnb.notebook.cases import plot_of, report_cases, with_earlier_runs
from steelnb.notebook.runs import flight_paths, run_all
from steelnb.settings import ExperimentSettings, Noise
from steelnb.settings.report_plots import read_report_plots

SHORT = {"tof.columns": 90, "tof.rows": 120}


@pytest.fixture(scope="module")
def runs():
    methods = [("icp-3dof", {}), ("icp-3dof", {"map": "weighted"}), ("gicp", {})]
    given = {"seed": 3, "duration_s": 6.0}
    return run_all(
        [ExperimentSettings.preset(method=name, overrides=SHORT | changes, **given) for name, changes in methods]
    )


@pytest.fixture(scope="module")
def flown(runs):
    """The flight of the runs, simulated once more, and its truth."""
    return experiment.simulate(runs[0].settings)


def test_runs_of_one_flight_share_it_and_are_named_by_their_case(runs):
    assert all(run.truth is runs[0].truth for run in runs)
    assert [tables.map_kind(run.settings) for run in runs] == ["re-voxelised", "weighted", "re-voxelised"]
    table = tables.cloud_table(runs)
    assert list(table)[:4] == ["trajectory", "noise", "method", "map"]
    assert (table["scans"] == [len(run.corrected) for run in runs]).all()
    numbers = tables.metrics(runs, tables.CLOUD_CASE)
    assert numbers["zigzag.random-walk.icp-3dof.weighted.ate_rmse_m"] == runs[1].metrics["ate_rmse_m"]
    assert all(np.isfinite(value) for value in numbers.values())
    assert tables.provenance(runs, tables.CLOUD_CASE).keys() == {name.rpartition(".")[0] for name in numbers}


def test_paths_are_those_of_the_flight_without_its_scans(runs):
    tower, paths = flight_paths(runs[0].settings)
    np.testing.assert_array_equal(tower.axes, runs[0].truth.tower.axes)
    np.testing.assert_array_equal(paths["truth"], runs[0].truth.trajectory.position)
    last = np.searchsorted(runs[0].truth.trajectory.stamp_s, runs[0].prior.stamp_s[-1])
    np.testing.assert_allclose(paths["none"][last], runs[0].prior.position[-1], atol=0.02)


def test_a_table_becomes_one_flat_map_of_its_finite_numbers():
    rows = pd.DataFrame({"case": ["a", "b"], "seed": [1, 2], "x_m": [0.5, np.nan], "n": [3, 4]})
    assert tables.flat(rows, ["case", "seed"]) == {"a.1.x_m": 0.5, "a.1.n": 3.0, "b.2.n": 4.0}
    assert tables.flat(rows.set_index("case"), columns=["n"]) == {"a.n": 3.0, "b.n": 4.0}


def test_paired_clouds_hold_the_same_returns_at_two_poses(runs, flown):
    built, true = paired_clouds(flown[0], runs[0], runs[0].truth, runs[0].settings.odometry.preprocess)
    first, *others = report.assembled_clouds(runs)
    assert [len(cloud) for cloud, _ in others] == [len(built)] * 2
    np.testing.assert_array_equal(first, (built, true))
    assert built.shape == true.shape
    off = np.linalg.norm(built - true, axis=1)
    assert off.max() < 2 * runs[0].metrics["error_max_m"] + 0.05
    assert off.max() > 0


def test_starts_at_the_truth_converge_and_far_ones_do_not(runs, flown):
    starts = np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [3.0, 0.0, 0.0]])
    basin = find_basin(runs[0].settings, *flown, 15, starts)
    assert basin["right"].tolist() == [True, True, False]
    assert (basin[["right", "wrong", "refused"]].sum(axis=1) == 1).all()
    assert (basin["wrong"] == basin["stayed"] | basin["locked"]).all()
    segments = ExperimentSettings.preset(noise="none", method="least_squares", duration_s=5.0)
    with pytest.raises(InputError, match="'least_squares' is of the family 'segments'"):
        find_basin(segments, *flown, 0, starts)


def test_scans_that_see_nothing_are_refused_with_the_settings_that_decide(runs, flown):
    blind = runs[0].settings.override({"preprocess.floor_m": 99.0})
    with pytest.raises(InputError, match=r"poor_starts = 1, but 0 of .*expected .* a lower preprocess.floor_m"):
        from_poor_starts(blind, *flown, 1)
    with pytest.raises(InputError, match=r"scans 5 and 4: no pair within 0.5 m of 0 and 0 points; .*tof.range_max_m"):
        figure_icp_steps(*flown, 5, blind.odometry.preprocess)


def test_the_report_s_experiments_have_its_samples_and_its_curves():
    cases = report_cases(["orbit"], "constant-drift", {"average": ["average"], "gicp": ["report-gicp", "gicp"]})
    assert [case.flight.trajectory for case in cases] == ["orbit-3.3", "orbit", "orbit"]
    assert {case.seed for case in cases} == {"report"}
    theirs = [plot_of(case) for case in cases]
    assert [(plot.figure, plot.method) for plot in theirs] == [("3.3", "average"), ("3.6", "gicp"), ("3.6", "gicp")]
    assert [case.tof.samples for case in cases] == [plot.name for plot in theirs]
    time_s, error_m = report.report_curve(theirs[0])
    assert report.report_curve(theirs[0], until_s=60.0)[0].max() <= 60
    assert (error_m.mean(), error_m.max(), error_m[-1]) == pytest.approx((0.285, 0.417, 0.33), abs=0.003)
    assert time_s[-1] == pytest.approx(theirs[0].duration_s, abs=2)
    walk = report_cases(["orbit"], "random-walk", {"average": ["average"]})[0]
    assert walk.tof == cases[0].tof
    assert plot_of(walk) is None, "the report shows segments with constant drift alone"
    elsewhere = ExperimentSettings.preset("vertical", "constant-drift", overrides={"tof.samples": "3.6 orbit gicp"})
    assert plot_of(elsewhere) is None, "the same samples on another flight"
    other = report_cases(["orbit"], "constant-drift", {"gicp": ["gicp"]}, tower="heavy")[0]
    assert plot_of(other) is None, "the same flight past another tower"
    path = [[0.5, 2.5, 0.1, -90.0, 0.0], [0.5, 2.5, 2.0, -90.0, 15.0], [-1.5, 2.5, 2.0, -90.0, 100.0]]
    own = {"flight.still_s": 0.0, "flight.duration_s": 110.0, "flight.waypoints": path}
    waypoints = report_cases(["vertical"], "constant-drift", {"average": ["average"]}, overrides=own)[0]
    assert plot_of(waypoints) is None, "the same name of another flight"
    with pytest.raises(InputError, match="'best' on the flight 'orbit'"):
        report_cases(["orbit"], "random-walk", {"best": ["best"]})
    early, late = (plot for plot in read_report_plots() if plot.name.startswith("3.5 vertical icp-3dof"))
    for plot, count in ((early, 415), (late, 835)):
        time_s = report.report_curve(plot)[0]
        assert plot.samples == count
        assert time_s.min() >= 0.008 * plot.steps[0] - 1e-9, "nothing of the other run"
        assert time_s.max() <= 0.008 * plot.steps[-1] + 1e-9


def test_a_band_holds_its_draws_and_says_where_the_report_lies():
    short = {"duration_s": 27.0, "overrides": {"tof.start_s": 20.0}}
    cases = report_cases(["vertical"], "random-walk", {"gicp": ["report-gicp"]}, **short)
    drawn = report.draw_programs(cases, 3)
    assert set(drawn["curve"]) == {"draws", "draw", "report"}
    ours = drawn[drawn["curve"] == "draws"].pivot(index="sample", columns="draw", values="error_m")
    assert ours.shape[1] == 3
    assert (ours.std(axis=1) > 0).all(), "draws differ"
    flight, truth = experiment.simulate(cases[0])
    alone = position_error_m(experiment.estimate(cases[0], flight, truth).corrected, truth.trajectory)
    np.testing.assert_array_equal(ours[0], alone)  # draw 0 is the run itself
    (row,) = report.band_table(drawn).to_dict("records")
    shown = drawn[drawn["curve"] == "report"]
    means = [np.interp(shown["sample"], ours.index, ours[draw]).mean() for draw in ours]
    assert row["mean_m"] == pytest.approx(np.median(means))
    assert (row["mean_low_m"], row["mean_high_m"]) == pytest.approx(np.percentile(means, [10, 90]))
    assert row["report_mean_m"] == pytest.approx(shown["error_m"].mean())
    assert row["share_below"] == np.mean(np.array(means) < row["report_mean_m"])
    curves = report.band_curves(drawn)
    assert (curves["low_m"] <= curves["median_m"]).all()
    np.testing.assert_allclose(curves["draw_m"], ours[0])
    faulty = cases[0].override({"tof.faults": ["footprint"]})
    with pytest.raises(InputError, match="draws of the noise: expected a sensor without faults"):
        report.draw_programs([faulty], 2)


def test_a_title_names_a_tower_that_is_not_the_flight_s_own():
    own = ExperimentSettings.preset("loops", seed=3)
    assert tables.title(own) == "loops flight, random-walk, sensor starling2, seed 3"
    assert tables.title(own.override({"tower": "heavy"}), "{noise}") == "random-walk, tower heavy"
    assert tables.title(own.override({"tower.section": "round"}), "{noise}") == "random-walk, a tower of your own"


def test_the_report_s_seed_has_drifts_of_the_report_s_noises_alone():
    stamp_s = np.arange(3) / 125
    assert report.seed_drift(stamp_s, Noise.parse("random-walk"))[-1] > 0
    assert np.isnan(report.seed_drift(stamp_s, Noise.parse("random-walk:0.004"))).all()


def test_the_earlier_run_of_a_plot_is_flown_before_it():
    cases = report_cases(["vertical"], "random-walk", {"icp-3dof": ["report-icp-3dof"], "gicp": ["report-gicp"]})
    earlier, main, gicp = with_earlier_runs(cases)
    assert [plot_of(each).run for each in (earlier, main, gicp)] == ["earlier", "", ""]
    assert (plot_of(earlier).samples, earlier.flight.duration_s) == (415, pytest.approx(90.6, abs=0.1))


def test_a_program_keeps_map_and_correction_of_a_run_that_was_broken_off():
    plot = ExperimentSettings.report("3.6", "orbit", "icp", "report-icp")
    settings = plot.override({"flight.duration_s": 9.0})
    assert settings.odometry.broken_off_s == (13.8, 16.8)
    before = experiment.broken_off(settings)
    np.testing.assert_allclose(before.scans.stamp_s[[0, -1]], [13.8, 16.8], atol=0.2)
    moved = before.prior.position[-1] - before.prior.position[0]
    np.testing.assert_allclose(moved, [0.0186, -0.0052, 0.0243], atol=2e-3)  # the drift; the drone stood
    flight, truth = experiment.simulate(settings)
    error = position_error_m(experiment.estimate(settings, flight, truth).corrected, truth.trajectory)
    assert error[0] == pytest.approx(0.143, abs=0.02), "the drift at the first scan of the map, as in the report's plot"
    alone = settings.override({"broken_off_s": ()})
    assert position_error_m(experiment.estimate(alone, flight, truth).corrected, truth.trajectory)[0] < 0.06
    assert experiment.broken_off(alone) is None
    with pytest.raises(InputError, match=r"broken_off_s = \(5.0, 4.0\): expected a start before its end"):
        settings.override({"broken_off_s": (5.0, 4.0)})
