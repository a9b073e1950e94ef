import io
import json

import numpy as np
import pytest

from steelnb import figures, results, study
from steelnb.datatypes import Segments
from steelnb.errors import SettingsError
from steelnb.exports import read_structure
from steelnb.study.structure import TOWERS, toward_sensor_m

COLUMNS = [
    "trajectory", "noise", "tower", "seed", "poses", "method", "recall", "precision", "duplicates", "angle_median_deg",
    "offset_median_m", "offset_p90_m", "end_median_m", "joint_recall", "joint_error_median_m", "edge_recall",
    "edge_precision",
]  # fmt: skip


@pytest.fixture(scope="module")
def source():
    overrides = {"tof.columns": 90, "tof.rows": 120}
    return study.fly_tower("vertical", "starling2", "random-walk", "least_squares", 11, 12.0, overrides=overrides)


@pytest.fixture(scope="module")
def runs(source):
    return study.rebuild(source)


def test_a_row_for_each_poses_and_method_with_the_names_of_the_goals(runs):
    table = study.structure_table(runs)
    assert len(table) == 6
    assert not set(COLUMNS) - set(table)
    assert set(study.STRUCTURE_GOALS) <= set(table)
    assert not table.duplicated(["poses", "method"]).any()
    rows = table.set_index(["poses", "method"])
    exact = rows.loc["true", "final"]
    assert exact["recall"] > 0.7
    assert exact["precision"] > 0.85
    assert exact["offset_median_m"] < 0.02
    assert rows["ate_rmse_m"]["true"].max() == 0
    assert (rows["ate_rmse_m"]["raw"] > rows["ate_rmse_m"]["corrected"]).all()
    metrics = study.structure_metrics(runs)
    assert metrics["true.final.recall"] == exact["recall"]
    assert np.isfinite(list(metrics.values())).all()
    assert "seconds" not in table
    assert (study.structure_timing(runs)["seconds"] > 0).all()


def test_recall_is_counted_over_all_members_with_points(runs):
    by_points = study.recall_by_points(runs)
    rows = by_points[(by_points["poses"] == "true") & (by_points["method"] == "final")]
    hits = runs[0].source.visibility.hits
    assert rows["members"].sum() == (hits >= 10).sum()
    final = next(run for run in runs if run.poses == "true" and run.method == "final")
    assert (rows["members"] * rows["recall"]).sum() == pytest.approx(final.score.found[hits >= 10].sum())
    assert rows["recall"].iloc[-1] >= rows["recall"].iloc[0]


def test_a_bar_moved_to_the_sensor_is_nearer_by_as_much(source):
    begin, end = source.reference.axes[:, 0], source.reference.axes[:, 1]
    count = len(begin)
    member = np.arange(count)

    def nearer(shift):
        bars = Segments(begin + shift, end + shift, np.full(count, 100), np.full(count, 0.01))
        return toward_sensor_m(source, bars, member)

    still = nearer(np.zeros(3))[source.reference.observed]
    assert np.isnan(still).mean() < 0.5  # of some members the middle was out of range
    np.testing.assert_allclose(still[np.isfinite(still)], 0, atol=1e-9)
    # A drone on the side of negative x sees the rings that run along y nearer when they move to it.
    drone = source.poses["true"][:, :3, 3].mean(axis=0)
    away = np.array([*(drone - source.truth.tower.vertices.mean(axis=0))[:2], 0])
    moved = nearer(0.01 * away / np.linalg.norm(away))[source.reference.observed]
    # No bar by more than the shift, those across the view by all of it.
    assert np.nanmax(moved) <= 0.01 + 1e-9
    assert np.nanpercentile(moved, 90) > 0.009
    assert np.isnan(toward_sensor_m(source, Segments(begin, end, member, member * 1.0), np.full(count, -1))).all()


def test_the_fitted_section_takes_the_near_side_out(runs):
    final = next(run for run in runs if run.poses == "true" and run.method == "final")
    summary = study.near_side_summary(study.near_side(final)).set_index(["axis", "kind"])
    middle, fitted = (summary["median_m"][axis, "all"] for axis in ("middle of points", "section fitted"))
    assert middle > 0.004
    assert abs(fitted) < 0.6 * middle
    metrics = study.near_side_metrics(summary.reset_index())
    assert metrics["near_side.section fitted.all.median_m"] == fitted


def test_goals_are_judged_on_their_side():
    import pandas as pd

    table = pd.DataFrame([{name: 0.0 for name in study.STRUCTURE_GOALS}])
    goals = study.structure_goals(table, "orbit").set_index("goal")
    assert goals["limit"]["recall"] == 0.92
    assert not goals["reached"][goals["side"] == "at least"].any()
    assert goals["reached"][goals["side"] == "at most"].all()
    assert study.structure_goals(table, "vertical").set_index("goal")["limit"]["recall"] == 0.88


def test_every_figure_is_drawn(runs):
    table = study.structure_table(runs)
    final = [run for run in runs if run.method == "final"]
    bias = study.near_side(final[-1])
    drawn = [
        figures.figure_structures(final[:2]),
        figures.figure_structure_errors(final[1:]),
        figures.figure_recall(study.recall_by_points(runs)),
        figures.figure_near_side(bias),
        figures.figure_structure_goals(table[table["poses"] == "corrected"], "vertical"),
    ]
    for figure in drawn:
        file = io.BytesIO()
        figure.savefig(file, format="png")
        assert file.tell() > 20_000


def test_structures_are_results_and_keep_the_name_of_their_part(runs, tmp_path):
    table = study.structure_table(runs)
    final = runs[-2].structure
    for name in ("a", "b"):
        results.write_results(
            tmp_path / name, table=table, metrics={}, figures={}, structures={"true": final},
            provenance=study.structure_provenance(runs),
        )  # fmt: skip
    results.merge({name: tmp_path / name for name in "ab"}, tmp_path / "all", {})
    names = {path.name for path in (tmp_path / "all").glob("structure_*")}
    assert names == {f"structure_true_{part}.{ending}" for part in "ab" for ending in ("json", "glb")}
    assert {path.name for path in results.result_files(tmp_path / "all")} >= names
    np.testing.assert_array_equal(read_structure(tmp_path / "all" / "structure_true_a.json").joint, final.joint)
    assert json.loads((tmp_path / "all" / "provenance.json").read_text())["parts"]["a"]["tower"] == "report"


def test_other_towers_differ_from_the_one_of_the_report_and_unknown_names_are_refused(source):
    sections = [{TOWERS[name].leg_section_m, TOWERS[name].bracing_section_m} for name in TOWERS]
    assert len(set.union(*sections)) == 6
    for settings in ({"tower": "eiffel"}, {"poses": ["best"]}):
        with pytest.raises(SettingsError, match="expected one of"):
            study.fly_tower("vertical", "starling2", "none", "best", 1, 5.0, **settings)
    with pytest.raises(SettingsError, match="'final', 'incremental'"):
        study.rebuild(source, ["first"])
