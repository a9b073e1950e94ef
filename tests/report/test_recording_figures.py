"""The figures of a recorded flight show the numbers they are given."""

import io

import numpy as np
import pytest

from steelnb.report.recording_figures import figure_comparison, figure_recorded_errors, figure_recorded_trajectories
from steelnb.report.style import LABELS
from steelnb.types import Trajectory


def path(offset_m: float, scale: tuple[float, float, float] = (2.0, 1.0, 9.0)) -> Trajectory:
    stamp_s = 0.2 * np.arange(50)
    T = np.tile(np.eye(4), (50, 1, 1))
    t = stamp_s / stamp_s[-1]
    T[:, :3, 3] = np.c_[scale[0] * np.sin(5 * t), scale[1] * t, scale[2] * t] + offset_m
    return Trajectory(1.7e9 + stamp_s, T)


def test_errors_are_drawn_over_time_with_their_numbers():
    stamp_s, prior, corrected = 1.7e9 + np.arange(5.0), np.arange(5.0), np.full(5, 0.1)
    panel = figure_recorded_errors(stamp_s, prior, corrected, "best", "a.bag").axes[0]
    for line, error in zip(panel.lines, (prior, corrected), strict=True):
        np.testing.assert_array_equal(line.get_xdata(), np.arange(5.0))
        np.testing.assert_array_equal(line.get_ydata(), error)
    assert panel.lines[0].get_label() == "drifting: rms 2.449 m, max 4.000 m"
    assert panel.get_ylabel() == "distance to the truth (m)"
    assert panel.get_ylim()[1] > 4.0


@pytest.mark.parametrize("truth", [None, path(0.0)])
@pytest.mark.parametrize("method", ["none", "best", "combined"])
def test_paths_are_drawn_from_above_and_from_the_side_at_one_scale(truth, method):
    prior, corrected = path(0.3), path(0.01)
    figure = figure_recorded_trajectories(prior, corrected, truth, method, "a.bag")
    figure.savefig(io.BytesIO(), format="png", dpi=40)
    above, side = figure.axes
    names = ["drifting", *(["truth"] if truth else []), LABELS[method], "start"]
    assert [line.get_label() for line in above.lines] == names
    np.testing.assert_array_equal(above.lines[0].get_ydata(), prior.position[:, 1])
    np.testing.assert_array_equal(side.lines[-2].get_ydata(), corrected.position[:, 2])
    if truth:
        assert above.lines[1].get_linewidth() > 2 * above.lines[2].get_linewidth(), "seen beside the path on it"
    scales = [panel.get_window_extent().width / np.ptp(panel.get_xlim()) for panel in (above, side)]
    assert scales[0] == pytest.approx(scales[1], rel=0.25)


@pytest.mark.parametrize("scale", [(0.0, 0.0, 0.0), (100.0, 0.0, 0.0), (0.0, 1e-3, 50.0)])
def test_paths_that_stand_still_or_are_flat_can_be_drawn(scale):
    still = path(0.0, scale)
    figure_recorded_trajectories(still, still, None, "none", "a.bag").savefig(io.BytesIO(), format="png", dpi=40)
    zero = np.zeros(50)
    figure_recorded_errors(still.stamp_s, zero, zero, "none", "a.bag").savefig(io.BytesIO(), format="png", dpi=40)


def test_compared_odometries_are_drawn_over_time_and_by_their_percentiles():
    stamp_s = 1.7e9 + np.arange(5.0)
    curves = {"drifting": (stamp_s, np.arange(5.0)), "gicp": (stamp_s[1:], np.full(4, 0.5))}
    times_ms = {"gicp": np.arange(101.0) + 1, "best": np.full(9, 3.0)}
    over_time, taken = figure_comparison(curves, times_ms, 200.0, "distance to the truth (m)", "a.bag").axes
    assert [line.get_label() for line in over_time.lines] == ["drifting: rms 2.449 m", "GICP: rms 0.500 m"]
    np.testing.assert_array_equal(over_time.lines[1].get_xdata(), [1, 2, 3, 4])
    bar, median, p99 = taken.lines[:3]
    np.testing.assert_allclose([*bar.get_xdata(), *median.get_xdata(), *p99.get_xdata()], [51, 96, 51, 100])
    assert taken.lines[-1].get_xdata() == [200, 200]
    assert over_time.lines[1].get_color() == bar.get_color()
