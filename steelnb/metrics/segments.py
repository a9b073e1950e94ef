"""Comparison of segments with the members of a tower: association, recall, precision and errors."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steelnb.core.checks import checked_array, checked_number, checked_shape
from steelnb.core.errors import InputError
from steelnb.core.types import Array, IntArray, Segments
from steelnb.simulation.truth import SCAN_RETURNS_MIN, SLICE_M, SliceCounter, Visibility

ANGLE_MAX_RAD, DISTANCE_MAX_M, SHARE_MIN = math.radians(5), 0.10, 0.5
"""Maximum angle and distance of a segment from its member, and minimum share of its samples on it."""
SAMPLES = 41
"""Number of samples along a segment."""
PARTS = 200
"""Number of equal parts of a member in which its coverage is counted."""


@dataclass(frozen=True, eq=False)
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


def checked_axes(axes: Array) -> Array:
    """Axes of members ``(M, 2, 3)``, metres, of some length. Raises `InputError`."""
    axes = checked_array(axes, "axes", ("M", 2, 3))
    points = np.flatnonzero((axes[:, 0] == axes[:, 1]).all(axis=1))
    if len(points):
        raise InputError(f"axes[{points[0]}]: both ends at {axes[points[0], 0].tolist()}; expected two different ends")
    return axes


def match_members(
    segments: Segments, axes: Array, angle_max_rad: float = ANGLE_MAX_RAD, distance_max_m: float = DISTANCE_MAX_M
) -> Match:
    """Associate each segment with the member on whose axis ``(M, 2, 3)`` most of it lies; both in the world frame.

    A sample of a segment lies on a member if the angle between them is within ``angle_max_rad``, its distance to the
    axis within ``distance_max_m``, and its projection at most ``distance_max_m`` beyond the ends. The segment belongs
    to the member with most of its samples, if these are at least half of them; among equals, to the nearest.
    """
    start = checked_axes(axes)[:, 0]
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


@dataclass(frozen=True, eq=False)
class SegmentScore:
    """Recall over the observed members, precision over the segments, and errors of the right segments.

    ``recall`` and ``precision``: 0–1; ``right (S,)``: which segments lie on a member; ``duplicates``: number of these
    beside a longer one on the same member; ``angle_rad`` and ``offset_m``: angle and mean distance to the axis of each
    right segment.
    """

    recall: float
    precision: float
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
    parts of each member, from its first end to its second, which must be covered, default all. Raises `InputError`.
    """
    angle_max_rad = checked_number(angle_max_rad, "angle_max_rad", 0, math.pi / 2)
    axes = checked_axes(axes)
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
    seen = np.ones_like(covered) if seen is None else checked_shape(seen, "seen", covered.shape).astype(bool)
    observed = None if observed is None else checked_shape(observed, "observed", (len(axes),)).astype(bool)
    found = (covered & seen).sum(axis=1) >= np.maximum(SHARE_MIN * seen.sum(axis=1), 1)
    recall = share(found if observed is None else found[observed])
    return SegmentScore(recall, share(right), right, duplicates, match.angle_rad[right], match.offset_m[right])


def share(values: NDArray[np.bool_]) -> float:
    """Share of true ``values (N,)``; NaN if there are none."""
    return float(values.mean()) if len(values) else math.nan


@dataclass(frozen=True, eq=False)
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
    from it. A part is observed if it is within `SLICE_M` of a point, along the axis. Raises `InputError`.
    """
    axes, points = checked_axes(axes), checked_array(points, "points", ("N", 3))
    member, counter = checked_shape(member, "member", (len(points),)), SliceCounter(axes)
    if member.max(initial=-1) >= len(axes):
        raise InputError(f"member: {member.max()}; expected less than the number of axes, {len(axes)}")
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
        seen[m] = np.minimum(parts - along[after - 1], along[after] - parts) <= SLICE_M
    return SeenMembers(observed_axes, seen, counter.visibility())
