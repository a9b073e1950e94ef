"""Wind velocity along a flight."""

import itertools
import math

import numpy as np

from steelnb import rng
from steelnb.settings import FlightSettings
from steelnb.types import Array

GUST_TIME_S = 2.0
"""Correlation time of gusts."""


def gusts(settings: FlightSettings, seed: rng.Seed, steps: int, step_s: float) -> Array:
    """Wind velocity at each step, ``(steps, 3)`` m/s in the world frame, from the stream ``gust`` of the seed.

    An Ornstein-Uhlenbeck process on each axis, with the standard deviation ``gust_sigma_m_s`` and the correlation time
    `GUST_TIME_S`.
    """
    shocks = rng.stream(seed, "gust").standard_normal((steps, 3))
    keep = math.exp(-step_s / GUST_TIME_S)
    shocks = shocks * settings.gust_sigma_m_s * math.sqrt(1 - keep**2)
    # Not scipy.signal.lfilter, which gives the same bits: to import it takes longer than a short flight.
    return np.array(list(itertools.accumulate(shocks, lambda wind, shock: keep * wind + shock)))
