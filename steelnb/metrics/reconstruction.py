"""Recall, precision and errors of a reconstructed structure against a tower: bars, joints and the graph of both.

The axis of a member is the line through the centroids of its sections, which is where the bar models of structural
engineering put a bar; the simulated joints lie on the heels, the outer corners of the angles. The true place of a joint
is the point nearest to the axes of the members that it ties.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steelnb.fusion.joints import nearest_point
from steelnb.fusion.structure import Structure
from steelnb.metrics.matching import DISTANCE_MAX_M, SHARE_MIN, match_members
from steelnb.simulation.tower import Tower
from steelnb.simulation.truth import SLICE_M, Visibility
from steelnb.types import Array, IntArray


@dataclass(frozen=True)
class Reference:
    """True bars and joints, and what was seen of them.

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


def reference(tower: Tower, visibility: Visibility) -> Reference:
    """The members and joints of a tower, and which of them a flight has observed.

    A joint is observed if two observed members (`Visibility.observed`) were seen within 10 cm of it.
    """
    shift = np.zeros((len(tower.members), 3))
    for m, member in enumerate(tower.members):
        if member.section == "round":
            continue
        flange, thickness = member.section_m
        # Of two rectangles, b by t and (b - t) by t: the same distance from either flange's outer face.
        apart = (flange**2 + flange * thickness - thickness**2) / (2 * (2 * flange - thickness))
        shift[m] = apart * (np.array(member.flange_a) + np.array(member.flange_b))
    axes = tower.axes + shift[:, None]
    along = tuple(member.joints for member in tower.members)
    observed = visibility.observed()
    slices = tuple(part > 0 for part in visibility.slices)
    ties = np.zeros(len(tower.joints), dtype=np.int64)
    joints = tower.joints.copy()
    tied: list[list[int]] = [[] for _ in tower.joints]
    for m, of_member in enumerate(along):
        for j in of_member:
            tied[j].append(m)
            t = float(np.linalg.norm(tower.joints[j] - tower.axes[m, 0]))
            ties[j] += observed[m] and _covered(slices[m], t - DISTANCE_MAX_M, t + DISTANCE_MAX_M) > 0
    for j, members in enumerate(tied):
        joints[j] = nearest_point(axes[members], tower.joints[j] + shift[members].mean(axis=0))
    return Reference(axes, joints, along, slices, observed, ties >= 2)


def score_structure(structure: Structure, truth: Reference) -> StructureScore:
    """Compare a structure with the truth, both in the world frame, metres.

    A bar is right when at least half of it lies on one member (`match_members`): the share of such bars is the
    precision. A member is found when they cover at least half of what was seen of it: recall is the share of the
    observed members. Further bars on one member are duplicates. Offset: mean distance of a bar to the axis. End error:
    along the axis, for each found member's longest bar, at the ends of which the last 10 cm were seen. Joints are
    paired one to one, nearest first, within 10 cm. An edge is right if it ties joints that follow each other on one
    member, joints not observed left out.
    """
    match = match_members(structure.segments, truth.axes)
    member, cover, right = match.member, match.whole_m, match.right
    found = np.zeros(len(truth.axes), dtype=bool)
    ends: list[float] = []
    for m in np.unique(member[right]):
        bars, seen = np.flatnonzero(member == m), truth.slices[m]
        covered = np.any([_between(len(seen), *cover[b]) for b in bars], axis=0)
        found[m] = seen.any() and covered[seen].mean() >= SHARE_MIN
        if found[m]:
            longest = bars[np.argmax(cover[bars, 1] - cover[bars, 0])]
            length = float(np.linalg.norm(truth.axes[m, 1] - truth.axes[m, 0]))
            if _covered(seen, 0.0, DISTANCE_MAX_M):
                ends.append(abs(cover[longest, 0]))
            if _covered(seen, length - DISTANCE_MAX_M, length):
                ends.append(abs(cover[longest, 1] - length))
    numbers = {
        "bars": float(len(structure)),
        "observed": float(truth.observed.sum()),
        "recall": _mean(found[truth.observed]),
        "precision": _mean(right),
        "duplicates": float(right.sum() - len(np.unique(member[right]))),
        **_spread("angle", "deg", np.degrees(match.angle_rad[right])),
        **_spread("offset", "m", match.offset_m[right]),
        **_spread("end", "m", np.array(ends)),
        **_score_graph(structure, truth),
    }
    return StructureScore(numbers, member, found, match.offset_m)


def _score_graph(structure: Structure, truth: Reference) -> dict[str, float]:
    pair, error = _pair_points(structure.joint, truth.joints)
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
    pieces = np.unique(np.sort(structure.pieces()[:, :2], axis=1), axis=0)
    edges = [(min(a, b), max(a, b)) for a, b in pair[pieces].tolist()]
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


def _pair_points(points: Array, others: Array) -> tuple[IntArray, Array]:
    """One-to-one pairs, nearest first: for each point the other or −1 ``(N,)``, and the distances of the pairs."""
    partner = np.full(len(points), -1, dtype=np.int64)
    if not len(points) or not len(others):
        return partner, np.zeros(0)
    near = cKDTree(points).sparse_distance_matrix(cKDTree(others), DISTANCE_MAX_M, output_type="ndarray")
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
    """Number of slices seen that reach into the interval from ``low`` to ``high``."""
    edge = np.arange(len(slices)) * SLICE_M
    return int(np.count_nonzero(slices & (edge + SLICE_M > low) & (edge < high)))


def _mean(values: NDArray[np.bool_]) -> float:
    return float(values.mean()) if len(values) else math.nan


def _spread(name: str, unit: str, values: Array) -> dict[str, float]:
    median, p90 = np.percentile(values, [50, 90]) if len(values) else (math.nan, math.nan)
    return {f"{name}_median_{unit}": float(median), f"{name}_p90_{unit}": float(p90)}
