"""How well segments reproduce the members of a tower."""

import math
from dataclasses import dataclass

import numpy as np

from steelnb.datatypes import Array, Segments

PARTS = 200
"""Equal parts of a member, in which its coverage is counted."""


@dataclass(frozen=True)
class SegmentScore:
    """Recall over the members observed, precision over the segments, and errors of the matched pieces.

    ``recall``, ``precision`` 0–1; ``found (M,)`` the members found; ``right (S,)`` the segments that lie on a member;
    ``duplicates``, how many of those lie beside a longer one of the same member; ``angle_rad`` and ``offset_m``, the
    errors of each right segment, the second as its mean distance to the axis, with their medians: NaN without a match.
    """

    recall: float
    precision: float
    angle_median_rad: float
    offset_median_m: float
    found: np.ndarray
    right: np.ndarray
    duplicates: int
    angle_rad: Array
    offset_m: Array


def score_segments(
    segments: Segments,
    axes: Array,
    observed: np.ndarray | None = None,
    angle_max_rad: float = math.radians(5),
    offset_max_m: float = 0.10,
    share_min: float = 0.5,
    seen: np.ndarray | None = None,
) -> SegmentScore:
    """Compare segments with the true member axes ``(M, 2, 3)``, both in the world frame.

    A sample of a segment lies on a member when their angle is within ``angle_max_rad`` and its distance to the axis
    within ``offset_max_m``. A segment is right when at least ``share_min`` of its length lies on one member; a member
    is found when right segments cover at least ``share_min`` of it. ``observed (M,)`` masks the members that count for
    recall (those the sensor saw), all by default. ``seen (M, 200)`` masks the parts of each member, from its first end
    to its second, that are to be covered: what is hidden need not be found. A right segment is a duplicate when at
    least ``share_min`` of it lies along parts of its member that longer right segments cover already.
    """
    begin, finish = axes[:, 0], axes[:, 1]
    length = np.linalg.norm(finish - begin, axis=1)
    axis = (finish - begin) / length[:, None]
    cosine = np.clip(np.abs(segments.direction @ axis.T), 0, 1)
    share = np.linspace(0, 1, 41)
    best = np.full(len(segments), -1)
    offset = np.full(len(segments), np.nan)
    covered = np.zeros((len(axes), PARTS), dtype=bool)
    grid = (np.arange(PARTS) + 0.5) / PARTS
    duplicates = 0
    for s in np.argsort(-segments.length, kind="stable"):
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
        along_it = (grid >= low) & (grid <= high)
        duplicates += bool(along_it.any() and covered[member, along_it].mean() >= share_min)
        covered[member] |= along_it
    right = best >= 0
    if seen is None:
        found = covered.mean(axis=1) >= share_min
    else:
        found = (covered & seen).sum(axis=1) >= np.maximum(share_min * seen.sum(axis=1), 1)
    counted = np.ones(len(axes), dtype=bool) if observed is None else observed
    angle = np.arccos(cosine[right, best[right]])
    return SegmentScore(
        recall=float(found[counted].mean()) if counted.any() else math.nan,
        precision=float(right.mean()) if len(right) else math.nan,
        angle_median_rad=float(np.median(angle)) if right.any() else math.nan,
        offset_median_m=float(np.median(offset[right])) if right.any() else math.nan,
        found=found,
        right=right,
        duplicates=duplicates,
        angle_rad=angle,
        offset_m=offset[right],
    )


@dataclass(frozen=True)
class SeenMembers:
    """What a cloud can show of the members of a tower.

    ``axes (M, 2, 3)``: parallel to the true axis through the middle of the surface seen, from the first to the last
    point; the true axis where nothing is seen. ``seen (M, 200)``: the parts of it near a point. ``count (M,)`` points
    and ``length_m (M,)`` from first to last.
    """

    axes: Array
    seen: np.ndarray
    count: np.ndarray
    length_m: Array

    def observed(self, count_min: int = 30, length_min_m: float = 0.3) -> np.ndarray:
        """The members ``(M,)`` with enough points over enough length to be asked for."""
        return (self.count >= count_min) & (self.length_m >= length_min_m)


def seen_members(axes: Array, points: Array, member: np.ndarray, gap_m: float = 0.1) -> SeenMembers:
    """The visible part of members with axes ``(M, 2, 3)`` from the noise-free ``points (N, 3)`` on their surfaces.

    ``member (N,)`` says whose each point is. The axis of an angle section is its heel, which no sensor sees from
    outside: a method that is right finds a line in the middle of what is seen, up to half a flange beside it. A part is
    seen when it is no further than half of ``gap_m`` from a point, along the axis.
    """
    shown, seen = axes.copy(), np.zeros((len(axes), PARTS), dtype=bool)
    count, length = np.bincount(member, minlength=len(axes)), np.zeros(len(axes))
    for m in np.flatnonzero(count):
        own = points[member == m]
        axis = (axes[m, 1] - axes[m, 0]) / np.linalg.norm(axes[m, 1] - axes[m, 0])
        middle = own.mean(axis=0)
        along = np.sort((own - middle) @ axis)
        length[m] = along[-1] - along[0]
        if length[m] <= 0:
            continue
        shown[m] = middle + along[[0, -1], None] * axis
        part = along[0] + (np.arange(PARTS) + 0.5) / PARTS * length[m]
        after = np.clip(np.searchsorted(along, part), 1, len(along) - 1)
        seen[m] = np.minimum(part - along[after - 1], along[after] - part) <= gap_m / 2
    return SeenMembers(shown, seen, count, length)
