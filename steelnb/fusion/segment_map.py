"""The map of segment odometry: the segments of all scans so far, associated and merged by their moments.

`structure_of` is the report's incremental reconstruction: the bars of a map, tied at joints.
"""

import math

import numpy as np
from numpy.typing import NDArray

from steelnb.core.errors import InputError
from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray, Segments, shift_of
from steelnb.fusion.joints import find_joints
from steelnb.fusion.structure import Structure
from steelnb.settings import FusionSettings

GAP_MAX_M = 0.2
"""Maximum gap along the axis between a segment and its bar."""


def associate(new: Segments, known: Segments, settings: FusionSettings) -> IntArray:
    """The nearest of K known segments for each of M new ones ``(M,)``, −1 if none matches; both in one frame, metres.

    Two segments match if the angle between them and the distance across are within the settings, and the gap along the
    known axis is within `GAP_MAX_M`. The distance across is measured in the middle of their overlap, or of the gap
    between them. The order of the ends of a segment does not matter.
    """
    if not len(new) or not len(known):
        return np.full(len(new), -1, dtype=np.int64)
    distance = pair_distance(new, known, settings)
    best = distance.argmin(axis=1)
    return np.where(np.isfinite(distance[np.arange(len(new)), best]), best, -1)


def pair_distance(new: Segments, known: Segments, settings: FusionSettings) -> Array:
    """Distances across ``(M, K)`` in metres between all pairs; infinite for pairs that do not match."""
    return _pair_distance(
        new.start, new.end, new.radius, known.start, known.end, known.radius, math.cos(settings.angle_max_rad),
        settings.distance_max_m, settings.add_radii,
    )  # fmt: skip


@njit(cache=True)
def _pair_distance(start, end, radius, known_start, known_end, known_radius, cosine_min, limit_m, add_radii):  # type: ignore[no-untyped-def]
    distance = np.full((len(start), len(known_start)), np.inf)
    for k in range(len(known_start)):
        x, y, z = known_start[k, 0], known_start[k, 1], known_start[k, 2]
        ux, uy, uz = known_end[k, 0] - x, known_end[k, 1] - y, known_end[k, 2] - z
        length = math.sqrt(ux * ux + uy * uy + uz * uz)
        scale = 1.0 / max(length, 1e-12)
        ux, uy, uz = ux * scale, uy * scale, uz * scale
        for m in range(len(start)):
            rx, ry, rz = end[m, 0] - start[m, 0], end[m, 1] - start[m, 1], end[m, 2] - start[m, 2]
            run = rx * ux + ry * uy + rz * uz
            if not abs(run) >= cosine_min * max(math.sqrt(rx * rx + ry * ry + rz * rz), 1e-12):
                continue
            ax, ay, az = start[m, 0] - x, start[m, 1] - y, start[m, 2] - z
            t_start = ax * ux + ay * uy + az * uz
            low, high = min(t_start, t_start + run), max(t_start, t_start + run)
            if max(low - length, -high) > GAP_MAX_M:
                continue
            t_middle = 0.5 * (min(max(low, 0.0), length) + min(max(high, 0.0), length))
            share = min(max((t_middle - t_start) / (run if abs(run) > 1e-9 else 1e-9), 0.0), 1.0)
            ax, ay, az = ax + share * rx, ay + share * ry, az + share * rz
            t = ax * ux + ay * uy + az * uz
            ax, ay, az = ax - t * ux, ay - t * uy, az - t * uz
            across = math.sqrt(ax * ax + ay * ay + az * az)
            if across <= limit_m + (radius[m] + known_radius[k] if add_radii else 0.0):
                distance[m, k] = across
    return distance


class SegmentMap:
    """Bars in the world frame, each merged from the segments of many scans.

    A bar is stored as the moments of its points about an origin near the first: their number, sum and sum of outer
    products. A segment counts as a uniform bar of its points. Moments add exactly, so the axis of a merged bar does not
    depend on the order.
    ``settings`` are the gates of `associate`; ``segments``: the B bars, metres; ``sightings (B,)``: number of segments
    merged into each.

    Two bars are merged if one would be associated with the other as a new segment. The final reconstruction instead
    has all bars at once, knows their widths, and distinguishes pieces from copies (`bars.merge_pieces`); a scan's
    points are merged before they are segments (`hough.segments.merge`).
    """

    def __init__(self, settings: FusionSettings | None = None) -> None:
        self.settings = FusionSettings() if settings is None else settings
        self.sightings = np.zeros(0, dtype=np.int64)
        self.inserts = 0
        self._last = np.zeros(0, dtype=np.int64)  # the insert in which a bar was last observed
        self._moments, self._origin = np.zeros((0, 14)), np.zeros(3)  # squares of large coordinates have no digits left
        self.segments = Segments.empty()

    def __len__(self) -> int:
        return len(self.segments)

    def __repr__(self) -> str:
        return f"SegmentMap({len(self)} bars, {self.segments.length.sum():.2f} m in all, of {self.inserts} scans)"

    def insert(self, new: Segments) -> IntArray:
        """Add M segments in the world frame; returns the bar of the map that each was merged into ``(M,)``.

        A segment without a match starts a bar. Bars that match each other once they have grown are merged, the later
        into the earlier. A ``segments`` object read before this call does not change. Raises `InputError` for a
        count that is not positive, and a radius that is not finite.
        """
        if not ((new.count > 0).all() and np.isfinite(new.radius).all()):
            raise InputError("new: a count below 1 or a radius that is not finite; expected segments of points")
        if len(new) and not len(self):
            self._origin = shift_of(new.start[0])
        target = associate(new, self.segments, self.settings)
        fresh = np.flatnonzero(target < 0)
        target[fresh] = len(self) + np.arange(len(fresh))
        self.sightings, self._last = (np.append(each, 0 * fresh) for each in (self.sightings, self._last))
        self._moments = np.concatenate([self._moments, np.zeros((len(fresh), 14))])
        self.segments = Segments.joined((self.segments, new.take(fresh)))
        np.add.at(self._moments, target, _moments(new.moved(-self._origin)))
        np.add.at(self.sightings, target, 1)
        self.inserts += 1
        self._last[target] = self.inserts
        self._refit(np.unique(target), new, target)
        return self._merge(target)

    def prune(self, sightings_min: int, inserts: int) -> None:
        """Drop the bars observed fewer than ``sightings_min`` times, and not in the last ``inserts``. The indices of
        later bars change."""
        self._keep((self.sightings >= sightings_min) | (self._last > self.inserts - inserts))

    def _refit(self, touched: IntArray, new: Segments, target: IntArray) -> None:
        """Fit axes to the moments, and ends to the extremes of the old and new ends along them."""
        moments = self._moments[touched]
        count, mean = moments[:, 0], moments[:, 1:4] / moments[:, :1]
        covariance = moments[:, 4:13].reshape(-1, 3, 3) / count[:, None, None] - mean[:, :, None] * mean[:, None, :]
        axis, mean = np.linalg.eigh(covariance)[1][:, :, 2], mean + self._origin
        position = np.full(len(self), -1, dtype=np.int64)
        position[touched] = np.arange(len(touched))
        low, high = np.full(len(touched), np.inf), np.full(len(touched), -np.inf)
        old = self.segments.take(touched)
        owner = np.concatenate([np.arange(len(touched))] * 2 + [position[target]] * 2)
        ends = np.concatenate([old.start, old.end, new.start, new.end])
        along = ((ends - mean[owner]) * axis[owner]).sum(axis=1)
        np.minimum.at(low, owner, along)
        np.maximum.at(high, owner, along)
        s = self.segments
        s.start[touched], s.end[touched] = mean + low[:, None] * axis, mean + high[:, None] * axis
        s.count[touched] = np.round(count).astype(np.int64)
        s.radius[touched] = np.sqrt(moments[:, 13] / count)

    def _merge(self, touched: IntArray) -> IntArray:
        """Merge bars that have grown into each other; returns ``touched`` renumbered."""
        while True:
            some = np.unique(touched)
            distance = pair_distance(self.segments.take(some), self.segments, self.settings)
            distance[np.arange(len(some)), some] = np.inf
            pair = np.unravel_index(distance.argmin(), distance.shape) if distance.size else None
            if pair is None or not math.isfinite(distance[pair]):
                return touched
            a, b = sorted((int(some[pair[0]]), int(pair[1])))
            self._moments[a] += self._moments[b]
            self.sightings[a] += self.sightings[b]
            self._last[a] = max(self._last[a], self._last[b])
            self._refit(np.array([a]), self.segments.take(np.array([b])), np.array([a]))
            self._keep(np.arange(len(self)) != b)
            touched = np.where(touched == b, a, touched)
            touched = np.where(touched > b, touched - 1, touched)

    def _keep(self, keep: NDArray[np.bool_]) -> None:
        self._moments, self.sightings, self._last = self._moments[keep], self.sightings[keep], self._last[keep]
        self.segments = self.segments.take(keep)


def _moments(segments: Segments) -> Array:
    """Moments ``(M, 14)`` of uniform bars: number, sum (3), sum of outer products (9), sum of squared distances to the
    axis."""
    count = segments.count.astype(np.float64)
    middle, half_run = segments.middle, 0.5 * (segments.end - segments.start)
    spread = half_run[:, :, None] * half_run[:, None, :] / 3.0
    outer = count[:, None, None] * (spread + middle[:, :, None] * middle[:, None, :])
    return np.column_stack([count, count[:, None] * middle, outer.reshape(-1, 9), count * segments.radius**2])


SIGHTINGS_MIN, FORGET_FRAMES = 5, 50
"""A bar counts from its fifth sighting on, after a second of flight. One with fewer is dropped after ten seconds out of
sight."""


def structure_of(bars: SegmentMap) -> Structure:
    """The bars of a map with at least `SIGHTINGS_MIN` sightings, tied at joints (`find_joints`). An empty structure
    states the reason.

    The axis of a bar runs through the middle of its points, so on the near side of its section; its width is NaN.
    ``sigma_m``: spread of the points over the root of the sightings, since errors within one sighting are correlated.
    """
    chosen = bars.sightings >= SIGHTINGS_MIN
    segments, sightings = bars.segments.take(chosen), bars.sightings[chosen]
    if not len(segments):
        return Structure.empty(f"none of {len(bars)} bars was seen {SIGHTINGS_MIN} times")
    joint, tie, led = find_joints(segments, 2 * segments.radius)
    return Structure(led, np.full(len(led), np.nan), sightings, segments.radius / np.sqrt(sightings), joint, tie)
