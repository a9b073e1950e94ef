"""Views of bars hold all of them."""

import numpy as np

from steelnb.report.three_views import figure_segments
from steelnb.types import Segments


def test_bars_that_reach_beyond_the_points_are_not_cut():
    points = np.random.default_rng(0).uniform((-2, -1, 1), (2, 1, 5), (500, 3))
    start, end = np.array([[-2.0, -1.0, 0.0], [0.0, 0.0, 0.5]]), np.array([[-2.0, -1.0, 5.0], [0.0, 0.0, 7.0]])
    bars = Segments(start=start, end=end, count=np.array([9, 9]), radius=np.array([0.1, 0.1]))
    figure = figure_segments(points, bars, ["near_vertical"] * 2, "a tower")
    for panel in figure.axes:
        ends = np.concatenate(panel.collections[0].get_segments())
        for values, (low, high) in zip(ends.T, (panel.get_xlim(), panel.get_ylim()), strict=True):
            assert low < values.min() < values.max() <= high or np.ptp(values) < 1e-9
