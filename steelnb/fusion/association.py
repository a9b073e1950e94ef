"""Association of segments with the bars of a map."""

import math

import numpy as np
from numba import njit

from steelnb.settings import FusionSettings
from steelnb.types import Array, IntArray, Segments

GAP_MAX_M = 0.2
"""Maximum gap along the axis between a segment and its bar."""


def associate(new: Segments, known: Segments, settings: FusionSettings) -> IntArray:
    """The nearest of K known segments for each of M new ones ``(M,)``, −1 if none matches.

    Both in the same frame, metres. Two segments match if the angle between them and the distance across are within the
    settings, and the gap along the known axis within `GAP_MAX_M`. The distance across is that in the middle of their
    overlap, or of the gap between them. The order of the ends of a segment does not matter.
    """
    if not len(new) or not len(known):
        return np.full(len(new), -1, dtype=np.int64)
    distance = pair_distance(new, known, settings)
    best = distance.argmin(axis=1)
    return np.where(np.isfinite(distance[np.arange(len(new)), best]), best, -1)


def pair_distance(new: Segments, known: Segments, settings: FusionSettings) -> Array:
    """Distances across ``(M, K)`` in metres between all pairs; infinite for pairs that do not match."""
    return _pair_distance(
        new.start, new.end, new.radius, known.start, known.end, known.radius, math.cos(settings.angle_max_rad),
        settings.distance_max_m, settings.add_radii,
    )  # fmt: skip


@njit(cache=True)
def _pair_distance(start, end, radius, known_start, known_end, known_radius, cosine_min, limit_m, add_radii):  # type: ignore[no-untyped-def]
    distance = np.full((len(start), len(known_start)), np.inf)
    for k in range(len(known_start)):
        x, y, z = known_start[k, 0], known_start[k, 1], known_start[k, 2]
        ux, uy, uz = known_end[k, 0] - x, known_end[k, 1] - y, known_end[k, 2] - z
        length = math.sqrt(ux * ux + uy * uy + uz * uz)
        scale = 1.0 / max(length, 1e-12)
        ux, uy, uz = ux * scale, uy * scale, uz * scale
        for m in range(len(start)):
            rx, ry, rz = end[m, 0] - start[m, 0], end[m, 1] - start[m, 1], end[m, 2] - start[m, 2]
            run = rx * ux + ry * uy + rz * uz
            if not abs(run) >= cosine_min * max(math.sqrt(rx * rx + ry * ry + rz * rz), 1e-12):
                continue
            ax, ay, az = start[m, 0] - x, start[m, 1] - y, start[m, 2] - z
            t_start = ax * ux + ay * uy + az * uz
            low, high = min(t_start, t_start + run), max(t_start, t_start + run)
            if max(low - length, -high) > GAP_MAX_M:
                continue
            t_middle = 0.5 * (min(max(low, 0.0), length) + min(max(high, 0.0), length))
            share = min(max((t_middle - t_start) / (run if abs(run) > 1e-9 else 1e-9), 0.0), 1.0)
            ax, ay, az = ax + share * rx, ay + share * ry, az + share * rz
            t = ax * ux + ay * uy + az * uz
            ax, ay, az = ax - t * ux, ay - t * uy, az - t * uz
            across = math.sqrt(ax * ax + ay * ay + az * az)
            if across <= limit_m + (radius[m] + known_radius[k] if add_radii else 0.0):
                distance[m, k] = across
    return distance
