"""The seed ``report`` against the drift in the report's figures."""

import numpy as np
import pytest

from steelnb.batch import report_curve
from steelnb.noise import drift_errors
from steelnb.settings import Noise, read_report_plots


@pytest.mark.parametrize("plot", read_report_plots(), ids=lambda plot: f"{plot.figure} {plot.trajectory} {plot.method}")
def test_the_drift_is_the_report_s(plot):
    time_s, shown = report_curve(plot, "drift")
    stamp_s = np.arange(np.ceil(125 * time_s.max()) + 1) / 125
    errors = drift_errors(stamp_s, Noise.parse(plot.noise), "report")
    drawn = np.interp(time_s, stamp_s, np.linalg.norm(errors[:, :3, 3], axis=1))
    end = drawn[-1] / shown[-1]
    assert len(shown) > 140
    if plot.noise == "constant-drift":
        assert end == pytest.approx(1, abs=0.03)
    elif plot.method == "gicp":  # few and unevenly spaced samples
        assert np.corrcoef(shown, drawn)[0, 1] > 0.9
    else:
        assert np.corrcoef(shown, drawn)[0, 1] > 0.99
        assert end == pytest.approx(1, abs=0.03)
        assert np.abs(shown - drawn).mean() < 0.02


def test_draws_equal_the_original_s_generator_and_order():
    generator = np.random.RandomState(42)  # as `numpy.random` itself after `numpy.random.seed(42)`
    walk, place, heading = [np.zeros(3)], np.zeros(3), 0.0
    for _ in range(50):
        place = place + generator.normal(0, 0.002, 3)
        heading += generator.normal(0, 0.0005)
        walk.append(place)
    both = drift_errors(np.arange(51) / 125, Noise.parse("random-walk+yaw-random-walk"), "report")
    np.testing.assert_allclose(both[:, :3, 3], walk, atol=1e-15)
    assert np.arctan2(both[-1, 1, 0], both[-1, 0, 0]) == pytest.approx(heading)
    constant = drift_errors(np.arange(51) / 125, Noise.parse("constant-drift"), "report")
    np.testing.assert_allclose(np.diff(1e3 * constant[:, :3, 3], axis=0), [[0.0497, -0.0138, 0.0648]] * 50, atol=5e-5)
    np.testing.assert_array_equal(constant[:, :3, :3], np.tile(np.eye(3), (51, 1, 1)))
