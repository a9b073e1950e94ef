"""Map of landmarks: points in the world, each with the descriptor of its last observation."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steelnb.images import project
from steelnb.odometry.features import Features
from steelnb.types import Array, IntArray

SIGHTINGS_MAX = 50
"""The weight of a new observation stops decreasing after this number, so a landmark's position can still change."""
ANGLE_MIN = 0.6
"""Minimum cosine between the current and the first viewing direction of a landmark."""
MISSES_MAX = 8
"""A landmark is removed when its misses exceed three times its observations by this number."""


class Expected(NamedTuple):
    """Landmarks expected in a camera's view: ``number (M,)`` in the map, ``pixel (M, 2)`` and ``depth (M,)``,
    metres."""

    number: IntArray
    pixel: Array
    depth: Array


class LandmarkMap:
    """At most ``count_max`` landmarks; of more, the least recently observed ones are removed.

    ``point (N, 3)``, world frame; ``descriptor (N, 4)``; ``octave (N,)``; ``towards (N, 3)``: unit vectors to the
    position of the first observation; ``found (N,)`` and ``missed (N,)``: numbers of observations and of expected
    observations that failed; ``last (N,)``: number of the last image that showed them.
    """

    def __init__(self, count_max: int) -> None:
        self.count_max = count_max
        self.point, self.towards = np.zeros((0, 3)), np.zeros((0, 3))
        self.descriptor: NDArray[np.uint64] = np.zeros((0, 4), np.uint64)
        self.octave, self.found, self.missed, self.last = np.zeros((4, 0), np.int64)

    def __len__(self) -> int:
        return len(self.point)

    def expected(self, T_world_camera: Array, K: Array, shape: tuple[int, int], range_max_m: float) -> Expected:
        """The landmarks in view of a camera at a pose ``(4, 4)`` whose image has ``shape``, rows and columns."""
        to_camera = T_world_camera[:3, 3] - self.point
        distance = np.linalg.norm(to_camera, axis=1)
        similar_view = (to_camera * self.towards).sum(axis=1) > ANGLE_MIN * distance
        index = np.flatnonzero(similar_view & (distance < range_max_m) & (distance > 0.1))
        in_camera = -to_camera[index] @ T_world_camera[:3, :3]
        pixel = project(in_camera, K)
        inside = ((pixel > 0) & (pixel < np.array(shape[::-1]) - 1.0)).all(axis=1)
        return Expected(index[inside], pixel[inside], in_camera[inside, 0])

    def update(self, index: IntArray, point: Array, features: Features, missed: IntArray, now: int) -> None:
        """Update the landmarks ``index (M,)``, observed as ``features`` at ``point (M, 3)`` (NaN if unknown) in image
        ``now``, and those that were ``missed``."""
        self.descriptor[index], self.octave[index] = features.descriptor, features.octave
        self.found[index] += 1
        self.last[index] = now
        self.missed[missed] += 1
        known = np.isfinite(point[:, 0])
        index, point = index[known], point[known]
        weight = 1.0 / np.minimum(self.found[index], SIGHTINGS_MAX)[:, None]
        self.point[index] += weight * (point - self.point[index])

    def insert(self, point: Array, features: Features, position: Array, now: int) -> None:
        """Add landmarks at ``point (M, 3)``, observed as ``features`` from a ``position (3,)`` in image ``now``."""
        to_camera = position - point
        count = len(point)
        self.point = np.concatenate([self.point, point])
        self.towards = np.concatenate([self.towards, to_camera / np.linalg.norm(to_camera, axis=1)[:, None]])
        self.descriptor = np.concatenate([self.descriptor, features.descriptor])
        self.octave = np.concatenate([self.octave, features.octave])
        self.found = np.concatenate([self.found, np.ones(count, np.int64)])
        self.missed = np.concatenate([self.missed, np.zeros(count, np.int64)])
        self.last = np.concatenate([self.last, np.full(count, now)])
        self._prune()

    def _prune(self) -> None:
        keep = self.missed <= 3 * self.found + MISSES_MAX
        if np.count_nonzero(keep) > self.count_max:
            oldest = np.argsort(np.where(keep, -self.last, 1), kind="stable")
            keep[oldest[self.count_max :]] = False
        for name in ("point", "towards", "descriptor", "octave", "found", "missed", "last"):
            setattr(self, name, getattr(self, name)[keep])
