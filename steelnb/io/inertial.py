"""Inertial samples of a recording: which are of use, and in which unit they are."""

import math
from collections import Counter
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from steelnb.core.types import GRAVITY, Array, Imu, Trajectory
from steelnb.io.clocks import rising_stamps

READING_MAX = 1e6
"""No sensor of a drone gives larger numbers, in any unit."""
GRAVITIES, GRAVITY_MIN, GRAVITY_MAX = (0.7, 1.3), 0.3, 3.0
"""Bounds of the median acceleration of a drone that hovers, in multiples of gravity; below the second it has none, and
beyond the last no unit."""
UNITS = {"m/s²": 1.0, "g": GRAVITY, "mg": GRAVITY / 1000, "cm/s²": 0.01}
"""Units of accelerations that drivers give, in m/s²."""
RATE_MAX = 20.0
"""Maximum median angular rate of a drone, rad/s: twenty degrees a second are usual, twenty radians are not."""
SAMPLES_MIN = 100
"""Fewer samples, as of a second, tell nothing of what is usual."""
UPRIGHT, POSES_MIN = 0.5, 10
"""Minimum cosine between the mean specific force and the vertical, and number of poses that tell."""
TURN_S, TURN_MIN, UNLIKE = 0.5, 0.05, 0.2
"""Rotations in the time from one to two of the first, seconds, tell the unit of rates if they exceed the second, rad;
and the share of them by which those of a gyroscope may differ."""


def readings_of(
    rows: Array, R_drone_imu: Array, topic: str, poses: Trajectory, note: Callable[[str], None], skipped: Counter[str]
) -> Imu | None:
    """Readings with rising stamps, in m/s² and rad/s, from ``rows (N, 7)``: stamp, acceleration, angular rate.

    Returns None if units or axes are unknown, by gravity and by the ``poses``. ``note`` is told what is unusual, and
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
        note(f"accelerations of {topic} are in {unit}, with a median of {size:.4g}")
    elif size > GRAVITY_MAX * GRAVITY:
        fault = f"{size:.5g} at rest, as of raw counts; expected m/s²"
    elif not GRAVITIES[0] < size / GRAVITY < GRAVITIES[1] and are_many:
        note(f"accelerations of {topic} have a median of {size:.4g}, those of a drone that hovers 9.8 m/s²")
    median_rate = float(np.median(np.linalg.norm(rate, axis=1)))
    if median_rate > RATE_MAX and are_many:
        fault = f"a median rate of {median_rate:.4g}; expected rad/s"
    elif not force.any():
        fault = "accelerations of 0; expected those of gravity"
    force, rate = force @ R_drone_imu.T, rate @ R_drone_imu.T
    inside = (stamp_s >= poses.stamp_s[0]) & (stamp_s <= poses.stamp_s[-1])
    if stamp_s[-1] < poses.stamp_s[0] or stamp_s[0] > poses.stamp_s[-1]:
        fault = f"stamps from {stamp_s[0]:.3f} s on, poses from {poses.stamp_s[0]:.3f} s; expected one clock"
    elif are_many and len(poses) >= POSES_MIN and inside.sum() >= SAMPLES_MIN and not fault:
        R_world_drone = Slerp(poses.stamp_s, Rotation.from_matrix(poses.T_world_drone[:, :3, :3]))(stamp_s[inside])
        mean = R_world_drone.apply(force[inside]).mean(axis=0)  # vibration has none
        mean_size = float(np.linalg.norm(mean))
        typical = float(np.median(np.linalg.norm(force, axis=1)))
        if mean_size < GRAVITY_MIN * GRAVITY and typical < GRAVITIES[0] * GRAVITY:
            fault = f"accelerations of {mean_size:.2g} m/s² in the mean; expected those of gravity"
        elif mean_size > GRAVITIES[0] * GRAVITY and mean[2] < UPRIGHT * mean_size:
            fault = f"at rest {np.round(mean, 1).tolist()} m/s² in the world; expected z up (tf_static)"
        elif degrees := _rate_in_degrees(stamp_s[inside], rate[inside], poses):
            fault = f"a median rate of {degrees:.3g} in turns of {np.radians(degrees):.2g} rad/s; expected rad/s"
    if fault:
        note(f"inertial readings of {topic} are left out: {fault}")
        return None
    return Imu(stamp_s, force, rate)


def _rate_in_degrees(stamp_s: Array, rate: Array, poses: Trajectory) -> float:
    """The median of a rate ``(N, 3)`` in turns of the ``poses`` if it is theirs in degrees a second; 0 if it is not, or
    if the drone turns too little."""
    end = np.searchsorted(poses.stamp_s, poses.stamp_s + TURN_S)
    begin = np.flatnonzero((poses.stamp_s >= stamp_s[0]) & (end < (poses.stamp_s <= stamp_s[-1]).sum()))
    end = end[begin]
    time_s = poses.stamp_s[end] - poses.stamp_s[begin]
    R = Rotation.from_matrix(poses.T_world_drone[:, :3, :3])
    turn = (R[begin].inv() * R[end]).magnitude()
    means = (rate[1:] + rate[:-1]) / 2 * np.diff(stamp_s)[:, None]
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(means, axis=0)])
    integral = np.stack([np.interp(poses.stamp_s, stamp_s, axis) for axis in integral.T], axis=1)
    angle = np.linalg.norm(integral[end] - integral[begin], axis=1)
    tells = (turn > TURN_MIN) & (time_s < 2 * TURN_S)
    if tells.sum() < POSES_MIN:
        return 0.0
    turn, angle, time_s = turn[tells], angle[tells], time_s[tells]
    shown = np.abs((angle + np.pi) % (2 * np.pi) - np.pi)  # if it is in radians: two poses do not show whole turns
    is_other = np.median(np.abs(shown - turn) / turn) > 1
    is_so = is_other and np.median(np.abs(np.radians(angle) - turn) / turn) < UNLIKE
    return float(np.median(angle / time_s)) if is_so else 0.0
