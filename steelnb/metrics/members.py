"""Recall, precision and errors of segments by the members of a tower."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steelnb.metrics.matching import ANGLE_MAX_RAD, SHARE_MIN, match_members, share
from steelnb.simulation.truth import SCAN_RETURNS_MIN, SliceCounter, Visibility
from steelnb.types import Array, IntArray, Segments

PARTS = 200
"""Number of equal parts of a member in which its coverage is counted."""
GAP_MAX_M = 0.1
"""Maximum gap between points along an observed part of a member."""


@dataclass(frozen=True)
class SegmentScore:
    """Recall over the observed members, precision over the segments, and errors of the right segments.

    ``recall`` and ``precision``: 0–1; ``found (M,)``: which members are found; ``right (S,)``: which segments lie on a
    member; ``duplicates``: number of these beside a longer one on the same member; ``angle_rad`` and ``offset_m``:
    angle and mean distance to the axis of each right segment, with their medians, NaN if there is none.
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
    """Compare segments with the true axes of members ``(M, 2, 3)``, both in the world frame, metres.

    A segment is right if at least half of it lies on one member (`match_members`). A member is found if right segments
    cover at least half of it. A right segment is a duplicate if longer ones cover at least half of its interval.

    ``observed (M,)``: members that count for recall (`Visibility.observed`), default all. ``seen (M, 200)``: observed
    parts of each member, from its first end to its second, which must be covered, default all.
    """
    match = match_members(segments, axes, angle_max_rad)
    right, length = match.right, np.linalg.norm(axes[:, 1] - axes[:, 0], axis=1)
    covered, grid, duplicates = np.zeros((len(axes), PARTS), dtype=bool), (np.arange(PARTS) + 0.5) / PARTS, 0
    for s in np.argsort(-segments.length, kind="stable"):
        if right[s]:
            m = match.member[s]
            low, high = match.matched_m[s] / length[m]
            parts = (grid >= low) & (grid <= high)
            duplicates += bool(parts.any() and covered[m, parts].mean() >= SHARE_MIN)
            covered[m] |= parts
    if seen is None:
        found = covered.mean(axis=1) >= SHARE_MIN
    else:
        found = (covered & seen).sum(axis=1) >= np.maximum(SHARE_MIN * seen.sum(axis=1), 1)
    counted = np.ones(len(axes), dtype=bool) if observed is None else observed
    angle, offset = match.angle_rad[right], match.offset_m[right]
    return SegmentScore(
        share(found[counted]), share(right), _median(angle), _median(offset), found, right, duplicates, angle, offset
    )


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else math.nan


@dataclass(frozen=True)
class SeenMembers:
    """The observed parts of the members of a tower in a cloud.

    ``axes (M, 2, 3)``: parallel to the true axis, through the middle of the observed surface, from the first to the
    last point; the true axis if nothing is observed. ``seen (M, 200)``: the parts of it near a point.
    """

    axes: Array
    seen: NDArray[np.bool_]
    visibility: Visibility

    def observed(self) -> NDArray[np.bool_]:
        """The members ``(M,)`` that count for recall in a single scan: at least 30 returns over 0.3 m."""
        return self.visibility.observed(SCAN_RETURNS_MIN)


def seen_members(axes: Array, points: Array, member: IntArray) -> SeenMembers:
    """The observed parts of members with ``axes (M, 2, 3)``, from noise-free ``points (N, 3)`` on their surfaces.

    ``member (N,)``: the member of each point, negative for a plate. The axis of an angle section is its heel, which is
    not visible from outside. A correct method finds a line in the middle of the visible surface, up to half a flange
    from it. A part is observed if it is within half of `GAP_MAX_M` of a point, along the axis.
    """
    counter = SliceCounter(axes)
    points, member = points[member >= 0], member[member >= 0]
    counter.add(points, member)
    observed_axes, seen = axes.copy(), np.zeros((len(axes), PARTS), dtype=bool)
    for m in np.unique(member):
        points_on_member = points[member == m]
        axis = (axes[m, 1] - axes[m, 0]) / np.linalg.norm(axes[m, 1] - axes[m, 0])
        middle = points_on_member.mean(axis=0)
        along = np.sort((points_on_member - middle) @ axis)
        length = along[-1] - along[0]
        if length <= 0:
            continue
        observed_axes[m] = middle + along[[0, -1], None] * axis
        parts = along[0] + (np.arange(PARTS) + 0.5) / PARTS * length
        after = np.clip(np.searchsorted(along, parts), 1, len(along) - 1)
        seen[m] = np.minimum(parts - along[after - 1], along[after] - parts) <= GAP_MAX_M / 2
    return SeenMembers(observed_axes, seen, counter.visibility())
