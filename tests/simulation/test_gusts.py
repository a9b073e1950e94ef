import numpy as np

from steelnb import rng
from steelnb.settings import FlightSettings
from steelnb.simulation.gusts import gusts


def test_gusts_depend_on_the_seed_and_start_at_rest():
    settings = FlightSettings()
    a, b, c = (gusts(settings, seed, 500, 0.008) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 0.01
    assert np.abs(a[0]).max() < 0.2 * np.abs(a).max()
    np.testing.assert_array_equal(gusts(settings, 1, 300, 0.008), a[:300])
    assert not gusts(settings.replace(gust_sigma_m_s=0.0), 1, 100, 0.008).any()


def test_gusts_follow_their_recursion_bit_for_bit():
    shocks = rng.stream(3, "gust").standard_normal((50, 3))
    keep, wind = np.exp(-0.008 / 2.0), np.zeros(3)
    for k, expected in enumerate(gusts(FlightSettings(), 3, 50, 0.008)):
        wind = keep * wind + 0.3 * np.sqrt(1 - keep**2) * shocks[k]
        np.testing.assert_allclose(expected, wind, rtol=1e-12)
