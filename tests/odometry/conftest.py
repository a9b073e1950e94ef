"""A flight that several files use, once a process."""

import pytest

from steelnb import experiment
from steelnb.settings import ExperimentSettings

TILTED = "constant-drift:0.0004+yaw-random-walk+tilt:0.1"
"""Within seconds the tilt is worth that of minutes at a tenth of its size: it has a correlation time of 30 s."""


@pytest.fixture(scope="session")
def tilted():
    """A flight of 16 s whose prior has wrong roll and pitch, and its truth."""
    return experiment.simulate(ExperimentSettings.preset("zigzag", TILTED, "best", seed=3, duration_s=16.0))
