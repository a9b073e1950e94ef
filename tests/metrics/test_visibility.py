import numpy as np
import pytest

from steelnb import experiment
from steelnb.metrics.clouds import sight, slices
from steelnb.settings import ExperimentSettings
from steelnb.simulation.truth import SLICE_M


def test_what_was_seen_agrees_with_the_members_that_were():
    small = {"tof.rows": 24, "tof.columns": 24}
    settings = ExperimentSettings.preset("loops", "random-walk", "best", "report-4cm", 3, 4.0, small)
    flight, truth = experiment.simulate(settings)
    returns, seen = sight(flight, truth, settings.odometry.preprocess.floor_m)
    assert len(returns) == len(seen) == len(flight.scans) == 20
    assert (np.diff(seen) >= 0).all()
    assert (returns > 0).all()
    assert (returns <= 24 * 24).all()
    counted = np.concatenate(truth.visibility.slices)
    assert seen[-1] == pytest.approx((counted > 0).mean(), abs=0.05)
    length_m = np.linalg.norm(truth.tower.axes[:, 1] - truth.tower.axes[:, 0], axis=1).sum()
    assert len(slices(truth.tower.axes)) == pytest.approx(length_m / SLICE_M, rel=0.05)
