"""Recall, precision and errors of a reconstructed structure against the tower: bars, joints and their graph.

The axis of a member is the line through the centroids of its sections, as in structural engineering. The simulated
joints are on the heels, the outer corners of the angles. So the true position of a joint is the point nearest to the
axes of its members.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steelnb.core.types import Array, IntArray, Segments
from steelnb.fusion.joints import nearest_point
from steelnb.fusion.sections.shapes import centroid_m
from steelnb.fusion.structure import Structure
from steelnb.metrics.segments import DISTANCE_MAX_M, SHARE_MIN, match_members, share
from steelnb.settings import TofSettings
from steelnb.simulation.tower import Tower
from steelnb.simulation.truth import SLICE_M, Visibility

STRAIGHT_SINE = math.sin(math.radians(1.5))
"""Maximum sine of the angle between members that are one bar; beyond, `steelnb.fusion.joints` finds a bend."""


@dataclass(frozen=True)
class Reference:
    """True bars and joints, and which of them were observed.

    ``axes (M, 2, 3)`` and ``joints (J, 3)``, metres; ``along``: the joints of each member in order; ``slices``: which
    slices of 5 cm from the start of each member were observed; ``observed (M,)``; ``joint_observed (J,)``.
    """

    axes: Array
    joints: Array
    along: tuple[tuple[int, ...], ...]
    slices: tuple[NDArray[np.bool_], ...]
    observed: NDArray[np.bool_]
    joint_observed: NDArray[np.bool_]

    def joined(self) -> "Reference":
        """The same with members that continue each other in a straight line as one, as a cloud shows them. It is
        observed if one of them is."""
        members = list(zip(self.axes, self.along, self.slices, self.observed.tolist(), strict=True))
        joint = 0
        while joint < len(self.joints):
            ends = [k for k, (_, along, _, _) in enumerate(members) if joint in (along[0], along[-1])]
            for a, b in itertools.combinations(ends, 2):
                one = members[a] if members[a][1][-1] == joint else _reversed(members[a])
                other = members[b] if members[b][1][0] == joint else _reversed(members[b])
                if _in_line(one[0], other[0]):
                    axis, along = np.stack([one[0][0], other[0][1]]), one[1] + other[1][1:]
                    members[a] = axis, along, np.concatenate([one[2], other[2]]), one[3] or other[3]
                    del members[b]
                    break
            else:
                joint += 1
        axes, alongs, slices, observed = zip(*members, strict=True)
        return Reference(np.array(axes), self.joints, alongs, slices, np.array(observed), self.joint_observed)


@dataclass(frozen=True)
class StructureScore:
    """``metrics``: numbers with units in their names, NaN without a match; ``member (B,)`` of each bar, or −1."""

    metrics: dict[str, float]
    member: IntArray


def reference(tower: Tower, visibility: Visibility) -> Reference:
    """Members and joints of a tower, and which of them a flight has observed.

    A joint is observed if two observed members (`Visibility.observed`) have returns within 10 cm of it.
    """
    shift = np.zeros((len(tower.members), 3))
    for m, member in enumerate(tower.members):
        if member.section == "round":
            continue
        shift[m] = centroid_m(*member.section_m) * (np.array(member.flange_a) + np.array(member.flange_b))
    axes = tower.axes + shift[:, None]
    along = tuple(member.joints for member in tower.members)
    observed = visibility.observed()
    slices = tuple(part > 0 for part in visibility.slices)
    joints, joint_observed = np.zeros_like(tower.joints), np.zeros(len(tower.joints), dtype=bool)
    for j, heel in enumerate(tower.joints):
        members = [m for m, joints_of_member in enumerate(along) if j in joints_of_member]
        joints[j] = nearest_point(axes[members], heel + shift[members].mean(axis=0))
        seen = 0
        for m in members:
            t = float(np.linalg.norm(heel - tower.axes[m, 0]))
            seen += observed[m] and _observed_between(slices[m], t - DISTANCE_MAX_M, t + DISTANCE_MAX_M)
        joint_observed[j] = seen >= 2
    return Reference(axes, joints, along, slices, observed, joint_observed)


def score_structure(structure: Structure, truth: Reference) -> StructureScore:
    """Compare a structure with the truth, both in the world frame, metres.

    A bar is right if at least half of it lies on one member (`match_members`); precision is the share of right bars. A
    member is found if right bars cover at least half of its observed slices; recall is the share of found members among
    the observed ones. Additional bars on a member are duplicates. The offset is the mean distance of a bar to the axis.
    The end error is that of the longest bar of each found member along the axis, at ends whose last 10 cm were
    observed.

    Joints are paired one to one within 10 cm, nearest first. An edge is right if it connects consecutive joints of a
    member, not counting joints that were not observed.
    """
    match = match_members(structure.segments, truth.axes)
    member, extent, right = match.member, match.extent_m, match.right
    found = np.zeros(len(truth.axes), dtype=bool)
    ends: list[float] = []
    for m in np.unique(member[right]):
        bars, observed = np.flatnonzero(member == m), truth.slices[m]
        covered = np.any([_slices_between(len(observed), *extent[b]) for b in bars], axis=0)
        found[m] = observed.any() and covered[observed].mean() >= SHARE_MIN
        if found[m]:
            longest = bars[np.argmax(extent[bars, 1] - extent[bars, 0])]
            length = float(np.linalg.norm(truth.axes[m, 1] - truth.axes[m, 0]))
            if _observed_between(observed, 0.0, DISTANCE_MAX_M):
                ends.append(abs(extent[longest, 0]))
            if _observed_between(observed, length - DISTANCE_MAX_M, length):
                ends.append(abs(extent[longest, 1] - length))
    numbers = {
        "bars": float(len(structure)),
        "observed": float(truth.observed.sum()),
        "recall": share(found[truth.observed]),
        "precision": share(right),
        "duplicates": float(right.sum() - len(np.unique(member[right]))),
        **_spread("angle", "deg", np.degrees(match.angle_rad[right])),
        **_spread("offset", "m", match.offset_m[right]),
        **_spread("end", "m", np.array(ends)),
        **_score_graph(structure, truth),
    }
    return StructureScore(numbers, member)


def toward_sensor_m(bars: Segments, member: IntArray, axes: Array, T_world_sensor: Array, tof: TofSettings) -> Array:
    """Distance ``(B,)`` by which the middle of each bar lies nearer to the sensor than its member's axis, NaN for none.

    ``member (B,)`` is the member of each bar, or −1, ``axes (M, 2, 3)`` are the true axes, and ``T_world_sensor (K, 4,
    4)`` the true poses. The distance is measured across the axis, along the mean viewing direction from the poses that
    see the bar. Near views weigh more (1/distance²), as their points do.
    """
    inside = math.cos(0.5 * max(tof.fov_horizontal_rad, tof.fov_vertical_rad))
    toward = np.full(len(bars), np.nan)
    for b in np.flatnonzero(member >= 0):
        begin, end = axes[member[b]]
        axis = (end - begin) / np.linalg.norm(end - begin)
        sight = bars.middle[b] - T_world_sensor[:, :3, 3]
        distance = np.linalg.norm(sight, axis=1)
        ahead = (sight * T_world_sensor[:, :3, 0]).sum(axis=1) > inside * distance
        seen = ahead & (distance < tof.range_max_m)
        view = (sight[seen] / distance[seen, None] ** 3).sum(axis=0)
        view -= (view @ axis) * axis
        size = np.linalg.norm(view)
        if size > 0:
            toward[b] = -(bars.middle[b] - begin) @ view / size
    return toward


def _score_graph(structure: Structure, truth: Reference) -> dict[str, float]:
    pair, error = _pair_points(structure.joint, truth.joints)
    matched = np.zeros(len(truth.joints), dtype=bool)
    matched[pair[pair >= 0]] = True
    expected, allowed = set(), set()
    for m, joints in enumerate(truth.along):
        observed = [j for j in joints if truth.joint_observed[j]]
        for a, b in itertools.pairwise(observed) if truth.observed[m] else ():
            low, high = sorted(float(np.linalg.norm(truth.joints[j] - truth.axes[m, 0])) for j in (a, b))
            inside = truth.slices[m][_slices_between(len(truth.slices[m]), low, high)]
            if inside.any() and inside.mean() >= 0.5:
                expected.add(frozenset((a, b)))
        for i, j in itertools.combinations(range(len(joints)), 2):
            if not any(truth.joint_observed[between] for between in joints[i + 1 : j]):
                allowed.add(frozenset((joints[i], joints[j])))
    pieces = np.unique(np.sort(structure.pieces()[:, :2], axis=1), axis=0)
    edges = [frozenset(edge) for edge in pair[pieces].tolist()]
    return {
        "joints": float(len(structure.joint)),
        "joints_observed": float(truth.joint_observed.sum()),
        "joint_recall": share(matched[truth.joint_observed]),
        "joint_precision": share(pair >= 0),
        **_spread("joint_error", "m", error),
        "edges": float(len(edges)),
        "edge_recall": share(np.array([edge in edges for edge in expected], dtype=bool)),
        "edge_precision": share(np.array([edge in allowed for edge in edges], dtype=bool)),
    }


def _pair_points(points: Array, others: Array) -> tuple[IntArray, Array]:
    """Pair points one to one within 10 cm, nearest first: the partner ``(N,)`` of each, or −1, and their distances."""
    candidates = cKDTree(points).sparse_distance_matrix(cKDTree(others), DISTANCE_MAX_M, output_type="ndarray")
    partner, is_paired, error = np.full(len(points), -1), np.zeros(len(others), dtype=bool), []
    for i, j, distance in candidates[np.argsort(candidates["v"], kind="stable")].tolist():
        if partner[i] < 0 and not is_paired[j]:
            partner[i], is_paired[j] = j, True
            error.append(distance)
    return partner, np.array(error)


_Member = tuple[Array, tuple[int, ...], NDArray[np.bool_], bool]
"""Axis, joints, slices, and whether it was observed."""


def _reversed(member: _Member) -> _Member:
    axis, along, slices, observed = member
    return axis[::-1], along[::-1], slices[::-1], observed


def _in_line(axis: Array, next_axis: Array) -> bool:
    """Whether a member runs on in the direction of another one that ends where it begins."""
    one, other = axis[1] - axis[0], next_axis[1] - next_axis[0]
    sine = np.linalg.norm(np.cross(one, other)) / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-12)
    return bool(one @ other > 0 and sine < STRAIGHT_SINE and np.linalg.norm(next_axis[0] - axis[1]) < DISTANCE_MAX_M)


def _slices_between(slice_count: int, low: float, high: float) -> NDArray[np.bool_]:
    """Mask of the slices whose middle is between two positions along a member."""
    middle = (np.arange(slice_count) + 0.5) * SLICE_M
    return (middle >= low) & (middle <= high)


def _observed_between(slices: NDArray[np.bool_], low: float, high: float) -> bool:
    """Whether an observed slice overlaps the interval from ``low`` to ``high``."""
    edge = np.arange(len(slices)) * SLICE_M
    return bool((slices & (edge + SLICE_M > low) & (edge < high)).any())


def _spread(name: str, unit: str, values: Array) -> dict[str, float]:
    median, p90 = np.percentile(values, [50, 90]) if len(values) else (math.nan, math.nan)
    return {f"{name}_median_{unit}": float(median), f"{name}_p90_{unit}": float(p90)}
