"""Figures of images, of their features and of what LOAM takes, on a flight of a second."""

from dataclasses import replace

import numpy as np
import pytest

from steelnb import experiment
from steelnb.errors import InputError
from steelnb.report.literature import figure_matches, seen_features
from steelnb.settings import ExperimentSettings


@pytest.fixture(scope="module")
def world():
    flight, truth = experiment.simulate(ExperimentSettings.preset(method="orb", seed=11, duration_s=1.0))
    return flight, truth.trajectory.at(flight.prior.stamp_s)


def counts(figure):
    """Number of matches by verdict, from the legend."""
    pairs = (text.get_text().rsplit(": ") for text in figure.legends[0].get_texts())
    return {name: int(number) for name, number in pairs}


def test_most_matches_of_successive_images_are_right_by_the_true_poses(world):
    flight, true = world
    shown = counts(figure_matches(flight, 2, 3, true))
    assert shown["right"] > 40
    assert shown["right"] > 5 * shown["wrong"]
    turned = replace(true, T_world_drone=true.T_world_drone.copy())
    turned.T_world_drone[3, :3, 3] += (0.0, 0.3, 0.0)
    assert counts(figure_matches(flight, 2, 3, turned))["right"] < 0.2 * shown["right"]
    figure = figure_matches(flight, 2, 3, true)
    assert f"{sum(shown.values())} matches of " in figure.axes[0].get_title()
    assert sum(len(lines.get_segments()) for lines in figure.axes[0].collections) == sum(shown.values())


def test_features_are_those_of_the_scan_s_image_with_its_depths(world):
    flight, _ = world
    image, features = seen_features(flight, 2)
    np.testing.assert_array_equal(image, flight.images.images[flight.images.at(flight.prior.stamp_s[2])])
    known = features.depth[np.isfinite(features.depth)]
    assert 20 < len(known) < len(features.depth)
    assert known.max() < np.nanmax(flight.scans[2].points[..., 0]) + 0.05


def test_flights_without_images_are_refused(world):
    flight, _ = world
    with pytest.raises(InputError, match="no images"):
        figure_matches(replace(flight, images=None), 0, 1)
    late = replace(flight, images=replace(flight.images, stamp_s=flight.images.stamp_s + 9.0))
    with pytest.raises(InputError, match="no image at scan 1"):
        seen_features(late, 1)
