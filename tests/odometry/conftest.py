"""A short flight with images, which the tests of two odometries share."""

from collections.abc import Sequence
from dataclasses import replace

import pytest

from steelnb import experiment
from steelnb.settings import ExperimentSettings

BLIND_S = (4.0, 4.5)


class Watched(Sequence):
    """Images that remember which of them were ``asked`` for."""

    def __init__(self, images):
        self.images, self.asked = images, []

    def __len__(self):
        return len(self.images)

    def __getitem__(self, k):
        self.asked.append(k)
        return self.images[k]


@pytest.fixture(scope="session")
def loops_with_images():
    """Six seconds of loops whose camera sees nothing for half of one; rendered images are kept."""
    overrides = {"camera.blind_s": (BLIND_S,), "camera.samples": 2}
    settings = ExperimentSettings.preset("loops", "random-walk:0.004", "orb", seed=12, duration_s=6.0).override(
        overrides
    )
    flight, truth = experiment.simulate(settings)
    number = [flight.images.at(stamp_s) for stamp_s in flight.prior.stamp_s]
    images = [flight.images.images[k] for k in number]
    return settings, replace(flight, images=replace(flight.images, stamp_s=flight.prior.stamp_s, images=images)), truth
