"""Association of segments with the bars of a map."""

import math

import numpy as np

from steelnb.settings import FusionSettings
from steelnb.types import Array, IntArray, Segments

GAP_MAX_M = 0.2
"""Along the axis, between the ends of a segment and of the bar that it belongs to."""


def associate(new: Segments, known: Segments, settings: FusionSettings) -> IntArray:
    """The nearest of K known segments for each of M new ones ``(M,)``, −1 where none matches.

    Both in the same frame, metres. Two segments match when the angle between them, the distance across (at the middle
    of their overlap along the known axis, or of the gap between them) and the gap along that axis are within the
    settings. Nearest: smallest distance across. Which end of a segment is its start does not matter.
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
    return np.where(parallel & (gap <= GAP_MAX_M) & (distance <= limit), distance, np.inf)
