"""Figures show what they name, fill their page, and keep what is drawn together apart by colour."""

import itertools

import numpy as np
import pandas as pd
import pytest
import seaborn as sns
from matplotlib.colors import to_rgb

from steelnb import plots
from steelnb.core.errors import InputError
from steelnb.core.types import Segments, Trajectory
from steelnb.plots.charts import error_dots, require_runs
from steelnb.plots.draw import figure_bars, figure_flight, in_view

TOGETHER = {
    "bands": ["draws", "draw", "report"],
    "segments": ["none", "report-segments", "average", "least_squares", "report"],
    "yaw": ["none", "report-segments", "average", "least_squares_yaw"],
    "clouds": ["none", "report-icp", "icp", "best", "report"],
    "3-DoF": ["none", "report-icp-3dof", "icp-3dof", "report"],
    "GICP": ["none", "report-gicp", "gicp", "report"],
}
"""Names of curves that one panel shows."""


def lightness_and_hue(colour: str) -> np.ndarray:
    """CIE 1976 L*a*b* coordinates (3,) of a colour, in which a distance of 10 is seen at once."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92)
    to_xyz = [[0.4339, 0.3762, 0.1899], [0.2126, 0.7152, 0.0722], [0.0178, 0.1095, 0.8727]]  # over the white of D65
    x, y, z = np.cbrt(np.maximum(to_xyz @ linear, 1e-9))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("names", TOGETHER.values(), ids=TOGETHER)
def test_curves_of_one_panel_have_colours_that_differ(names):
    for one, other in itertools.combinations(names, 2):
        apart = np.linalg.norm(lightness_and_hue(plots.COLOURS[one]) - lightness_and_hue(plots.COLOURS[other]))
        assert apart > 20, (one, other)


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


@pytest.mark.parametrize("shape", [(3, 1), (1, 3)], ids=["flat", "tall"])
def test_clouds_leave_no_gap_between_title_panels_and_legend(clouds, shape):
    wide, tall = shape
    stretched = {name: tuple(points * [wide, wide, tall] for points in pair) for name, pair in clouds.items()}
    figure = plots.figure_clouds(stretched)
    title = figure.suptitle("title")
    figure.draw_without_rendering()
    boxes = [panel.get_tightbbox() for panel in figure.axes]
    inch = figure.dpi
    assert 0 < title.get_window_extent().y0 - max(box.y1 for box in boxes) < 0.5 * inch
    assert 0 < min(box.y0 for box in boxes) - figure.legends[0].get_window_extent().y1 < 0.5 * inch
    assert max(box.x1 for box in boxes) - min(box.x0 for box in boxes) > 0.85 * figure.bbox.width


def test_a_bar_of_colours_replaces_the_legend_and_points_beyond_its_end():
    rows = pd.DataFrame({"x": [0, 1, 2], "error": [0.1, 0.5, 3.0]})
    grid = sns.relplot(rows, x="x", y="x", hue="error", palette="viridis", hue_norm=(0, 1))
    plots.gather_bar(grid.figure, "error (m)", 1)
    assert not grid.figure.legends
    bar = grid.figure.axes[-1]
    assert bar.get_ylabel() == "error (m)"
    assert bar.get_ylim() == (0, 1)
    assert bar._colorbar.extend == "max"


def test_rows_of_methods_are_named_as_in_the_legends_of_other_figures():
    methods = ["icp-3dof", "faces"]
    rows = pd.DataFrame({"method": methods * 2, "ate_rmse_m": [0.1, 0.2, 0.3, 0.4], "raw_ate_rmse_m": 0.5})
    grid = error_dots(rows.astype({"method": pd.CategoricalDtype(methods)}), "method", methods)
    assert [tick.get_text() for tick in grid.axes.flat[0].get_yticklabels()] == [plots.LABELS[each] for each in methods]


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
