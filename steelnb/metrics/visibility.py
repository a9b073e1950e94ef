"""Share of the steel that a flight has observed."""

import numpy as np
from scipy.spatial import cKDTree

from steelnb.core.geometry import transform_points
from steelnb.core.types import Array, Flight
from steelnb.simulation.truth import SLICE_M, Truth

STEEL_M = 0.15
"""Maximum distance of a return from the middle of the slice that it counts for."""
EVERY = 5
"""Only every fifth return is looked up."""


def sight(flight: Flight, truth: Truth, floor_m: float) -> tuple[Array, Array]:
    """Number of returns above ``floor_m`` at the true pose, and share of the steel observed so far, of each scan."""
    tree = cKDTree(slices(truth.tower.axes))
    seen, returns, shares = np.zeros(tree.n, dtype=bool), [], []
    T_world_sensor = truth.trajectory.at(flight.prior.stamp_s).T_world_drone @ flight.T_drone_sensor
    for scan, T in zip(flight.scans, T_world_sensor, strict=True):
        points = transform_points(T, scan.points.reshape(-1, 3))
        points = points[points[:, 2] > floor_m]  # a pixel without a return is NaN
        near = tree.query(points[::EVERY], distance_upper_bound=STEEL_M)[1]
        seen[near[near < tree.n]] = True
        returns.append(len(points))
        shares.append(seen.mean())
    return np.array(returns), np.array(shares)


def slices(axes: Array) -> Array:
    """Middles ``(S, 3)`` of the slices of all members ``(M, 2, 3)``."""
    middles = []
    for begin, end in axes:
        count = max(1, round(float(np.linalg.norm(end - begin)) / SLICE_M))
        middles.append(begin + (np.arange(count)[:, None] + 0.5) / count * (end - begin))
    return np.concatenate(middles)
