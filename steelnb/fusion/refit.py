"""Bars refitted to the points of a cloud, each to those that are nearest to it, and their widths."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from steelnb.core.robust import geman_mcclure
from steelnb.core.types import Array, Segments
from steelnb.fusion.joints import TILT_DETERMINED_RAD
from steelnb.fusion.ridges import TUBE_M
from steelnb.hough.freedom import nearest_bar

HALF_WIDTH_SHARE = 0.9
"""Share of a bar's points that lie within half its width of its axis."""
FIT_TUBES, FIT_MIN, FIT_ROUNDS, FIT_SCALE = 1.5, 8, 3, 1.5
"""See `refitted`: distance of points in tube radii, their minimum number, rounds of weights, and the scale of these in
median distances."""
TURN_MAX_RAD = math.radians(20)


def refitted(points: Array, bars: Segments) -> tuple[Segments, NDArray[np.bool_]]:
    """The bars, each along the principal axis of the ``points (N, 3)`` that are nearest to it, and a mask ``(B,)`` of
    those whose points do not determine their direction.

    Contracted voxels give the direction of a short bar to some ten degrees only, its points to a few. Points have
    Geman-McClure weights, since some of them lie on bars that were not found. A bar is extended to those past its ends,
    up to a tube's radius. One that would turn by more than `TURN_MAX_RAD` keeps its axis.
    """
    start, end, is_weak, direction = bars.start.copy(), bars.end.copy(), np.ones(len(bars), dtype=bool), bars.direction
    for bar, own in enumerate(_own_points(points, bars, FIT_TUBES * TUBE_M, TUBE_M)):
        if len(own) < FIT_MIN:
            continue
        weight = np.ones(len(own))
        for _ in range(FIT_ROUNDS):
            mean = weight @ own / weight.sum()
            offset = own - mean
            value, vector = np.linalg.eigh((weight[:, None] * offset).T @ offset / weight.sum())
            axis = vector[:, 2]
            squared = ((offset - (offset @ axis)[:, None] * axis) ** 2).sum(axis=1)
            weight, _ = geman_mcclure(squared, max(FIT_SCALE * math.sqrt(np.median(squared)), 1e-6))
        axis = axis * np.sign(axis @ direction[bar])
        if axis @ direction[bar] < math.cos(TURN_MAX_RAD):
            continue
        along = offset @ axis
        low, high = ((each[bar] - mean) @ axis for each in (bars.start, bars.end))
        start[bar], end[bar] = mean + min(low, along.min()) * axis, mean + max(high, along.max()) * axis
        tilt = math.sqrt(0.5 * max(value[0] + value[1], 0.0) / max(value[2] * len(own), 1e-12))
        is_weak[bar] = tilt > TILT_DETERMINED_RAD
    return replace(bars, start=start, end=end), is_weak


def _own_points(points: Array, bars: Segments, distance_m: float, margin_m: float = 0.0) -> Iterator[Array]:
    """For each bar, the points ``(K, 3)`` within this distance of its axis that are nearer to it than to others. An
    axis extends ``margin_m`` past the ends of its bar."""
    nearest = nearest_bar(points, bars, distance_m, margin_m)
    order = np.argsort(nearest, kind="stable")
    for first, last in itertools.pairwise(np.searchsorted(nearest[order], np.arange(len(bars) + 1))):
        yield points[order[first:last]]


def widths_of(points: Array, bars: Segments) -> Array:
    """Width ``(B,)`` of each bar, metres: twice the distance from its axis within which `HALF_WIDTH_SHARE` of its
    points lie. These are the ``points (N, 3)`` that are nearest to its axis and within two tube radii of it."""
    width_m, direction = np.full(len(bars), 2 * TUBE_M), bars.direction
    for bar, own in enumerate(_own_points(points, bars, 2 * TUBE_M)):
        if len(own):
            offset = own - bars.start[bar]
            across = offset - (offset @ direction[bar])[:, None] * direction[bar]
            width_m[bar] = 2 * np.quantile(np.linalg.norm(across, axis=1), HALF_WIDTH_SHARE)
    return width_m
