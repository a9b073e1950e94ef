"""Inertial samples of a recording: which are of use, and in which unit they are."""

import math
from collections import Counter

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.types import GRAVITY, Array, Imu, Trajectory
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
UPRIGHT, POSES_MIN = 0.5, 10
"""Minimum cosine between the mean specific force and the vertical, and number of poses that tell."""
TURN_MIN, TURNS_MIN, DEGREES_MIN = 0.05, 3, 20.0
"""Minimum turn of the poses in a second, rad; such seconds, and the ratio of rates to turns, that tell degrees."""


def readings_of(
    rows: Array, R_drone_imu: Array, topic: str, poses: Trajectory, notes: dict[str, None], skipped: Counter[str]
) -> Imu | None:
    """Readings with rising stamps, in m/s² and rad/s, from ``rows (N, 7)``: stamp, acceleration, angular rate.

    Returns None if units or axes are unknown, by gravity and by the ``poses``. ``notes`` receive what is unusual, and
    ``skipped`` counts the samples that are left out.
    """
    whole = rows[(np.abs(rows[:, 1:]) < READING_MAX).all(axis=1) & np.isfinite(rows[:, 0])]
    skipped["inertial sample that is not finite"] += len(rows) - len(whole)
    rising = whole[rising_stamps(whole[:, 0])]
    skipped["inertial sample whose stamp does not rise"] += len(whole) - len(rising)
    if not len(rising):
        return None
    stamp_s, force, rate = rising[:, 0], rising[:, 1:4], rising[:, 4:]
    size = float(np.linalg.norm(np.median(force, axis=0)))  # of the vector: vibration has no direction
    unit = min(UNITS, key=lambda name: abs(math.log(size * UNITS[name] / GRAVITY))) if size > 0 else ""
    are_many, fault = len(rising) >= SAMPLES_MIN, ""
    if unit and GRAVITIES[0] < size * UNITS[unit] / GRAVITY < GRAVITIES[1] and unit != "m/s²":
        force *= UNITS[unit]
        notes[f"accelerations of {topic} are in {unit}, with a median of {size:.4g}"] = None
    elif size > GRAVITY_MAX * GRAVITY:
        fault = f"{size:.5g} at rest, as of raw counts; expected m/s²"
    elif not GRAVITIES[0] < size / GRAVITY < GRAVITIES[1] and are_many:
        notes[f"accelerations of {topic} have a median of {size:.4g}, those of a drone that hovers 9.8 m/s²"] = None
    median_rate = float(np.median(np.linalg.norm(rate, axis=1)))
    if _are_degrees(rising, poses):
        rate *= np.pi / 180
        notes[f"angular rates of {topic} are in degrees a second, by the poses"] = None
    elif median_rate > RATE_MAX and are_many:
        fault = f"a median rate of {median_rate:.4g}; expected rad/s"
    force, rate = force @ R_drone_imu.T, rate @ R_drone_imu.T
    inside = (poses.stamp_s >= stamp_s[0]) & (poses.stamp_s <= stamp_s[-1])
    if stamp_s[-1] < poses.stamp_s[0] or stamp_s[0] > poses.stamp_s[-1]:
        fault = f"stamps from {stamp_s[0]:.3f} s on, poses from {poses.stamp_s[0]:.3f} s; expected one clock"
    elif are_many and inside.sum() >= POSES_MIN and not fault:
        at_poses = np.stack([np.interp(poses.stamp_s[inside], stamp_s, each) for each in force.T], axis=-1)
        up = np.einsum("nij,nj->i", poses.T_world_drone[inside, :3, :3], at_poses) / inside.sum()
        if np.linalg.norm(up) > GRAVITIES[0] * GRAVITY and up[2] < UPRIGHT * np.linalg.norm(up):
            fault = f"at rest {np.round(up, 1).tolist()} m/s² in the world; expected z up (tf_static)"
    if fault:
        notes[f"inertial readings of {topic} are left out: {fault}"] = None
        return None
    return Imu(stamp_s, force, rate)


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
