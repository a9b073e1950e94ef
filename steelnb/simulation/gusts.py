"""Wind velocity along a flight: gusts without a spectrum of their own, or with Dryden's."""

import itertools
import math

import numpy as np

from steelnb import rng
from steelnb.settings import FlightSettings
from steelnb.types import Array

GUST_TIME_S = 2.0
"""Correlation time of first-order gusts."""
FOOT_M = 0.3048


def gusts(settings: FlightSettings, seed: rng.Seed, steps: int, step_s: float) -> Array:
    """Wind velocity at each step, ``(steps, 3)`` m/s in the world frame, from the stream ``gust`` of the seed.

    ``first-order``: an Ornstein-Uhlenbeck process on each axis, with the standard deviation ``gust_sigma_m_s`` and the
    correlation time `GUST_TIME_S`. ``dryden``: see `dryden`; the direction of the mean wind comes from the stream
    ``wind``.
    """
    shocks = rng.stream(seed, "gust").standard_normal((steps, 3))
    if settings.gust_spectrum == "dryden":
        height_m = 0.5 * (settings.height_min_m + settings.height_max_m)
        return dryden(
            shocks, step_s, settings.gust_sigma_m_s, height_m, rng.stream(seed, "wind").uniform(0, 2 * math.pi)
        )
    keep = math.exp(-step_s / GUST_TIME_S)
    shocks = shocks * settings.gust_sigma_m_s * math.sqrt(1 - keep**2)
    # Not scipy.signal.lfilter, which gives the same bits: to import it takes longer than a short flight.
    return np.array(list(itertools.accumulate(shocks, lambda wind, shock: keep * wind + shock)))


def dryden(shocks: Array, step_s: float, sigma_m_s: float, height_m: float, heading_rad: float) -> Array:
    """Gusts with Dryden's spectra below 1000 feet (MIL-F-8785C, 3.7.3): white noise ``shocks (N, 3)`` through their
    forming filters, from a calm at the start.

    ``sigma_m_s`` is the standard deviation along the vertical, a tenth of the mean wind at 20 feet. That wind, towards
    ``heading_rad``, carries the gusts past a drone that is slow beside it; its own push, which a drone leans against,
    is left out. Lengths and standard deviations are those of ``height_m``, at least 10 feet.
    """
    if sigma_m_s == 0:
        return np.zeros_like(shocks)
    from scipy.signal import bilinear, lfilter  # late: it takes a third of a second to import

    feet = max(height_m / FOOT_M, 10.0)
    near_ground = 0.177 + 0.000823 * feet
    wind_m_s = 10 * sigma_m_s
    level_s = feet / near_ground**1.2 * FOOT_M / wind_m_s
    upright_s = feet * FOOT_M / wind_m_s
    level_sigma = sigma_m_s / near_ground**0.4
    along, across = math.sqrt(2 * level_s) * level_sigma, math.sqrt(level_s) * level_sigma
    upright = math.sqrt(upright_s) * sigma_m_s
    filters = [
        ([along], [level_s, 1]),
        ([math.sqrt(3) * level_s * across, across], [level_s**2, 2 * level_s, 1]),
        ([math.sqrt(3) * upright_s * upright, upright], [upright_s**2, 2 * upright_s, 1]),
    ]
    white = shocks / math.sqrt(step_s)
    u, v, w = (lfilter(*bilinear(*each, 1 / step_s), column) for each, column in zip(filters, white.T, strict=True))
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    return np.column_stack([c * u - s * v, s * u + c * v, w])
