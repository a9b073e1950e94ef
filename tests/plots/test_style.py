"""Every method that a user may pick can be drawn, and every member of a tower is drawn."""

import numpy as np
import pytest

from steelnb import plots
from steelnb.plots import style
from steelnb.settings import METHODS, TowerSettings
from steelnb.simulation import build_tower


def test_every_method_has_a_colour_and_a_name():
    assert set(METHODS) <= set(style.METHOD_LOOKS) & set(plots.LABELS)


@pytest.mark.parametrize("flight", ["vertical", "zigzag"])
def test_a_tower_is_drawn_with_all_of_its_members_and_in_view(flight):
    tower = build_tower(TowerSettings.of_flight(flight))
    figure = plots.Figure()
    scene, front, side = figure.subplots(1, 3)
    plots.draw_tower([scene, front, side], tower, {"orbit": np.array([[3.0, 3, 1], [-3, 3, 2]])})
    for panel, across in ((front, 0), (side, 1)):
        drawn = np.concatenate([lines.get_segments() for lines in panel.collections])
        assert len(drawn) == len(tower.members)
        expected = tower.axes[:, :, [across, 2]]
        np.testing.assert_allclose(sorted(drawn.sum(axis=(1, 2))), sorted(expected.sum(axis=(1, 2))))
        (left, right), (low, high) = panel.get_xlim(), panel.get_ylim()
        assert left < drawn[..., 0].min() < drawn[..., 0].max() < right
        assert low < drawn[..., 1].min() < drawn[..., 1].max() < high
    assert "orbit flight" in scene.get_legend_handles_labels()[1]
