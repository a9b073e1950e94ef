import dataclasses

import numpy as np
import pytest

from steelnb import experiment
from steelnb.core.errors import InputError
from steelnb.notebook.image_matches import match_images
from steelnb.settings import ExperimentSettings


@pytest.fixture(scope="module")
def flown():
    return experiment.simulate(ExperimentSettings.preset("zigzag", "none", "orb", "starling2", 1, 2.0))


def test_the_true_motion_tells_which_matches_are_right(flown):
    flight, truth = flown
    between = match_images(flight, truth, 3, 6)
    moved = np.linalg.norm(between.second - between.first, axis=1)
    known = np.isfinite(between.apart_px)
    assert known.sum() > 10
    assert len(np.unique(between.second, axis=0)) == len(between.first), "each feature is matched once"
    assert np.median(between.apart_px[known]) < 2 < np.median(moved[known])


def test_a_flight_without_images_is_refused(flown):
    flight, truth = flown
    with pytest.raises(InputError, match="has no images"):
        match_images(dataclasses.replace(flight, images=None), truth, 0, 1)
