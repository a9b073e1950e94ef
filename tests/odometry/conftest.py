"""A short flight with images, which the tests of two odometries share."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from steelnb import experiment
from steelnb.settings import ExperimentSettings
from steelnb.simulation import FORWARD

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
    settings = ExperimentSettings.preset("loops", "random-walk:0.004", "orb", seed=12, duration_s=6.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment, "FORWARD", replace(FORWARD, samples=2))
        flight, truth = experiment.simulate(settings)
    number = [flight.images.at(stamp_s) for stamp_s in flight.prior.stamp_s]
    dark = np.zeros((FORWARD.rows, FORWARD.columns), np.uint8)
    blind = (flight.prior.stamp_s >= BLIND_S[0]) & (flight.prior.stamp_s < BLIND_S[1])
    images = [dark if is_blind else flight.images.images[k] for k, is_blind in zip(number, blind, strict=True)]
    return settings, replace(flight, images=replace(flight.images, stamp_s=flight.prior.stamp_s, images=images)), truth
