"""Map of landmarks: points in the world, each with the descriptor of the feature that showed it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steelnb.images import project
from steelnb.odometry.features import Features
from steelnb.types import Array, IntArray

SIGHTINGS_MAX = 50
"""Sightings after which a further one weighs no less, so that the mean of a landmark's places can still move."""
ANGLE_MIN = 0.6
"""Least cosine between the directions in which a landmark is seen and in which it was first seen."""
MISSES_MAX = 8
"""A landmark goes once it was expected this many times more often than three times as often as it was found."""


class Expected(NamedTuple):
    """Landmarks that a camera should see: their ``number (M,)`` in the map, ``pixel (M, 2)`` and ``depth (M,)``."""

    number: IntArray
    pixel: Array
    depth: Array


class LandmarkMap:
    """At most ``count_max`` landmarks; beyond, those seen longest ago go.

    ``point (N, 3)``, world frame; ``descriptor (N, 4)``; ``octave (N,)``; ``towards (N, 3)``, unit vectors to where
    they were first seen from; ``found (N,)``, ``missed (N,)`` and ``last (N,)``: how often they were seen, how often
    they should have been and were not, and the number of the image in which they were seen last.
    """

    def __init__(self, count_max: int) -> None:
        self.count_max = count_max
        self.point, self.towards = np.zeros((0, 3)), np.zeros((0, 3))
        self.descriptor: NDArray[np.uint64] = np.zeros((0, 4), np.uint64)
        self.octave, self.found, self.missed, self.last = np.zeros((4, 0), np.int64)

    def __len__(self) -> int:
        return len(self.point)

    def expected(self, T_world_camera: Array, K: Array, shape: tuple[int, int], range_max_m: float) -> Expected:
        """The landmarks in view of a camera whose image has ``shape``, rows and columns."""
        to = T_world_camera[:3, 3] - self.point
        distance = np.linalg.norm(to, axis=1)
        facing = (to * self.towards).sum(axis=1) > ANGLE_MIN * distance
        index = np.flatnonzero(facing & (distance < range_max_m) & (distance > 0.1))
        seen = -to[index] @ T_world_camera[:3, :3]
        pixel = project(seen, K)
        inside = ((pixel > 0) & (pixel < np.array(shape[::-1]) - 1.0)).all(axis=1)
        return Expected(index[inside], pixel[inside], seen[inside, 0])

    def update(self, index: IntArray, point: Array, features: Features, missed: IntArray, now: int) -> None:
        """Landmarks were seen as ``features`` at ``point (M, 3)``, NaN where that is not known, and others ``missed``,
        in image ``now``."""
        self.descriptor[index], self.octave[index] = features.descriptor, features.octave
        self.found[index] += 1
        self.last[index] = now
        self.missed[missed] += 1
        known = np.isfinite(point[:, 0])
        index, point = index[known], point[known]
        share = 1.0 / np.minimum(self.found[index], SIGHTINGS_MAX)[:, None]
        self.point[index] += share * (point - self.point[index])

    def insert(self, point: Array, features: Features, position: Array, now: int) -> None:
        """Add landmarks at ``point (M, 3)``, seen as ``features`` from a ``position (3,)`` in image ``now``."""
        to = position - point
        count = len(point)
        self.point = np.concatenate([self.point, point])
        self.towards = np.concatenate([self.towards, to / np.linalg.norm(to, axis=1)[:, None]])
        self.descriptor = np.concatenate([self.descriptor, features.descriptor])
        self.octave = np.concatenate([self.octave, features.octave])
        self.found = np.concatenate([self.found, np.ones(count, np.int64)])
        self.missed = np.concatenate([self.missed, np.zeros(count, np.int64)])
        self.last = np.concatenate([self.last, np.full(count, now)])
        self._prune()

    def _prune(self) -> None:
        kept = self.missed <= 3 * self.found + MISSES_MAX
        if np.count_nonzero(kept) > self.count_max:
            oldest = np.argsort(np.where(kept, -self.last, 1), kind="stable")
            kept[oldest[self.count_max :]] = False
        for name in ("point", "towards", "descriptor", "octave", "found", "missed", "last"):
            setattr(self, name, getattr(self, name)[kept])
