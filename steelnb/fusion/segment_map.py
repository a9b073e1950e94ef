"""The map of bars seen so far: association and merging weighted by point counts."""

import math

import numpy as np
from numpy.typing import NDArray

from steelnb.config import FusionSettings
from steelnb.datatypes import Array, IntArray, Segments
from steelnb.fusion.association import associate, pair_distance


class SegmentMap:
    """Segments in the world frame that grow, merge and get surer as new ones come in.

    Each bar is kept as the moments of its points: their number, sum and sum of outer products, each new segment
    counting as a uniform bar of its points. Moments add exactly, so a merge does not depend on the order.
    """

    def __init__(self, settings: FusionSettings | None = None) -> None:
        self.settings = settings or FusionSettings()
        self.sightings = np.zeros(0, dtype=np.int64)
        self.inserts = 0
        self._last = np.zeros(0, dtype=np.int64)  # the insert in which a bar was last seen
        self._count = np.zeros(0)
        self._sum = np.zeros((0, 3))
        self._outer = np.zeros((0, 3, 3))
        self._square = np.zeros(0)  # sum of squared distances to the axes, for the radius
        self._segments = Segments.empty()

    def __len__(self) -> int:
        return len(self._segments)

    @property
    def segments(self) -> Segments:
        """The bars of the map, world frame."""
        return self._segments

    def insert(self, new: Segments) -> IntArray:
        """Add segments ``(M,)`` in the world frame; returns the bar of the map that each went to.

        A segment that matches a bar is merged with it, otherwise it starts one. Bars that match each other after
        they grew are merged too, the later into the earlier.
        """
        target = associate(new, self._segments, self.settings)
        fresh = np.flatnonzero(target < 0)
        target[fresh] = len(self) + np.arange(len(fresh))
        self._grow(len(fresh))
        count, total, outer, square = _moments(new)
        np.add.at(self._count, target, count)
        np.add.at(self._sum, target, total)
        np.add.at(self._outer, target, outer)
        np.add.at(self._square, target, square)
        np.add.at(self.sightings, target, 1)
        self.inserts += 1
        self._last[target] = self.inserts
        self._refit(np.unique(target), new, target)
        return self._merge(target)

    def prune(self, sightings_min: int, inserts: int) -> int:
        """Drop the bars seen fewer than ``sightings_min`` times and not in the last ``inserts``; returns how many.

        Called now and then, it bounds the memory by the bars that are there. The indices of later bars change.
        """
        keep = (self.sightings >= sightings_min) | (self._last > self.inserts - inserts)
        self._keep(keep)
        return int(np.count_nonzero(~keep))

    def _grow(self, by: int) -> None:
        self.sightings = np.append(self.sightings, np.zeros(by, dtype=np.int64))
        self._last = np.append(self._last, np.zeros(by, dtype=np.int64))
        self._count = np.append(self._count, np.zeros(by))
        self._sum = np.concatenate([self._sum, np.zeros((by, 3))])
        self._outer = np.concatenate([self._outer, np.zeros((by, 3, 3))])
        self._square = np.append(self._square, np.zeros(by))
        blank = np.full((by, 3), np.nan)
        old = self._segments
        self._segments = Segments(
            np.concatenate([old.start, blank]), np.concatenate([old.end, blank]),
            np.append(old.count, np.zeros(by, dtype=np.int64)), np.append(old.radius, np.zeros(by)),
        )  # fmt: skip

    def _refit(self, touched: IntArray, new: Segments, target: IntArray) -> None:
        """Axis from the moments, ends from the extremes of the old ends and the new ones along it."""
        mean = self._sum[touched] / self._count[touched, None]
        covariance = self._outer[touched] / self._count[touched, None, None] - mean[:, :, None] * mean[:, None, :]
        axis = np.linalg.eigh(covariance)[1][:, :, 2]
        position = np.full(len(self), -1, dtype=np.int64)
        position[touched] = np.arange(len(touched))
        low, high = np.full(len(touched), np.inf), np.full(len(touched), -np.inf)
        old = self._segments.take(touched)
        owner = np.concatenate([np.arange(len(touched))] * 2 + [position[target]] * 2)
        ends = np.concatenate([old.start, old.end, new.start, new.end])
        along = ((ends - mean[owner]) * axis[owner]).sum(axis=1)
        known = np.isfinite(along)
        np.minimum.at(low, owner[known], along[known])
        np.maximum.at(high, owner[known], along[known])
        s = self._segments
        s.start[touched], s.end[touched] = mean + low[:, None] * axis, mean + high[:, None] * axis
        s.count[touched] = np.round(self._count[touched]).astype(np.int64)
        s.radius[touched] = np.sqrt(self._square[touched] / self._count[touched])

    def _merge(self, touched: IntArray) -> IntArray:
        """Merge bars that have grown into one another; returns ``touched`` renumbered."""
        while True:
            some = np.unique(touched)
            distance = pair_distance(self._segments.take(some), self._segments, self.settings)
            distance[np.arange(len(some)), some] = np.inf
            pair = np.unravel_index(distance.argmin(), distance.shape) if distance.size else None
            if pair is None or not math.isfinite(distance[pair]):
                return touched
            a, b = sorted((int(some[pair[0]]), int(pair[1])))
            self._absorb(a, b)
            touched = np.where(touched == b, a, touched)
            touched = np.where(touched > b, touched - 1, touched)

    def _absorb(self, a: int, b: int) -> None:
        one = self._segments.take(np.array([b]))
        for moments in (self._count, self._sum, self._outer, self._square, self.sightings):
            moments[a] += moments[b]
        self._last[a] = max(self._last[a], self._last[b])
        self._refit(np.array([a]), one, np.array([a]))
        self._keep(np.arange(len(self)) != b)

    def _keep(self, keep: NDArray[np.bool_]) -> None:
        self._count, self._sum, self._outer = self._count[keep], self._sum[keep], self._outer[keep]
        self._square, self.sightings = self._square[keep], self.sightings[keep]
        self._last = self._last[keep]
        self._segments = self._segments.take(keep)


def _moments(segments: Segments) -> tuple[Array, Array, Array, Array]:
    """Number, sum ``(M, 3)``, sum of outer products ``(M, 3, 3)`` and of squared distances of uniform bars."""
    count = segments.count.astype(np.float64)
    middle, half = segments.middle, 0.5 * (segments.end - segments.start)
    spread = half[:, :, None] * half[:, None, :] / 3.0
    outer = count[:, None, None] * (spread + middle[:, :, None] * middle[:, None, :])
    return count, count[:, None] * middle, outer, count * segments.radius**2
