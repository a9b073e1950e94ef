"""Which segments are pieces of the same bar."""

import math

import numpy as np

from steelnb.config import FusionSettings
from steelnb.datatypes import Array, IntArray, Segments


def associate(new: Segments, known: Segments, settings: FusionSettings) -> IntArray:
    """For each of the new segments ``(M,)`` the nearest known one that it may belong to, or −1.

    Two segments match when the angle between them, the distance across (from the middle of what they share along the
    known axis) and the gap along that axis are within the settings. Nearest means the smallest distance across.
    """
    if not len(new) or not len(known):
        return np.full(len(new), -1, dtype=np.int64)
    distance = pair_distance(new, known, settings)
    best = distance.argmin(axis=1)
    return np.where(np.isfinite(distance[np.arange(len(new)), best]), best, -1)


def pair_distance(new: Segments, known: Segments, settings: FusionSettings) -> Array:
    """Distances across ``(M, K)`` in metres between all pairs; infinite for pairs that do not match."""
    axis = known.direction
    parallel = np.abs(new.direction @ axis.T) >= math.cos(settings.angle_max_rad)
    begin, length = known.start, known.length
    t_start = new.start @ axis.T - (begin * axis).sum(axis=1)
    t_end = new.end @ axis.T - (begin * axis).sum(axis=1)
    low, high = np.minimum(t_start, t_end), np.maximum(t_start, t_end)
    gap = np.maximum(low - length, -high)

    # Compare the axes where both are: in the middle of the overlap, or of the gap between them.
    t_middle = 0.5 * (np.clip(low, 0, length) + np.clip(high, 0, length))
    run = t_end - t_start
    share = np.clip((t_middle - t_start) / np.where(np.abs(run) < 1e-9, 1e-9, run), 0, 1)
    at_new = new.start[:, None] + share[..., None] * (new.end - new.start)[:, None]
    across = at_new - begin - ((at_new - begin) * axis).sum(axis=2)[..., None] * axis
    distance = np.linalg.norm(across, axis=2)
    limit = settings.distance_max_m + (new.radius[:, None] + known.radius if settings.add_radii else 0.0)
    return np.where(parallel & (gap <= settings.gap_max_m) & (distance <= limit), distance, np.inf)
