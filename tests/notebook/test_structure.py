import numpy as np
import pandas as pd
import pytest

from steelnb.core.types import Segments
from steelnb.notebook.structure import (
    NUMBERS,
    POSES,
    RECONSTRUCTIONS,
    STRUCTURE_COLUMNS,
    fly_tower,
    near_side,
    rebuild,
    structure_row,
)
from steelnb.notebook.tables import flat


@pytest.fixture(scope="module")
def source():
    overrides = {"tof.columns": 90, "tof.rows": 120}
    return fly_tower("zigzag", "starling2", "random-walk", "least_squares", 11, 8.0, overrides=overrides)


@pytest.fixture(scope="module")
def runs(source):
    return rebuild(source)


def test_a_row_for_each_poses_and_method_with_the_names_of_the_goals(runs):
    assert list(runs) == [(poses, method) for poses in POSES for method in RECONSTRUCTIONS]
    table = pd.DataFrame([structure_row(run) for run in runs.values()])
    rows = table.set_index(["poses", "method"])
    assert list(rows.index) == list(runs)
    exact = rows.loc["true", "final"]
    assert exact["recall"] > 0.7
    assert exact["precision"] > 0.85
    assert exact["offset_median_m"] < 0.02
    assert rows["ate_rmse_m"]["true"].max() == 0
    assert (rows["ate_rmse_m"]["raw"] > rows["ate_rmse_m"]["corrected"]).all()
    metrics = flat(table, ["poses", "method"], NUMBERS)
    assert metrics["true.final.recall"] == exact["recall"]
    assert list(table) == [*STRUCTURE_COLUMNS, *NUMBERS, "seconds"]
    assert table["seconds"].tolist() == [run.seconds for run in runs.values()]


def test_a_bar_moved_to_the_sensor_is_nearer_by_as_much(source):
    begin, end = source.reference.axes[:, 0], source.reference.axes[:, 1]
    count = len(begin)
    member = np.arange(count)

    def nearer(shift):
        bars = Segments(begin + shift, end + shift, np.full(count, 100), np.full(count, 0.01))
        return source.toward_sensor_m(bars, member)

    still = nearer(np.zeros(3))[source.reference.observed]
    assert np.isnan(still).mean() < 0.5  # of some members the middle was out of range
    np.testing.assert_allclose(still[np.isfinite(still)], 0, atol=1e-9)
    # To a drone at negative x, the rings that run along y are nearer when they move towards it.
    drone = source.poses["true"][:, :3, 3].mean(axis=0)
    away = np.array([*(drone - source.result.truth.tower.vertices.mean(axis=0))[:2], 0])
    moved = nearer(0.01 * away / np.linalg.norm(away))[source.reference.observed]
    # No bar by more than the shift, those across the view by all of it.
    assert np.nanmax(moved) <= 0.01 + 1e-9
    assert np.nanpercentile(moved, 90) > 0.009
    assert np.isnan(source.toward_sensor_m(Segments(begin, end, member, member * 1.0), np.full(count, -1))).all()


def test_the_fitted_section_takes_the_near_side_out(runs):
    final = runs["true", "final"]
    bias = near_side(final)
    fitted = bias[bias["axis"] == "section fitted"]
    assert len(fitted) == (final.score.member >= 0).sum()
    median_m = bias.groupby("axis")["toward_sensor_m"].median()
    assert median_m["middle of points"] > 0.004
    assert abs(median_m["section fitted"]) < 0.6 * median_m["middle of points"]
    members = final.source.result.truth.tower.members
    assert set(map(tuple, bias[["kind", "section_m"]].to_numpy())) <= {(one.kind, one.section_m[0]) for one in members}
