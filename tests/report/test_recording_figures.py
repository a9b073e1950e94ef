"""The figures of a recorded flight show the numbers they are given."""

import io

import numpy as np
import pytest

from steelnb.report.recording_figures import figure_distances, figure_recorded_trajectories
from steelnb.report.style import LABELS
from steelnb.types import Trajectory


def path(offset_m: float, scale: tuple[float, float, float] = (2.0, 1.0, 9.0)) -> Trajectory:
    stamp_s = 0.2 * np.arange(50)
    T = np.tile(np.eye(4), (50, 1, 1))
    t = stamp_s / stamp_s[-1]
    T[:, :3, 3] = np.c_[scale[0] * np.sin(5 * t), scale[1] * t, scale[2] * t] + offset_m
    return Trajectory(1.7e9 + stamp_s, T)


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
    curves = {"drifting": (still.stamp_s, np.zeros(50))}
    figure_distances(curves, "m", "a.bag").savefig(io.BytesIO(), format="png", dpi=40)


def test_compared_odometries_are_drawn_over_time_and_by_their_percentiles():
    stamp_s = 1.7e9 + np.arange(5.0)
    curves = {"drifting": (stamp_s, np.arange(5.0)), "gicp": (stamp_s[1:], np.full(4, 0.5))}
    times_ms = {"gicp": np.arange(101.0) + 1, "best": np.full(9, 3.0)}
    over_time, taken = figure_distances(curves, "distance to the truth (m)", "a.bag", times_ms).axes
    assert [line.get_label() for line in over_time.lines] == [
        "drifting: rms 2.449 m, max 4.000 m", "GICP: rms 0.500 m, max 0.500 m"
    ]  # fmt: skip
    np.testing.assert_array_equal(over_time.lines[1].get_xdata(), [1, 2, 3, 4])
    assert over_time.get_ylim()[1] > 4.0
    assert [text.get_text() for text in taken.get_yticklabels()] == ["GICP", "best"]
    drawn = np.concatenate([line.get_xdata() for line in taken.lines])
    assert {6.0, 51.0, 96.0} <= set(drawn), "percentiles and median"
