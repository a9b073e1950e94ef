"""Where segments meet: the shortest distance between them (the report's joints)."""

from dataclasses import dataclass

import numpy as np

from steelnb.datatypes import Array, IntArray, Segments


@dataclass(frozen=True)
class Intersections:
    """``point (P, 3)``, halfway between the two segments; ``pair (P, 2)``; ``distance (P,)`` in metres."""

    point: Array
    pair: IntArray
    distance: Array


def intersections(segments: Segments, distance_max_m: float, parallel_cosine: float = 0.98) -> Intersections:
    """All pairs of segments that come within ``distance_max_m`` of each other, parallel ones left out.

    Closest points of two segments after Ericson, Real-Time Collision Detection (2005), section 5.1.9.
    """
    i, j = np.triu_indices(len(segments), 1)
    d1, d2 = segments.end[i] - segments.start[i], segments.end[j] - segments.start[j]
    r = segments.start[i] - segments.start[j]
    a, e = (d1 * d1).sum(1), (d2 * d2).sum(1)
    b, c, f = (d1 * d2).sum(1), (d1 * r).sum(1), (d2 * r).sum(1)
    denominator = a * e - b * b
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.clip(np.where(denominator > 1e-12 * a * e, (b * f - c * e) / denominator, 0.0), 0, 1)
        t = np.clip((b * s + f) / e, 0, 1)
        s = np.clip((b * t - c) / a, 0, 1)
    p, q = segments.start[i] + s[:, None] * d1, segments.start[j] + t[:, None] * d2
    distance = np.linalg.norm(p - q, axis=1)
    met = (distance <= distance_max_m) & (np.abs(b) < parallel_cosine * np.sqrt(a * e))
    return Intersections(0.5 * (p + q)[met], np.stack([i, j], axis=1)[met], distance[met])
