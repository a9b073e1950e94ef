"""Figures show what they name, fill their page, and keep what is drawn together apart by colour."""

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgb

from steelnb import plots
from steelnb.core.errors import InputError
from steelnb.core.types import Segments, Trajectory
from steelnb.plots.charts import error_dots, require_runs
from steelnb.plots.draw import figure_bars, figure_flight, in_view


def test_points_at_one_place_are_drawn_beside_a_path():
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3] = np.arange(3)
    paths = {"held": (Trajectory(np.arange(3.0), T), "black")}
    figure = figure_flight(paths, None, np.full((10, 3), 1e7), Segments.empty(), "one place")
    assert np.isfinite(figure.axes[0].get_xlim()).all()


@pytest.fixture
def clouds():
    true = np.random.default_rng(0).uniform([-2, -2, 0], [2, 2, 6], (500, 3))
    return {"gicp": (true + 0.1, true), "best": (true, true)}


def test_a_cloud_lies_over_the_true_one_and_the_legend_names_both(clouds):
    figure = plots.figure_clouds(clouds)
    for method, panels in zip(clouds, np.reshape(figure.axes, (2, 2)), strict=True):
        for panel in panels:
            drawn = [tuple(points.get_facecolor()[0, :3]) for points in panel.collections]
            assert drawn == [to_rgb(plots.COLOURS["truth"]), to_rgb(plots.COLOURS[method])]
    named = [text.get_text() for text in figure.legends[0].get_texts()]
    assert named == ["GICP", "best", "at the true poses"]


def test_an_error_of_0_is_drawn_and_a_noise_is_named_as_it_is():
    rows = pd.DataFrame({"method": ["none", "best"], "case": pd.Categorical(["none"] * 2), "raw_ate_rmse_m": 0.0})
    for best_m in (0.02, 0.0):
        panel = error_dots(rows.assign(ate_rmse_m=[0.0, best_m]), "case", ["none", "best"]).axes.flat[0]
        left, right = panel.get_xlim()
        assert left < 0 <= 100 * best_m < right
        assert [tick.get_text() for tick in panel.get_yticklabels()] == ["none"]


def test_clouds_without_points_are_drawn_and_say_so():
    nothing, point = np.zeros((0, 3)), np.ones((1, 3))
    for true in (nothing, point):
        figure = plots.figure_clouds({"icp": (nothing, true), "best": (point, true)})
        assert [panel.get_title(loc="left") for panel in figure.axes[::2]] == ["ICP: no points", "best"]
    plots.figure_clouds({"icp": (nothing, nothing)})._repr_png_()


def test_a_figure_without_runs_says_so_and_a_study_without_runs_is_refused():
    rows = pd.DataFrame({"method": ["best"], "case": pd.Categorical(["x"]), "flight": "orbit", "ate_rmse_m": 0.1})
    grid = error_dots(rows[:0], "case", ["best"], col="flight", col_order=["vertical", "orbit"])
    assert [[text.get_text() for text in panel.texts] for panel in grid.axes.flat] == [["no run"]] * 2
    assert require_runs(rows, ["best"]) is rows
    for refused in (
        lambda: require_runs(rows[:0], ["best"]),
        lambda: error_dots(rows[:0], "case", ["best"], col="flight"),
    ):
        with pytest.raises(InputError, match="no run of best is left to draw"):
            refused()


def test_a_stray_point_does_not_make_the_rest_a_dot():
    points = np.random.default_rng(2).uniform([-1, -1, 0], [1, 1, 6], (5000, 3))
    figure = figure_bars(np.concatenate([points, [[1000.0, 0.0, 0.0]]]), Segments.empty(), "a stray")
    for panel in figure.axes:
        assert np.ptp(panel.dataLim.intervalx) < 10
    assert in_view(points).all()
    assert in_view(points[:2]).all()
