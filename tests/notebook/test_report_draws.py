"""The seed ``report`` against the drift in the report's figures."""

import numpy as np
import pytest

from steelnb.notebook.report import report_curve
from steelnb.settings import Noise, read_report_plots
from steelnb.simulation.drift import drift_errors

UNEVEN = [plot for plot in read_report_plots() if not plot.steps_per_sample]
EVEN = [plot for plot in read_report_plots() if plot.steps_per_sample]


def drifts(plot, sideways=0.0):
    """The drift curve of a plot as read off the report (metres), and the drift drawn there, or at most ``sideways``
    samples
    beside it, where it agrees best. Curves are straight between samples."""
    time_s, shown = report_curve(plot, "drift")
    length = np.linalg.norm(
        drift_errors(0.008 * np.arange(plot.steps[-1] + 1), Noise.parse(plot.noise), "report")[:, :3, 3], axis=1
    )[plot.steps]
    number = np.interp(time_s, 0.008 * plot.steps, np.arange(plot.samples))
    drawn = np.array(
        [np.interp(number + by, np.arange(plot.samples), length) for by in np.linspace(-1, 1, 21) * sideways]
    )
    return shown, drawn[np.abs(drawn - shown).argmin(axis=0), np.arange(len(shown))]


@pytest.mark.parametrize("plot", UNEVEN, ids=lambda plot: plot.name)
def test_at_the_published_samples_the_drift_is_the_report_s_within_4_mm(plot):
    """A curve can be read off to half a percent of its axis, which is half a sample and more in each of these plots."""
    shown, drawn = drifts(plot, sideways=0.5)
    assert len(shown) > 200
    assert np.abs(shown - drawn).mean() <= 0.004
    at_their_place = np.abs(np.subtract(*drifts(plot))).mean()
    assert at_their_place <= (0.01 if plot.noise == "random-walk" else 0.002)
    even = np.linspace(plot.steps[0], plot.steps[-1], plot.samples)
    assert np.abs(even - plot.steps).max() > 500, "evenly spaced samples would be seconds off"


@pytest.mark.parametrize("plot", EVEN, ids=lambda plot: plot.name)
def test_the_drift_is_the_report_s(plot):
    shown, drawn = drifts(plot)
    if plot.run:  # the curve falls to the next run's first sample
        shown, drawn = shown[:-1], drawn[:-1]
    assert len(shown) > 60
    assert drawn[-1] / shown[-1] == pytest.approx(1, abs=0.03 if not plot.run else 0.1)
    assert np.abs(shown - drawn).mean() < 0.012
    assert np.corrcoef(shown, drawn)[0, 1] > (0.99 if not plot.run else 0.95)


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
