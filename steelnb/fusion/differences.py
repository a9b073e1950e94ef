"""Differences of two structures: bars and joints missing, extra and moved from the first to the second."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from steelnb.fusion.structure import Structure
from steelnb.settings import Tolerance
from steelnb.types import Array, IntArray, Segments

Mask = NDArray[np.bool_]
OVERLAP = 0.5
"""Two bars can be one and the same if they share this much of the longer one's length."""
MATCH_OFFSET_M, MATCH_ANGLE_DEG, MATCH_JOINT_M = 0.30, 10.0, 0.30
"""Beyond these a bar or a joint has not moved but is another one: missing in one structure and extra in the other."""


@dataclass(frozen=True)
class Deviation:
    """Distances and angles between M pairs of bars, whichever way round their ends are.

    ``offset_m (M,)`` from axis to axis, at the middle of the stretch that both cover; ``angle_deg (M,)`` between the
    axes; ``end_m (M,)`` from end to end, the larger of the two; ``overlap (M,)``, the stretch as a share of the longer.
    """

    offset_m: Array
    angle_deg: Array
    end_m: Array
    overlap: Array


@dataclass(frozen=True)
class Comparison:
    """Differences of structures A and B.

    ``bar (P, 2)``: pairs of the same bar in A and in B; ``deviation`` of each pair; ``bar_moved (P,)``: whether it is
    larger than the tolerance; ``bar_missing`` the bars of A without one in B, ``bar_extra`` the
    reverse. Likewise ``joint``, ``joint_distance_m``, ``joint_moved``, ``joint_missing``, ``joint_extra``.
    ``joint_retied (Q,)``: the joint ties other bars than before, those in only one of the structures left aside.
    """

    bar: IntArray
    deviation: Deviation
    bar_moved: Mask
    bar_missing: IntArray
    bar_extra: IntArray
    joint: IntArray
    joint_distance_m: Array
    joint_moved: Mask
    joint_retied: Mask
    joint_missing: IntArray
    joint_extra: IntArray

    @property
    def equal(self) -> bool:
        """Nothing is missing, extra, moved or tied otherwise. Widths, sightings and sigma are not compared."""
        bars = (self.bar_moved.any(), len(self.bar_missing), len(self.bar_extra))
        joints = (self.joint_moved.any(), self.joint_retied.any(), len(self.joint_missing), len(self.joint_extra))
        return not any((*bars, *joints))


def compare_structures(a: Structure, b: Structure, tolerance: Tolerance | None = None) -> Comparison:
    """Pair the bars and the joints of two structures in the same frame, and measure how the pairs differ.

    Each is paired at most once. Of all pairings the one is taken whose sum of likenesses is largest; the likeness of
    two bars falls from 1 for identical ones to 0 at the limits `MATCH_OFFSET_M`, `MATCH_ANGLE_DEG` or `OVERLAP`,
    whichever is nearest, so that an exact match is not given up for two poor ones (Kuhn's assignment problem, 1955).
    Memory and time grow with the product of the numbers of bars: a second for a thousand each.
    """
    limit = tolerance or Tolerance()
    bar = _paired(_bar_likeness(a.segments, b.segments))
    off = deviation(a.segments.take(bar[:, 0]), b.segments.take(bar[:, 1]))
    moved = (off.offset_m > limit.offset_m) | (off.angle_deg > limit.angle_deg) | (off.end_m > limit.end_m)
    apart = np.linalg.norm(a.joint[:, None] - b.joint[None], axis=2)
    joint = _paired(1 - apart / MATCH_JOINT_M)
    distance = apart[joint[:, 0], joint[:, 1]]
    return Comparison(
        bar, off, moved, _others(len(a), bar[:, 0]), _others(len(b), bar[:, 1]),
        joint, distance, distance > limit.joint_m, _retied(a, b, bar, joint),
        _others(len(a.joint), joint[:, 0]), _others(len(b.joint), joint[:, 1]),
    )  # fmt: skip


def deviation(a: Segments, b: Segments) -> Deviation:
    """Deviation of each bar of ``b`` from the one of ``a`` in the same row."""
    along, length = a.direction, a.length
    cosine = (along * b.direction).sum(axis=1)
    turned = (cosine < 0)[:, None]
    start, end = np.where(turned, b.end, b.start), np.where(turned, b.start, b.end)
    angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(along, b.direction), axis=1), np.abs(cosine)))
    first, last = (((p - a.start) * along).sum(axis=1) for p in (start, end))
    low, high = np.maximum(first, 0), np.minimum(last, length)
    middle = 0.5 * (low + high)
    share = (middle - first) / np.maximum(last - first, 1e-12)
    across = start + share[:, None] * (end - start) - (a.start + middle[:, None] * along)
    ends = (np.linalg.norm(p - q, axis=1) for p, q in ((start, a.start), (end, a.end)))
    overlap = np.maximum(high - low, 0) / np.maximum(np.maximum(length, b.length), 1e-12)
    return Deviation(np.linalg.norm(across, axis=1), angle, np.maximum(*ends), overlap)


def _bar_likeness(a: Segments, b: Segments) -> Array:
    """``(A, B)``: 1 for the same bar, 0 or less for another one."""
    likeness = np.zeros((len(a), len(b)))
    for i in range(len(a)):
        off = deviation(a.take(np.full(len(b), i)), b)
        shares = (off.offset_m / MATCH_OFFSET_M, off.angle_deg / MATCH_ANGLE_DEG)
        likeness[i] = 1 - np.maximum(np.maximum(*shares), (1 - off.overlap) / (1 - OVERLAP))
    return likeness


def _paired(likeness: Array) -> IntArray:
    """The pairs ``(P, 2)`` with the largest sum of likenesses, none of them 0 or less."""
    pair = np.stack(linear_sum_assignment(np.maximum(likeness, 0), maximize=True), axis=1)
    return pair[likeness[pair[:, 0], pair[:, 1]] > 0].astype(np.int64)


def _others(count: int, paired: IntArray) -> IntArray:
    return np.setdiff1d(np.arange(count), paired)


def _retied(a: Structure, b: Structure, bar: IntArray, joint: IntArray) -> Mask:
    """Which pairs of joints tie other bars in B than in A ``(Q,)``."""
    name_a = {int(i): k for k, (i, _) in enumerate(bar)}
    name_b = {int(j): k for k, (_, j) in enumerate(bar)}

    def tied(structure: Structure, which: int, name: dict[int, int]) -> set[int]:
        return {name[bar] for bar in structure.tie[structure.tie[:, 0] == which, 1].tolist() if bar in name}

    return np.array([tied(a, int(i), name_a) != tied(b, int(j), name_b) for i, j in joint], dtype=bool)
