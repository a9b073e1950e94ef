import numpy as np
import pytest
from scipy.signal import welch

from steelnb.errors import InputError
from steelnb.settings import FlightSettings
from steelnb.simulation.gusts import FOOT_M, dryden, gusts

STEP_S = 0.04


def along_the_wind(seed, heading=0.0, sigma=0.5, height=6.096):
    shocks = np.random.default_rng(seed).standard_normal((200_000, 3))
    return dryden(shocks, STEP_S, sigma, height, heading)[5000:]


def test_dryden_gusts_have_the_standard_deviations_of_the_specification():
    """At 20 feet: σ_w as given, σ_u = σ_v = σ_w / (0.177 + 0.000823 · 20)^0.4."""
    spread = np.array([along_the_wind(seed).std(axis=0) for seed in range(4)]).mean(axis=0)
    level = 0.5 / (0.177 + 0.000823 * 20) ** 0.4
    np.testing.assert_allclose(spread, [level, level, 0.5], rtol=0.06)


def test_dryden_gusts_have_the_spectra_of_the_specification():
    """One-sided densities in Hz: 4·σ²·T / (1 + (T ω)²) along the wind, 2·σ²·T (1 + 3 (T ω)²) / (1 + (T ω)²)² across."""
    wind, feet = 5.0, 20.0
    near_ground = 0.177 + 0.000823 * feet
    level_s, upright_s = feet / near_ground**1.2 * FOOT_M / wind, feet * FOOT_M / wind
    level = 0.5 / near_ground**0.4
    found = [welch(along_the_wind(seed), 1 / STEP_S, nperseg=4096, axis=0) for seed in range(4)]
    hz, density = found[0][0], np.mean([power for _, power in found], axis=0)
    some = (hz > 0.03) & (hz < 2.0)
    w = 2 * np.pi * hz[some]
    expected = [
        4 * level**2 * level_s / (1 + (level_s * w) ** 2),
        2 * level**2 * level_s * (1 + 3 * (level_s * w) ** 2) / (1 + (level_s * w) ** 2) ** 2,
        2 * 0.5**2 * upright_s * (1 + 3 * (upright_s * w) ** 2) / (1 + (upright_s * w) ** 2) ** 2,
    ]
    ratio = density[some] / np.array(expected).T
    blocks = np.array([part.mean(axis=0) for part in np.array_split(ratio, 6)])
    np.testing.assert_allclose(blocks, 1, atol=0.12)


def test_the_wind_turns_dryden_gusts_about_the_vertical():
    straight, turned = along_the_wind(1), along_the_wind(1, heading=np.pi / 2)
    np.testing.assert_allclose(turned, np.column_stack([-straight[:, 1], straight[:, 0], straight[:, 2]]), atol=1e-12)


def test_gusts_are_those_of_their_seed_and_begin_calm():
    settings = FlightSettings(gust_spectrum="dryden")
    a, b, c = (gusts(settings, seed, 500, 0.008) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 0.01
    assert np.abs(a[0]).max() < 0.2 * np.abs(a).max()
    np.testing.assert_array_equal(gusts(settings, 1, 300, 0.008), a[:300])
    assert not gusts(settings.replace(gust_sigma_m_s=0.0), 1, 100, 0.008).any()


def test_first_order_gusts_are_the_recursion_that_they_always_were():
    from steelnb import rng

    shocks = rng.stream(3, "gust").standard_normal((50, 3))
    keep, wind = np.exp(-0.008 / 2.0), np.zeros(3)
    for k, expected in enumerate(gusts(FlightSettings(), 3, 50, 0.008)):
        wind = keep * wind + 0.3 * np.sqrt(1 - keep**2) * shocks[k]
        np.testing.assert_allclose(expected, wind, rtol=1e-12)


def test_an_unknown_spectrum_is_refused_in_one_line():
    with pytest.raises(InputError, match=r"gust_spectrum = 'von-karman'.*'first-order' or 'dryden'") as caught:
        FlightSettings(gust_spectrum="von-karman")
    assert "\n" not in str(caught.value)
