"""Joints: points where the axes of bars come closest, and bars extended to them."""

import itertools
import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from steelnb.core.geometry import connected
from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray, Segments

BEND_MIN, BEND_MAX = math.cos(math.radians(1.5)), math.cos(math.radians(10))
"""Cosines of the angles between bars that meet at a bend. Below 1.5° its position is undetermined."""
SLACK_M, REACH_M, LEAD_MAX_M, SAME_M, BEND_M, BEND_GAP_M = 0.02, 0.2, 0.8, 0.15, 1.2, 0.1
"""See `find_joints` and `trim_bends`."""
TILT_DETERMINED_RAD = 0.02
"""A bar whose direction has a larger standard deviation finally runs from joint to joint."""
ANCHOR = 0.01
"""Weight of an initial position relative to a line's: almost parallel lines do not determine a nearest point."""


def nearest_point(axes: Array, initial: Array) -> Array:
    """The point ``(3,)`` with the least sum of squared distances to lines ``(K, 2, 3)``, held to ``initial (3,)`` with
    the weight `ANCHOR`."""
    direction = axes[:, 1] - axes[:, 0]
    direction = direction / np.linalg.norm(direction, axis=1)[:, None]
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    matrix = across.sum(axis=0) + ANCHOR * np.eye(3)
    return np.asarray(np.linalg.solve(matrix, (across @ axes[:, 0, :, None]).sum(axis=0)[:, 0] + ANCHOR * initial))


def find_joints(bars: Segments, width_m: Array) -> tuple[Array, IntArray, Segments]:
    """Joints ``(J, 3)``, ties ``(T, 2)`` of (joint, bar), and the bars with their ends moved to the joints; metres.

    Two bars meet if their axes come closer than half the sum of their widths ``(B,)`` plus `SLACK_M`. Points within
    `REACH_M` of another bar are often assigned to that bar. So either bar may be extended by `REACH_M` over the sine of
    the angle between them, at most by `LEAD_MAX_M`, but only to the first bar that it meets. Bars that continue each
    other at a small angle meet at the bend, up to `BEND_M` from their ends.

    Meetings on one bar that are less than `SAME_M` apart are one joint: the point nearest to all axes that it ties.
    Bars that do not reach this point are not tied. Ends near the first and last joint of a bar move there.
    """
    pair, at, lead = _meetings(bars.start, bars.direction, bars.length, width_m, SLACK_M, REACH_M)
    is_first = _is_first(pair, at, bars.length)
    pair, at, lead = pair[is_first], at[is_first], lead[is_first]
    point = (bars.start[pair] + at[:, :, None] * bars.direction[pair]).sum(axis=1) * 0.5
    group = _groups(pair, at, point)
    joint, ties, leads = np.zeros((group.max(initial=-1) + 1, 3)), [], []
    for j in range(len(joint)):
        inside = group == j
        tied = np.unique(pair[inside])
        axes = np.stack([bars.start[tied], bars.end[tied]], axis=1)
        joint[j] = nearest_point(axes, point[inside].mean(axis=0))
        ties += [(j, bar) for bar in tied.tolist()]
        leads += [lead[inside][(pair[inside] == bar).any(axis=1)].max() for bar in tied]
    tie, lead = np.array(ties, dtype=np.int64).reshape(-1, 2), np.array(leads)
    # The nearest point of bars that meet at an acute angle may lie beyond the reach of their extensions.
    along = ((joint[tie[:, 0]] - bars.start[tie[:, 1]]) * bars.direction[tie[:, 1]]).sum(axis=1)
    reached = (along >= -lead - SAME_M) & (along <= bars.length[tie[:, 1]] + lead + SAME_M)
    reached &= np.bincount(tie[reached, 0], minlength=len(joint))[tie[:, 0]] >= 2
    remaining, index = np.unique(tie[reached, 0], return_inverse=True)
    tie, lead = np.column_stack([index, tie[reached, 1]]), lead[reached]
    return joint[remaining], tie, _extended(bars, joint[remaining], tie, lead)


def between_joints(bars: Segments, joint: Array, tie: IntArray, weak: NDArray[np.bool_]) -> Segments:
    """The bars, with the axes of ``weak (B,)`` ones through the first and last of the joints ``(J, 3)`` that tie them
    (``tie (T, 2)``: joint, bar).

    The points of a short strut determine its direction to a few degrees only, while its joints lie on the axes of
    longer bars. A bar keeps its axis if its joints do not lie within `SAME_M` of both its ends.
    """
    start, end, length, direction = bars.start.copy(), bars.end.copy(), bars.length, bars.direction
    for bar in np.flatnonzero(weak):
        tied = joint[tie[tie[:, 1] == bar, 0]]
        along = (tied - bars.start[bar]) @ direction[bar]
        if len(tied) >= 2 and along.min() <= SAME_M and along.max() >= length[bar] - SAME_M:
            start[bar], end[bar] = tied[along.argmin()], tied[along.argmax()]
    return replace(bars, start=start, end=end)


def trim_bends(bars: Segments) -> Segments:
    """The bars, cut at bends. There, two bars that continue each other at a small angle have grown into each other:
    their axes come closer than `BEND_GAP_M`, at most `BEND_M` from their ends."""
    pair, at, lead = _meetings(bars.start, bars.direction, bars.length, np.zeros(len(bars)), BEND_GAP_M, 0.0)
    start, end, is_bend = bars.start.copy(), bars.end.copy(), lead >= BEND_M
    for bar, along in zip(pair[is_bend].ravel(), at[is_bend].ravel(), strict=True):
        (start if along < bars.length[bar] / 2 else end)[bar] = bars.start[bar] + along * bars.direction[bar]
    return replace(bars, start=start, end=end)


def _extended(bars: Segments, joint: Array, tie: IntArray, lead: Array) -> Segments:
    """The bars, extended or cut to their first and last joints if these are near their ends."""
    start, end, length, direction = bars.start.copy(), bars.end.copy(), bars.length, bars.direction
    for bar in np.unique(tie[:, 1]):
        of_bar = tie[:, 1] == bar
        along = (joint[tie[of_bar, 0]] - bars.start[bar]) @ direction[bar]
        first, last = int(along.argmin()), int(along.argmax())
        low, high, slack = along[first], along[last], lead[of_bar] + SAME_M
        if -slack[first] <= low <= max(SAME_M, slack[first] - SAME_M) and low < length[bar] / 2:
            start[bar] = bars.start[bar] + low * direction[bar]
        if -max(SAME_M, slack[last] - SAME_M) <= high - length[bar] <= slack[last] and high > length[bar] / 2:
            end[bar] = bars.start[bar] + high * direction[bar]
    return replace(bars, start=start, end=end)


@njit(cache=True)
def _meetings(start, direction, length, width, slack, reach):  # type: ignore[no-untyped-def]
    """Pairs of bars that meet ``(P, 2)``, the positions along both ``(P, 2)``, metres from their starts, and the
    maximum extension or cut of either ``(P,)``."""
    pairs, positions, leads = [(0, 0)], [(0.0, 0.0)], [0.0]
    for i in range(len(length)):
        for j in range(i + 1, len(length)):
            apart = 0.0
            for k in range(3):  # scalar, since most pairs are rejected here
                middle = start[j, k] + 0.5 * length[j] * direction[j, k]
                apart += (middle - start[i, k] - 0.5 * length[i] * direction[i, k]) ** 2
            near = slack + 0.5 * (width[i] + width[j])
            if math.sqrt(apart) > 0.5 * (length[i] + length[j]) + near + 2.0 * max(BEND_M, LEAD_MAX_M) + 1e-6:
                continue
            cosine = (direction[i] * direction[j]).sum()
            if abs(cosine) > BEND_MIN:
                continue
            r = start[i] - start[j]
            c, f = (direction[i] * r).sum(), (direction[j] * r).sum()
            square = 1.0 - cosine * cosine
            s, t = (cosine * f - c) / square, (f - cosine * c) / square
            if abs(cosine) > BEND_MAX:
                lead = BEND_M
                # The two bars lie on opposite sides of a bend.
                side = (1.0 if s > 0.5 * length[i] else -1.0) * (1.0 if t > 0.5 * length[j] else -1.0) * cosine
                off_i, off_j = min(abs(s), abs(s - length[i])), min(abs(t), abs(t - length[j]))
                if side > 0.0 or off_i > min(BEND_M, 0.4 * length[i]) or off_j > min(BEND_M, 0.4 * length[j]):
                    continue
            else:
                lead = min(reach / math.sqrt(square), LEAD_MAX_M)
                s = min(max(s, -lead), length[i] + lead)
                t = min(max(f + cosine * s, -lead), length[j] + lead)
                s = min(max(cosine * t - c, -lead), length[i] + lead)
            gap = start[i] + s * direction[i] - (start[j] + t * direction[j])
            if math.sqrt((gap * gap).sum()) > near:
                continue
            pairs.append((i, j))
            positions.append((s, t))
            leads.append(lead)
    return np.array(pairs)[1:], np.array(positions)[1:], np.array(leads)[1:]


def _is_first(pair: IntArray, at: Array, length: Array) -> NDArray[np.bool_]:
    """Mask of the meetings ``(P,)`` for which no bar is extended past another one."""
    result = np.ones(len(pair), dtype=bool)
    for beyond in (-at, at - length[pair]):
        first = np.full(len(length), np.inf)
        for k in range(2):
            out = beyond[:, k] > -SAME_M
            np.minimum.at(first, pair[out, k], np.maximum(beyond[out, k], 0.0))
        for k in range(2):
            result &= ~((beyond[:, k] > 0) & (beyond[:, k] > first[pair[:, k]] + SAME_M))
    return result


def _groups(pair: IntArray, at: Array, point: Array) -> IntArray:
    """The joint of each meeting ``(P,)``: neighbours along a bar that are less than `SAME_M` apart are one."""
    meeting = np.concatenate([np.arange(len(pair))] * 2)
    bar, along = pair.T.ravel(), at.T.ravel()
    order = np.lexsort((along, bar))
    first, second = order[:-1], order[1:]
    near = (bar[first] == bar[second]) & (along[second] - along[first] < SAME_M)
    edges = list(zip(meeting[first[near]].tolist(), meeting[second[near]].tolist(), strict=True))
    # Two straight bars meet once, so joints that share two bars are merged. Two skew bars at an acute angle come
    # nearest to each other well away from the joints that a third bar forms with them.
    while True:
        ends = np.array(edges, dtype=np.int64).reshape(-1, 2)
        group = connected(ends, len(pair))
        middle = [point[group == joint].mean(axis=0) for joint in range(group.max(initial=-1) + 1)]
        joint_of: dict[tuple[int, int], int] = {}
        count = len(edges)
        for joint in range(len(middle)):
            for two in itertools.combinations(np.unique(pair[group == joint]).tolist(), 2):
                other = joint_of.setdefault(two, joint)
                if other != joint and np.linalg.norm(middle[other] - middle[joint]) < 2 * SAME_M:
                    edges.append((int(np.argmax(group == other)), int(np.argmax(group == joint))))
        if len(edges) == count:
            return group
