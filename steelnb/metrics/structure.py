"""How well a reconstructed structure reproduces a tower: bars, joints and the graph of both.

The axis of a member is the line through the centroids of its sections, which is where the bar models of structural
engineering put a bar; `reference` also makes the truth of heels (the outer corner of the angle, on which the simulated
joints lie), so that both can be told. A joint's truth is then the point nearest to the axes of the members it ties.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steelnb.datatypes import Array, IntArray, Segments
from steelnb.fusion.joints import nearest_point
from steelnb.fusion.structure import Structure
from steelnb.simulation.tower import Tower
from steelnb.simulation.visibility import SLICE_M, Visibility

Axis = Literal["centroid", "heel"]
NEAR_M = 0.10


@dataclass(frozen=True)
class Reference:
    """What a structure is compared with.

    ``axes (M, 2, 3)`` metres; ``joints (J, 3)``; ``along``: for each member its joints, in order; ``slices``: for each
    member the slices of 5 cm from its start that were seen; ``observed (M,)``; ``joint_observed (J,)``.
    """

    axes: Array
    joints: Array
    along: tuple[tuple[int, ...], ...]
    slices: tuple[NDArray[np.bool_], ...]
    observed: NDArray[np.bool_]
    joint_observed: NDArray[np.bool_]


@dataclass(frozen=True)
class StructureScore:
    """``metrics``: a flat map of numbers, units in the names; NaN where nothing was matched. ``member (B,)``: the
    member that each bar lies on, or −1; ``found (M,)``; ``offset_m (B,)``, NaN for a bar on no member."""

    metrics: dict[str, float]
    member: IntArray
    found: NDArray[np.bool_]
    offset_m: Array


def reference(tower: Tower, visibility: Visibility, axis: Axis = "centroid") -> Reference:
    """The truth about a tower as far as a flight has seen it.

    A member is observed with at least 100 returns and 0.3 m seen; a joint, if two observed members were seen within
    10 cm of it.
    """
    shift = np.zeros((len(tower.members), 3))
    if axis == "centroid":
        for m, member in enumerate(tower.members):
            flange, thickness = member.section_m
            # Of two rectangles, b by t and (b - t) by t: the same distance from either flange's outer face.
            apart = (flange**2 + flange * thickness - thickness**2) / (2 * (2 * flange - thickness))
            shift[m] = apart * (np.array(member.flange_a) + np.array(member.flange_b))
    axes = tower.axes + shift[:, None]
    along = tuple(member.joints for member in tower.members)
    observed = visibility.seen()
    slices = tuple(part > 0 for part in visibility.slices)
    ties = np.zeros(len(tower.joints), dtype=np.int64)
    joints = tower.joints.copy()
    tied: list[list[int]] = [[] for _ in tower.joints]
    for m, of_member in enumerate(along):
        for j in of_member:
            tied[j].append(m)
            t = float(np.linalg.norm(tower.joints[j] - tower.axes[m, 0]))
            ties[j] += observed[m] and _covered(slices[m], t - NEAR_M, t + NEAR_M) > 0
    if axis == "centroid":
        for j, members in enumerate(tied):
            joints[j] = nearest_point(axes[members], tower.joints[j] + shift[members].mean(axis=0))
    return Reference(axes, joints, along, slices, observed, ties >= 2)


def score_structure(
    structure: Structure, truth: Reference, angle_max_rad: float = math.radians(5), distance_max_m: float = NEAR_M
) -> StructureScore:
    """Compare a structure with the truth, both in the world frame.

    A bar lies on a member when their angle is within ``angle_max_rad`` and at least half of the bar within
    ``distance_max_m`` of it: the share of such bars is the precision. A member is found when they cover at least half
    of what was seen of it: recall is the share of the observed members. Further bars on one member are duplicates.
    Offset: mean distance of a bar to the axis. End error: along the axis, for each found member's longest bar, at the
    ends of which the last 10 cm were seen. Joints are paired one to one, nearest first, within ``distance_max_m``.
    An edge is right if it ties joints that follow each other on one member, joints not observed left out.
    """
    member, offset, angle, cover = _bars_on_members(structure.segments, truth, angle_max_rad, distance_max_m)
    found = np.zeros(len(truth.axes), dtype=bool)
    ends: list[float] = []
    for m in np.unique(member[member >= 0]):
        bars = np.flatnonzero(member == m)
        covered = np.zeros_like(truth.slices[m])
        for b in bars:
            covered |= _between(len(covered), cover[b, 0], cover[b, 1])
        seen = truth.slices[m]
        found[m] = seen.any() and covered[seen].mean() >= 0.5
        if found[m]:
            longest = bars[np.argmax(cover[bars, 1] - cover[bars, 0])]
            length = float(np.linalg.norm(truth.axes[m, 1] - truth.axes[m, 0]))
            if _covered(seen, 0.0, NEAR_M):
                ends.append(abs(cover[longest, 0]))
            if _covered(seen, length - NEAR_M, length):
                ends.append(abs(cover[longest, 1] - length))
    right = member >= 0
    numbers = {
        "bars": float(len(structure)),
        "observed": float(truth.observed.sum()),
        "recall": _mean(found[truth.observed]),
        "precision": _mean(right),
        "duplicates": float(right.sum() - len(np.unique(member[right]))),
        **_spread("angle", "deg", np.degrees(angle[right])),
        **_spread("offset", "m", offset[right]),
        **_spread("end", "m", np.array(ends)),
        **_score_graph(structure, truth, distance_max_m),
    }
    return StructureScore(numbers, member, found, offset)


def _bars_on_members(
    bars: Segments, truth: Reference, angle_max_rad: float, distance_max_m: float
) -> tuple[IntArray, Array, Array, Array]:
    """For each bar: the member it lies on or −1, offset and angle (radians), and the interval that it covers there."""
    begin = truth.axes[:, 0]
    length = np.linalg.norm(truth.axes[:, 1] - begin, axis=1)
    axis = (truth.axes[:, 1] - begin) / length[:, None]
    member = np.full(len(bars), -1, dtype=np.int64)
    offset, angle, cover = np.full(len(bars), np.nan), np.full(len(bars), np.nan), np.full((len(bars), 2), np.nan)
    cosine = np.clip(np.abs(bars.direction @ axis.T), 0, 1)
    share = np.linspace(0, 1, 41)
    for b in range(len(bars)):
        candidates = np.flatnonzero(cosine[b] >= math.cos(angle_max_rad))
        if not len(candidates):
            continue
        sample = bars.start[b] + share[:, None] * (bars.end[b] - bars.start[b])
        apart = sample[:, None] - begin[candidates]
        along = (apart * axis[candidates]).sum(axis=2)
        across = np.linalg.norm(apart - along[..., None] * axis[candidates], axis=2)
        beyond = np.maximum(np.maximum(-along, along - length[candidates]), 0)
        near = np.hypot(across, beyond) <= distance_max_m
        # Equal shares happen where members run side by side; the nearer one is meant.
        k = int(np.lexsort((across.mean(axis=0), -near.mean(axis=0)))[0])
        if near[:, k].mean() < 0.5:
            continue
        member[b], angle[b] = candidates[k], np.arccos(cosine[b, candidates[k]])
        offset[b] = across[near[:, k], k].mean()
        cover[b] = along[:, k].min(), along[:, k].max()
    return member, offset, angle, cover


def _score_graph(structure: Structure, truth: Reference, distance_max_m: float) -> dict[str, float]:
    pair, error = _pair_points(structure.joint, truth.joints, distance_max_m)
    matched = np.zeros(len(truth.joints), dtype=bool)
    matched[pair[pair >= 0]] = True
    wanted: set[tuple[int, int]] = set()
    allowed: set[tuple[int, int]] = set()
    for m, joints in enumerate(truth.along):
        seen = [j for j in joints if truth.joint_observed[j]]
        size = len(truth.slices[m])
        for a, b in itertools.pairwise(seen) if truth.observed[m] else ():
            low, high = sorted(float(np.linalg.norm(truth.joints[j] - truth.axes[m, 0])) for j in (a, b))
            inside = truth.slices[m][_between(size, low, high)]
            if inside.any() and inside.mean() >= 0.5:
                wanted.add((min(a, b), max(a, b)))
        for i, j in itertools.combinations(range(len(joints)), 2):
            if not any(truth.joint_observed[between] for between in joints[i + 1 : j]):
                allowed.add((min(joints[i], joints[j]), max(joints[i], joints[j])))
    edges = [tuple(sorted((int(pair[a]), int(pair[b])))) for a, b in structure.graph().edges]
    right = np.array([edge in allowed for edge in edges], dtype=bool)
    return {
        "joints": float(len(structure.joint)),
        "joints_observed": float(truth.joint_observed.sum()),
        "joint_recall": _mean(matched[truth.joint_observed]),
        "joint_precision": _mean(pair >= 0),
        **_spread("joint_error", "m", error),
        "edges": float(len(edges)),
        "edge_recall": _mean(np.array([edge in set(edges) for edge in sorted(wanted)], dtype=bool)),
        "edge_precision": _mean(right),
    }


def _pair_points(points: Array, others: Array, distance_max_m: float) -> tuple[IntArray, Array]:
    """One-to-one pairs, nearest first: for each point the other or −1 ``(N,)``, and the distances of the pairs."""
    partner = np.full(len(points), -1, dtype=np.int64)
    if not len(points) or not len(others):
        return partner, np.zeros(0)
    near = cKDTree(points).sparse_distance_matrix(cKDTree(others), distance_max_m, output_type="ndarray")
    taken, error = np.zeros(len(others), dtype=bool), []
    for i, j, distance in near[np.argsort(near["v"], kind="stable")].tolist():
        if partner[i] < 0 and not taken[j]:
            partner[i], taken[j] = j, True
            error.append(distance)
    return partner, np.array(error)


def _between(size: int, low: float, high: float) -> NDArray[np.bool_]:
    """The slices whose middle lies between two positions along a member."""
    middle = (np.arange(size) + 0.5) * SLICE_M
    return (middle >= low) & (middle <= high)


def _covered(slices: NDArray[np.bool_], low: float, high: float) -> int:
    """How many slices seen reach into the interval from ``low`` to ``high``."""
    edge = np.arange(len(slices)) * SLICE_M
    return int(np.count_nonzero(slices & (edge + SLICE_M > low) & (edge < high)))


def _mean(values: NDArray[np.bool_]) -> float:
    return float(values.mean()) if len(values) else math.nan


def _spread(name: str, unit: str, values: Array) -> dict[str, float]:
    median, p90 = np.percentile(values, [50, 90]) if len(values) else (math.nan, math.nan)
    return {f"{name}_median_{unit}": float(median), f"{name}_p90_{unit}": float(p90)}
