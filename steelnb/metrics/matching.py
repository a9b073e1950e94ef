"""Which member each estimated segment lies on: the match behind the scores of maps and of reconstructions."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steelnb.types import Array, IntArray, Segments

ANGLE_MAX_RAD, DISTANCE_MAX_M, SHARE_MIN = math.radians(5), 0.10, 0.5
SAMPLES = 41


@dataclass(frozen=True)
class Match:
    """The member of each of S segments, −1 for none, and how the segment lies to it, NaN for none.

    ``angle_rad (S,)`` to the axis; ``offset_m (S,)``, mean distance to the axis of the part on the member; ``near_m
    (S, 2)`` and ``whole_m (S, 2)``: the interval that this part and the whole segment cover along the axis.
    """

    member: IntArray
    angle_rad: Array
    offset_m: Array
    near_m: Array
    whole_m: Array

    @property
    def right(self) -> NDArray[np.bool_]:
        """The segments that lie on a member ``(S,)``."""
        return self.member >= 0


def match_members(
    segments: Segments,
    axes: Array,
    angle_max_rad: float = ANGLE_MAX_RAD,
    distance_max_m: float = DISTANCE_MAX_M,
) -> Match:
    """The member with axis ``(M, 2, 3)`` that the largest part of each segment lies on, both in the world frame.

    A sample of a segment lies on a member when their angle is within ``angle_max_rad``, its distance to the axis within
    ``distance_max_m``, and its foot no further than that beyond the ends. A segment lies on the member with the largest
    share of its 41 samples, if that is at least half; of equal shares, on the nearest.
    """
    begin = axes[:, 0]
    length = np.linalg.norm(axes[:, 1] - begin, axis=1)
    axis = (axes[:, 1] - begin) / length[:, None]
    cosine = np.clip(np.abs(segments.direction @ axis.T), 0, 1)
    n, part = len(segments), np.linspace(0, 1, SAMPLES)
    member, angle, offset = np.full(n, -1, dtype=np.int64), np.full(n, np.nan), np.full(n, np.nan)
    near_m, whole_m = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
    for s in range(n):
        candidates = np.flatnonzero(cosine[s] >= math.cos(angle_max_rad))
        if not len(candidates):
            continue
        sample = segments.start[s] + part[:, None] * (segments.end[s] - segments.start[s])
        apart = sample[:, None] - begin[candidates]
        along = (apart * axis[candidates]).sum(axis=2)
        distance = np.linalg.norm(apart - along[..., None] * axis[candidates], axis=2)
        beyond = np.maximum(-along, along - length[candidates])
        near = (distance <= distance_max_m) & (beyond <= distance_max_m)
        # Equal shares happen where members run side by side.
        k = int(np.lexsort((distance.mean(axis=0), -near.mean(axis=0)))[0])
        if near[:, k].mean() < SHARE_MIN:
            continue
        inside = along[near[:, k], k]
        member[s], angle[s] = candidates[k], np.arccos(cosine[s, candidates[k]])
        offset[s] = distance[near[:, k], k].mean()
        near_m[s], whole_m[s] = (inside.min(), inside.max()), (along[:, k].min(), along[:, k].max())
    return Match(member, angle, offset, near_m, whole_m)
