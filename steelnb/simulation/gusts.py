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

    Each axis is an Ornstein-Uhlenbeck process with standard deviation ``gust_sigma_m_s`` and correlation time
    `GUST_TIME_S`.
    """
    shocks = rng.stream(seed, "gust").standard_normal((steps, 3))
    decay = math.exp(-step_s / GUST_TIME_S)
    shocks = shocks * settings.gust_sigma_m_s * math.sqrt(1 - decay**2)
    # scipy.signal.lfilter gives the same bits, but its import takes longer than a short flight.
    return np.array(list(itertools.accumulate(shocks, lambda wind, shock: decay * wind + shock)))
