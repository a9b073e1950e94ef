"""Recall, precision and errors of segments against the members of a tower."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steelnb.metrics.matching import ANGLE_MAX_RAD, SHARE_MIN, match_members
from steelnb.simulation.truth import SCAN_RETURNS_MIN, SliceCounter, Visibility
from steelnb.types import Array, IntArray, Segments

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
    found: NDArray[np.bool_]
    right: NDArray[np.bool_]
    duplicates: int
    angle_rad: Array
    offset_m: Array


def score_segments(
    segments: Segments,
    axes: Array,
    observed: NDArray[np.bool_] | None = None,
    angle_max_rad: float = ANGLE_MAX_RAD,
    seen: NDArray[np.bool_] | None = None,
) -> SegmentScore:
    """Compare segments with the true member axes ``(M, 2, 3)``, both in the world frame, metres.

    A segment is right when at least half of it lies on one member (`match_members`); a member is found when right
    segments cover at least half of it. ``observed (M,)`` masks the members that count for recall
    (`Visibility.observed`), all by default. ``seen (M, 200)`` masks the parts of each member, from its first end to its
    second, that are to be covered: what is hidden need not be found. A right segment is a duplicate when at least
    half of it lies along parts of its member that longer right segments cover already.
    """
    match = match_members(segments, axes, angle_max_rad)
    right, length = match.right, np.linalg.norm(axes[:, 1] - axes[:, 0], axis=1)
    covered, grid, duplicates = np.zeros((len(axes), PARTS), dtype=bool), (np.arange(PARTS) + 0.5) / PARTS, 0
    for s in np.argsort(-segments.length, kind="stable"):
        if right[s]:
            m = match.member[s]
            low, high = match.near_m[s] / length[m]
            part = (grid >= low) & (grid <= high)
            duplicates += bool(part.any() and covered[m, part].mean() >= SHARE_MIN)
            covered[m] |= part
    if seen is None:
        found = covered.mean(axis=1) >= SHARE_MIN
    else:
        found = (covered & seen).sum(axis=1) >= np.maximum(SHARE_MIN * seen.sum(axis=1), 1)
    counted = np.ones(len(axes), dtype=bool) if observed is None else observed
    angle, offset = match.angle_rad[right], match.offset_m[right]
    return SegmentScore(
        _mean(found[counted]), _mean(right), _median(angle), _median(offset), found, right, duplicates, angle, offset
    )


def _mean(values: NDArray[np.bool_]) -> float:
    return float(values.mean()) if len(values) else math.nan


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else math.nan


@dataclass(frozen=True)
class SeenMembers:
    """The visible part of the members of a tower in a cloud.

    ``axes (M, 2, 3)``: parallel to the true axis through the middle of the surface seen, from the first to the last
    point; the true axis where nothing is seen. ``seen (M, 200)``: the parts of it near a point.
    """

    axes: Array
    seen: NDArray[np.bool_]
    visibility: Visibility

    def observed(self) -> NDArray[np.bool_]:
        """The members ``(M,)`` over which the recall in a single scan is taken: at least 30 returns over 0.3 m."""
        return self.visibility.observed(SCAN_RETURNS_MIN)


def seen_members(axes: Array, points: Array, member: IntArray, gap_m: float = 0.1) -> SeenMembers:
    """The visible part of members with axes ``(M, 2, 3)`` from the noise-free ``points (N, 3)`` on their surfaces.

    ``member (N,)``: the member of each point, negative for a plate. The axis of an angle section is its heel, which no
    sensor sees from outside: a method that is right finds a line in the middle of what is seen, up to half a flange
    beside it. A part is seen when it is no further than half of ``gap_m`` from a point, along the axis.
    """
    counter = SliceCounter(axes)
    points, member = points[member >= 0], member[member >= 0]
    counter.add(points, member)
    shown, seen = axes.copy(), np.zeros((len(axes), PARTS), dtype=bool)
    for m in np.unique(member):
        own = points[member == m]
        axis = (axes[m, 1] - axes[m, 0]) / np.linalg.norm(axes[m, 1] - axes[m, 0])
        middle = own.mean(axis=0)
        along = np.sort((own - middle) @ axis)
        length = along[-1] - along[0]
        if length <= 0:
            continue
        shown[m] = middle + along[[0, -1], None] * axis
        part = along[0] + (np.arange(PARTS) + 0.5) / PARTS * length
        after = np.clip(np.searchsorted(along, part), 1, len(along) - 1)
        seen[m] = np.minimum(part - along[after - 1], along[after] - part) <= gap_m / 2
    return SeenMembers(shown, seen, counter.visibility())
