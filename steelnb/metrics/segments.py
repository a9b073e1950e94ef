"""How well segments reproduce the members of a tower."""

import math
from dataclasses import dataclass

import numpy as np

from steelnb.datatypes import Array, Segments


@dataclass(frozen=True)
class SegmentScore:
    """Recall over the members observed, precision over the segments, and errors of the matched pieces.

    ``recall``, ``precision`` 0–1; ``angle_median_rad``; ``offset_median_m``, from the middle of a segment to the axis;
    ``found (M,)`` the members found; ``right (S,)`` the segments that lie on a member. Medians are NaN without a match.
    """

    recall: float
    precision: float
    angle_median_rad: float
    offset_median_m: float
    found: np.ndarray
    right: np.ndarray


def score_segments(
    segments: Segments,
    axes: Array,
    observed: np.ndarray | None = None,
    angle_max_rad: float = math.radians(5),
    offset_max_m: float = 0.10,
    share_min: float = 0.5,
) -> SegmentScore:
    """Compare segments with the true member axes ``(M, 2, 3)``, both in the world frame.

    A sample of a segment lies on a member when their angle is within ``angle_max_rad`` and its distance to the axis
    within ``offset_max_m``. A segment is right when at least ``share_min`` of its length lies on one member; a member
    is found when right segments cover at least ``share_min`` of it. ``observed (M,)`` masks the members that count for
    recall (those the sensor saw), all by default.
    """
    begin, finish = axes[:, 0], axes[:, 1]
    length = np.linalg.norm(finish - begin, axis=1)
    axis = (finish - begin) / length[:, None]
    cosine = np.clip(np.abs(segments.direction @ axis.T), 0, 1)
    share = np.linspace(0, 1, 41)
    best = np.full(len(segments), -1)
    offset = np.full(len(segments), np.nan)
    covered = np.zeros((len(axes), 200), dtype=bool)
    for s in range(len(segments)):
        candidates = np.flatnonzero(cosine[s] >= math.cos(angle_max_rad))
        if not len(candidates):
            continue
        sample = segments.start[s] + share[:, None] * (segments.end[s] - segments.start[s])
        apart = sample[:, None] - begin[candidates]
        along = (apart * axis[candidates]).sum(axis=2)
        distance = np.linalg.norm(apart - along[..., None] * axis[candidates], axis=2)
        near = (distance <= offset_max_m) & (along >= -offset_max_m) & (along <= length[candidates] + offset_max_m)
        on = near.mean(axis=0)
        # Equal shares happen where members run side by side; the nearer one is meant.
        k = int(np.lexsort((distance.mean(axis=0), -on))[0])
        if on[k] < share_min:
            continue
        member = int(candidates[k])
        best[s], offset[s] = member, distance[near[:, k], k].mean()
        low, high = along[near[:, k], k].min() / length[member], along[near[:, k], k].max() / length[member]
        grid = (np.arange(covered.shape[1]) + 0.5) / covered.shape[1]
        covered[member] |= (grid >= low) & (grid <= high)
    right = best >= 0
    found = covered.mean(axis=1) >= share_min
    counted = np.ones(len(axes), dtype=bool) if observed is None else observed
    angle = np.arccos(cosine[right, best[right]])
    return SegmentScore(
        recall=float(found[counted].mean()) if counted.any() else math.nan,
        precision=float(right.mean()) if len(right) else math.nan,
        angle_median_rad=float(np.median(angle)) if right.any() else math.nan,
        offset_median_m=float(np.median(offset[right])) if right.any() else math.nan,
        found=found,
        right=right,
    )
