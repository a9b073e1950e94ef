"""Merging of bars: pieces in line become one, copies of stronger bars are dropped."""

import math

import numpy as np
from numba import njit

from steelnb.types import Array, Segments

IN_LINE_RAD = math.radians(4)
COPY_RAD = math.radians(15)
COPY_SHARE = 0.6
SAMPLES = 9
"""Bounds of pieces in line and of copies, chosen with `fusion.proposals.TUBE_M`; points along a bar that are
compared."""
GAP_MAX_M, COPY_M = 0.3, 0.2
"""Largest gap between pieces of one bar; what mostly runs within the second of a stronger bar, and hardly rises across
that, is a copy of it."""


def merge_pieces(
    bars: Segments,
    gap_m: float,
    copy_m: float,
    aside_m: float,
    width_m: Array | None = None,
    rise_m: float = math.inf,
) -> Segments:
    """Join bars in line, up to ``gap_m`` apart and ``aside_m`` beside each other; drop copies; strongest first.

    A copy runs at up to 15° to a bar with more points, and 60 % of it within ``copy_m`` of that; and across that bar it
    rises by at most ``rise_m``, over its own length. The last bound tells a copy from a brace that leaves a chord at an
    acute angle, and lies within ``copy_m`` of it for most of its length: a copy is a line through the points of the
    stronger bar, which lie within a tube about it. With those points spread evenly over the tube, of radius t, a line
    that is fitted to any part of them rises by at most t: as far as from the middle of one half of the tube to that of
    the other, if one end has the points of one half and the other those of the other. A brace rises by its length times
    the sine of its angle, 0.2 m for one metre at 12°. So ``rise_m`` is the radius of the tubes, if the braces are
    wanted; without it, all of them are copies.

    Where the widths of bars are known ``(B,)``, NaN where not, a wide one has wider bounds: points of an angle section
    lie as far from its centroid as 0.8 of its flange, which is then the radius of its tube, and the middles of two
    views of it half a flange apart. A joined bar has the moments of its pieces, each taken for a uniform bar of its
    points: they add exactly, whatever the order.
    """
    width = np.zeros(len(bars)) if width_m is None else np.nan_to_num(width_m)
    while len(bars):
        order = np.argsort(-bars.count, kind="stable")
        bars, width = bars.take(order), width[order]
        copy, aside = np.maximum(copy_m, 0.8 * width), np.maximum(aside_m, 0.5 * width)
        fate = _fates(bars.start, bars.direction, bars.length, gap_m, copy, aside, np.maximum(rise_m, 0.8 * width))
        if (fate == np.arange(len(bars))).all():
            break
        bars, width = _joined(bars, fate), width[fate == np.arange(len(bars))]
    return bars


def _joined(bars: Segments, fate: np.ndarray) -> Segments:
    kept = np.flatnonzero(fate == np.arange(len(bars)))
    start, end = bars.start[kept].copy(), bars.end[kept].copy()
    count, radius = bars.count[kept].copy(), bars.radius[kept].copy()
    for k, bar in enumerate(kept):
        pieces = np.flatnonzero(fate == bar)
        if len(pieces) == 1:
            continue
        mean, axis, total, across = combined(bars.take(pieces))
        along = (np.concatenate([bars.start[pieces], bars.end[pieces]]) - mean) @ axis
        start[k], end[k] = mean + along.min() * axis, mean + along.max() * axis
        count[k], radius[k] = total, across
    return Segments(start, end, count, radius)


def combined(pieces: Segments) -> tuple[np.ndarray, np.ndarray, int, float]:
    """Mean ``(3,)``, axis ``(3,)``, number of points and radius of pieces taken for uniform bars of their points."""
    weight = pieces.count / pieces.count.sum()
    mean = weight @ pieces.middle
    offset, half = pieces.middle - mean, 0.5 * (pieces.end - pieces.start)
    spread = np.einsum("k,ki,kj->ij", weight, half, half) / 3 + np.einsum("k,ki,kj->ij", weight, offset, offset)
    value, vector = np.linalg.eigh(spread)
    across = math.sqrt(max(value[0] + value[1], 0.0) + float(weight @ pieces.radius**2))
    return mean, vector[:, 2], int(pieces.count.sum()), across


@njit(cache=True)
def _fates(start, direction, length, gap, copy, aside, rise):  # type: ignore[no-untyped-def]
    """The stronger bar that each bar joins, itself for none, or −1 for a copy. At most one join a bar and round."""
    n = len(length)
    fate = np.arange(n)
    taken = np.zeros(n, np.bool_)
    for j in range(1, n):
        for i in range(j):
            if fate[i] != i:
                continue
            near_by, square = copy[i], 0.0
            for k in range(3):  # as numbers: all pairs come here, and few pass
                middle = start[j, k] + 0.5 * length[j] * direction[j, k]
                square += (middle - start[i, k] - 0.5 * length[i] * direction[i, k]) ** 2
            if math.sqrt(square) > 0.5 * (length[i] + length[j]) + gap + near_by:
                continue
            cosine = abs((direction[i] * direction[j]).sum())
            if cosine < math.cos(COPY_RAD):
                continue
            beside = low = high = 0.0
            near = 0
            low, high = 1e9, -1e9
            for k in range(SAMPLES):
                r = start[j] + (k + 0.5) / SAMPLES * length[j] * direction[j] - start[i]
                t = (r * direction[i]).sum()
                low, high = min(low, t), max(high, t)
                distance = math.sqrt(max((r * r).sum() - t * t, 0.0))
                if distance <= near_by and -near_by <= t <= length[i] + near_by:
                    near += 1
            across = length[j] * math.sqrt(max(1.0 - cosine * cosine, 0.0))
            if near >= COPY_SHARE * SAMPLES and across <= rise[i]:
                fate[j] = -1
                break
            if cosine < math.cos(IN_LINE_RAD) or taken[i] or taken[j]:
                continue
            if max(low - length[i], -high) > gap:
                continue
            # Beside each other: where the gap or the overlap has its middle.
            t = 0.5 * (min(max(low, 0.0), length[i]) + min(max(high, 0.0), length[i]))
            r = start[i] + t * direction[i] - start[j]
            s = (r * direction[j]).sum()
            beside = math.sqrt(max((r * r).sum() - s * s, 0.0))
            if beside <= aside[i]:
                fate[j] = i
                taken[i] = taken[j] = True
                break
    return fate
