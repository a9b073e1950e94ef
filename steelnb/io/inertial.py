"""Inertial samples of a recording: which are of use, and in which unit they are."""

import math
from collections import Counter

import numpy as np

from steelnb.core.types import GRAVITY, Array
from steelnb.io.clocks import rising_stamps

READING_MAX = 1e6
"""No sensor of a drone gives larger numbers, in any unit."""
GRAVITIES = 0.7, 1.3
"""Bounds of the median acceleration of a drone that hovers, in multiples of gravity."""
UNITS = {"m/s²": 1.0, "g": GRAVITY, "mg": GRAVITY / 1000, "cm/s²": 0.01}
"""Units of accelerations that drivers give, in m/s²."""
RATE_MAX = 20.0
"""Maximum median angular rate of a drone, rad/s: twenty degrees a second are usual, twenty radians are not."""
SAMPLES_MIN = 100
"""Fewer samples, as of a second, tell nothing of what is usual."""


def usable_samples(rows: Array, topic: str, notes: dict[str, None], skipped: Counter[str]) -> Array:
    """Samples ``(M, 7)`` with rising stamps, in m/s² and rad/s, of ``rows (N, 7)``: stamp, acceleration, angular rate.

    Returns no samples if the rates are in another unit. ``notes`` receive what is unusual, and ``skipped`` counts
    the samples that are left out.
    """
    whole = rows[(np.abs(rows[:, 1:]) < READING_MAX).all(axis=1) & np.isfinite(rows[:, 0])]
    skipped["inertial sample that is not finite"] += len(rows) - len(whole)
    rising = whole[rising_stamps(whole[:, 0])]
    skipped["inertial sample whose stamp does not rise"] += len(whole) - len(rising)
    if not len(rising):
        return rising
    size = float(np.linalg.norm(np.median(rising[:, 1:4], axis=0)))  # of the vector: vibration has no direction
    rate = float(np.median(np.linalg.norm(rising[:, 4:], axis=1)))
    unit = min(UNITS, key=lambda name: abs(math.log(size * UNITS[name] / GRAVITY))) if size > 0 else ""
    if unit and GRAVITIES[0] < size * UNITS[unit] / GRAVITY < GRAVITIES[1] and unit != "m/s²":
        rising[:, 1:4] *= UNITS[unit]
        notes[f"accelerations of {topic} are in {unit}, with a median of {size:.4g}"] = None
    elif not GRAVITIES[0] < size / GRAVITY < GRAVITIES[1] and len(rising) >= SAMPLES_MIN:
        notes[f"accelerations of {topic} have a median of {size:.4g}, those of a drone that hovers 9.8 m/s²"] = None
    if rate > RATE_MAX and len(rising) >= SAMPLES_MIN:
        notes[f"inertial readings of {topic} are left out: a median rate of {rate:.4g}; expected rad/s"] = None
        return rising[:0]
    return rising
