"""Where the structure is, seen from a position: its middle, its nearest part, and how far that is."""

import numpy as np

from steelnb.types import Array

NEAR_M = 0.35
"""Steel that is so much further away than the nearest counts e times less for where the nearest is."""


def turn_to(angle: float) -> float:
    """An angle, radians, as the turn from −π to π that leads to it."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def middle_of(points: Array, position: Array) -> Array:
    """From a position ``(3,)`` to the middle of the ``points (N, 3)`` around it, metres; those at its height and near
    it weigh more."""
    arm = points - position
    weight = np.exp(-0.5 * (arm[:, 2] / 1.0) ** 2) / (0.25 + (arm[:, :2] ** 2).sum(axis=1))
    return np.asarray((weight @ arm) / max(float(weight.sum()), 1e-12))


def towards_nearest(points: Array, position: Array) -> Array:
    """Horizontal unit vector ``(2,)`` towards the nearest structure at about the same height."""
    arm = points - position
    arm = arm[np.abs(arm[:, 2]) < 1.0, :2] if (np.abs(arm[:, 2]) < 1.0).any() else arm[:, :2]
    distance = np.maximum(np.hypot(*arm.T), 1e-6)
    weight = np.exp(-(distance - np.percentile(distance, 5)) / NEAR_M) / distance
    towards = weight @ arm
    return np.asarray(towards / max(float(np.hypot(*towards)), 1e-9))


def distance_ahead(points: Array, position: Array, facing: Array) -> float:
    """Horizontal distance to the nearest structure ahead, at about the same height."""
    arm = points - position
    ahead, aside = arm[:, :2] @ facing, arm[:, :2] @ np.array([-facing[1], facing[0]])
    near = (np.abs(arm[:, 2]) < 0.7) & (ahead > 0) & (np.abs(aside) < np.maximum(ahead, 0.7))
    if near.sum() < 5:
        return float(np.hypot(*middle_of(points, position)[:2]))
    return float(np.percentile(np.hypot(ahead[near], aside[near]), 5))
