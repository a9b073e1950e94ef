import json

import numpy as np
import pytest

from steelnb import results
from steelnb.batch import flat
from steelnb.errors import InputError
from steelnb.report import structure_tables as tables
from steelnb.report.structure_tables import fly_tower, rebuild
from steelnb.settings import TowerSettings
from steelnb.types import Segments

COLUMNS = [
    "trajectory", "noise", "tower", "seed", "poses", "method", "recall", "precision", "duplicates", "angle_median_deg",
    "offset_median_m", "offset_p90_m", "end_median_m", "joint_recall", "joint_error_median_m", "edge_recall",
    "edge_precision",
]  # fmt: skip


@pytest.fixture(scope="module")
def source():
    overrides = {"tof.columns": 90, "tof.rows": 120}
    return fly_tower("zigzag", "starling2", "random-walk", "least_squares", 11, 12.0, overrides=overrides)


@pytest.fixture(scope="module")
def runs(source):
    return rebuild(source)


def test_a_row_for_each_poses_and_method_with_the_names_of_the_goals(runs):
    table = tables.structure_table(runs)
    assert len(table) == 6
    assert not set(COLUMNS) - set(table)
    assert set(tables.STRUCTURE_GOALS) <= set(table)
    assert not table.duplicated(["poses", "method"]).any()
    rows = table.set_index(["poses", "method"])
    exact = rows.loc["true", "final"]
    assert exact["recall"] > 0.7
    assert exact["precision"] > 0.85
    assert exact["offset_median_m"] < 0.02
    assert rows["ate_rmse_m"]["true"].max() == 0
    assert (rows["ate_rmse_m"]["raw"] > rows["ate_rmse_m"]["corrected"]).all()
    metrics = flat(table, ["poses", "method"], tables.NUMBERS)
    assert metrics["true.final.recall"] == exact["recall"]
    assert list(table) == [*tables.CASE, *tables.NUMBERS, "seconds"]
    assert table["seconds"].tolist() == [run.seconds for run in runs]


def test_recall_is_counted_over_all_members_with_points(runs):
    by_points = tables.recall_by_points(runs)
    rows = by_points[(by_points["poses"] == "true") & (by_points["method"] == "final")]
    hits = runs[0].source.result.truth.visibility.returns
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
        return tables.toward_sensor_m(source, bars, member)

    still = nearer(np.zeros(3))[source.reference.observed]
    assert np.isnan(still).mean() < 0.5  # of some members the middle was out of range
    np.testing.assert_allclose(still[np.isfinite(still)], 0, atol=1e-9)
    # A drone on the side of negative x sees the rings that run along y nearer when they move to it.
    drone = source.poses["true"][:, :3, 3].mean(axis=0)
    away = np.array([*(drone - source.result.truth.tower.vertices.mean(axis=0))[:2], 0])
    moved = nearer(0.01 * away / np.linalg.norm(away))[source.reference.observed]
    # No bar by more than the shift, those across the view by all of it.
    assert np.nanmax(moved) <= 0.01 + 1e-9
    assert np.nanpercentile(moved, 90) > 0.009
    assert np.isnan(
        tables.toward_sensor_m(source, Segments(begin, end, member, member * 1.0), np.full(count, -1))
    ).all()


def test_the_fitted_section_takes_the_near_side_out(runs):
    final = next(run for run in runs if run.poses == "true" and run.method == "final")
    summary = tables.near_side_summary(tables.near_side(final)).set_index(["axis", "kind"])
    middle, fitted = (summary["median_m"][axis, "all"] for axis in ("middle of points", "section fitted"))
    assert middle > 0.004
    assert abs(fitted) < 0.6 * middle
    assert flat(summary.reset_index(), ["axis", "kind"])["section fitted.all.median_m"] == fitted


def test_goals_are_judged_on_their_side():
    import pandas as pd

    table = pd.DataFrame([{name: 0.0 for name in tables.STRUCTURE_GOALS}])
    goals = tables.structure_goals(table, "loops").set_index("goal")
    assert goals["limit"]["recall"] == 0.92
    assert not goals["reached"][goals["side"] == "at least"].any()
    assert goals["reached"][goals["side"] == "at most"].all()
    assert tables.structure_goals(table, "zigzag").set_index("goal")["limit"]["recall"] == 0.88


def test_structures_are_results(runs, tmp_path):
    table = tables.structure_table(runs)
    final = runs[-2].structure
    files = tables.structure_files("true", final)
    results.write_results(tmp_path / "a", table=table, metrics={}, figures={}, files=files, provenance={})
    assert [path.name for path in results.pictures(tmp_path / "a")] == ["structure_true.json"]
    read = json.loads((tmp_path / "a" / "structure_true.json").read_text())
    np.testing.assert_array_equal([joint["position_m"] for joint in read["joints"]], final.joint)


def test_other_towers_differ_from_the_tapered_one_and_unknown_names_are_refused(source):
    towers = [TowerSettings.preset(name) for name in ("tapered", "heavy", "light")]
    sections = [{tower.leg_section_m, tower.bracing_section_m} for tower in towers]
    assert len(set.union(*sections)) == 6
    with pytest.raises(InputError, match="expected one of"):
        fly_tower("zigzag", "starling2", "none", "best", 1, 5.0, "eiffel")
    with pytest.raises(InputError, match="'final', 'incremental'"):
        rebuild(source, ["first"])
    with pytest.raises(InputError, match="'raw', 'corrected', 'true'"):
        rebuild(source, poses=["best"])
