"""Inertial samples of a recording: which are of use, and in which unit they are."""

import math
from collections import Counter

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.types import GRAVITY, Array, Trajectory
from steelnb.io.clocks import rising_stamps

READING_MAX = 1e6
"""No sensor of a drone gives larger numbers, in any unit."""
GRAVITIES, GRAVITY_MAX = (0.7, 1.3), 3.0
"""Bounds of the median acceleration of a drone that hovers, in multiples of gravity; beyond the last it has no unit."""
UNITS = {"m/s²": 1.0, "g": GRAVITY, "mg": GRAVITY / 1000, "cm/s²": 0.01}
"""Units of accelerations that drivers give, in m/s²."""
RATE_MAX = 20.0
"""Maximum median angular rate of a drone, rad/s: twenty degrees a second are usual, twenty radians are not."""
SAMPLES_MIN = 100
"""Fewer samples, as of a second, tell nothing of what is usual."""
TURN_MIN, TURNS_MIN, DEGREES_MIN = 0.05, 3, 20.0
"""Minimum turn of the poses in a second, rad; such seconds, and the ratio of rates to turns, that tell degrees."""


def usable_samples(rows: Array, topic: str, poses: Trajectory, notes: dict[str, None], skipped: Counter[str]) -> Array:
    """Samples ``(M, 7)`` with rising stamps, in m/s² and rad/s, of ``rows (N, 7)``: stamp, acceleration, angular rate.

    Returns no samples if a unit is unknown; ``poses`` tell that of the rates. ``notes`` receive what is
    unusual, and ``skipped`` counts the samples that are left out.
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
    elif size > GRAVITY_MAX * GRAVITY:
        notes[f"inertial readings of {topic} are left out: {size:.5g} at rest, as of raw counts; expected m/s²"] = None
        return rising[:0]
    elif not GRAVITIES[0] < size / GRAVITY < GRAVITIES[1] and len(rising) >= SAMPLES_MIN:
        notes[f"accelerations of {topic} have a median of {size:.4g}, those of a drone that hovers 9.8 m/s²"] = None
    if _are_degrees(rising, poses):
        rising[:, 4:] = np.radians(rising[:, 4:])
        notes[f"angular rates of {topic} are in degrees a second, by the poses"] = None
    elif rate > RATE_MAX and len(rising) >= SAMPLES_MIN:
        notes[f"inertial readings of {topic} are left out: a median rate of {rate:.4g}; expected rad/s"] = None
        return rising[:0]
    return rising


def _are_degrees(samples: Array, poses: Trajectory) -> bool:
    """Whether rates turn by many times the turns of the poses, in most seconds in which these turn."""
    inside = np.flatnonzero((poses.stamp_s >= samples[0, 0]) & (poses.stamp_s <= samples[-1, 0]))
    at = inside[np.unique(np.floor(poses.stamp_s[inside]), return_index=True)[1]]
    if len(at) <= TURNS_MIN:
        return False
    stamp_s, R = poses.stamp_s[at], Rotation.from_matrix(poses.T_world_drone[at, :3, :3])
    turn = (R[:-1].inv() * R[1:]).magnitude()
    angle = np.cumsum(samples[:, 4:] * np.diff(samples[:, :1], axis=0, prepend=samples[:1, :1]), axis=0)
    rate = np.linalg.norm(np.diff([np.interp(stamp_s, samples[:, 0], each) for each in angle.T], axis=1), axis=0)
    turns = turn > TURN_MIN
    return bool(turns.sum() >= TURNS_MIN and np.median(rate[turns] / turn[turns]) > DEGREES_MIN)
