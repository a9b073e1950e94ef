"""Association of estimated segments with true members."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steelnb.types import Array, IntArray, Segments

ANGLE_MAX_RAD, DISTANCE_MAX_M, SHARE_MIN = math.radians(5), 0.10, 0.5
"""Maximum angle and distance of a segment from its member, and minimum share of its samples on it."""
SAMPLES = 41
"""Number of samples along a segment."""


@dataclass(frozen=True)
class Match:
    """Member of each of S segments, −1 for none, and the errors of the segment, NaN for none.

    ``angle_rad (S,)``: to the axis of the member; ``offset_m (S,)``: mean distance to the axis of the samples on the
    member. Intervals along the axis: ``matched_m (S, 2)`` of these samples, ``extent_m (S, 2)`` of all samples.
    """

    member: IntArray
    angle_rad: Array
    offset_m: Array
    matched_m: Array
    extent_m: Array

    @property
    def right(self) -> NDArray[np.bool_]:
        """Whether each segment lies on a member ``(S,)``."""
        return self.member >= 0


def match_members(
    segments: Segments, axes: Array, angle_max_rad: float = ANGLE_MAX_RAD, distance_max_m: float = DISTANCE_MAX_M
) -> Match:
    """Associate each segment with the member on whose axis ``(M, 2, 3)`` most of it lies; both in the world frame.

    A sample of a segment lies on a member if the angle between them is within ``angle_max_rad``, its distance to the
    axis within ``distance_max_m``, and its projection at most ``distance_max_m`` beyond the ends. The segment belongs
    to the member with most of its samples, if these are at least half of them; among equals, to the nearest.
    """
    start = axes[:, 0]
    length = np.linalg.norm(axes[:, 1] - start, axis=1)
    axis = (axes[:, 1] - start) / length[:, None]
    cosine = np.clip(np.abs(segments.direction @ axis.T), 0, 1)
    n, fraction = len(segments), np.linspace(0, 1, SAMPLES)
    member, angle, offset = np.full(n, -1, dtype=np.int64), np.full(n, np.nan), np.full(n, np.nan)
    matched_m, extent_m = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
    for s in range(n):
        candidates = np.flatnonzero(cosine[s] >= math.cos(angle_max_rad))
        if not len(candidates):
            continue
        sample = segments.start[s] + fraction[:, None] * (segments.end[s] - segments.start[s])
        offset_from_start = sample[:, None] - start[candidates]
        along = (offset_from_start * axis[candidates]).sum(axis=2)
        distance = np.linalg.norm(offset_from_start - along[..., None] * axis[candidates], axis=2)
        beyond = np.maximum(-along, along - length[candidates])
        on_member = (distance <= distance_max_m) & (beyond <= distance_max_m)
        k = int(np.lexsort((distance.mean(axis=0), -on_member.mean(axis=0)))[0])
        if on_member[:, k].mean() < SHARE_MIN:
            continue
        inside = along[on_member[:, k], k]
        member[s], angle[s] = candidates[k], np.arccos(cosine[s, candidates[k]])
        offset[s] = distance[on_member[:, k], k].mean()
        matched_m[s], extent_m[s] = (inside.min(), inside.max()), (along[:, k].min(), along[:, k].max())
    return Match(member, angle, offset, matched_m, extent_m)


def share(values: NDArray[np.bool_]) -> float:
    """Share of true ``values (N,)``; NaN if there are none."""
    return float(values.mean()) if len(values) else math.nan
