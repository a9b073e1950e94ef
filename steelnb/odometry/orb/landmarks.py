"""Map of landmarks: points in the world, each with the descriptor of its last observation."""

from typing import NamedTuple

import numpy as np

from steelnb.core.types import Array, IntArray, project
from steelnb.odometry.orb.features import Features

SIGHTINGS_MAX = 50
"""The weight of a new observation stops decreasing after this number, so that positions can still change."""
ANGLE_MIN = 0.6
"""Minimum cosine between the current and the first viewing direction of a landmark."""
MISSES_MAX = 8
"""A landmark is removed when its misses exceed three times its observations by this number."""
LANDMARK = np.dtype(
    [("point", "f8", 3), ("towards", "f8", 3), ("descriptor", "u8", 4), ("octave", "i8"), ("found", "i8"),
     ("missed", "i8"), ("last", "i8")]
)  # fmt: skip
"""``point``, world frame; ``towards``: unit vector to the position of the first observation; ``found`` and ``missed``:
numbers of observations and of expected observations that failed; ``last``: number of the last image that showed it."""


class Expected(NamedTuple):
    """Landmarks expected in a camera's view: ``number (M,)`` in the map, ``pixel (M, 2)`` and ``depth (M,)``,
    metres."""

    number: IntArray
    pixel: Array
    depth: Array


class LandmarkMap:
    """At most ``count_max`` landmarks, ``table (N,)`` of `LANDMARK`. Beyond that, the least recently observed are
    removed."""

    def __init__(self, count_max: int) -> None:
        self.count_max, self.table = count_max, np.zeros(0, LANDMARK)

    def __len__(self) -> int:
        return len(self.table)

    def expected(self, T_world_camera: Array, K: Array, shape: tuple[int, int], range_max_m: float) -> Expected:
        """The landmarks in view of a camera at a pose ``(4, 4)`` whose image has ``shape``, rows and columns."""
        to_camera = T_world_camera[:3, 3] - self.table["point"]
        distance = np.linalg.norm(to_camera, axis=1)
        similar_view = (to_camera * self.table["towards"]).sum(axis=1) > ANGLE_MIN * distance
        index = np.flatnonzero(similar_view & (distance < range_max_m) & (distance > 0.1))
        in_camera = -to_camera[index] @ T_world_camera[:3, :3]
        pixel = project(in_camera, K)
        inside = ((pixel > 0) & (pixel < np.array(shape[::-1]) - 1.0)).all(axis=1)
        return Expected(index[inside], pixel[inside], in_camera[inside, 0])

    def update(self, index: IntArray, point: Array, features: Features, missed: IntArray, now: int) -> None:
        """Update the landmarks ``index (M,)``, observed as ``features`` at ``point (M, 3)`` (NaN if unknown) in image
        ``now``, and those that were ``missed``."""
        table = self.table
        table["descriptor"][index], table["octave"][index] = features.descriptor, features.octave
        table["found"][index] += 1
        table["last"][index] = now
        table["missed"][missed] += 1
        known = np.isfinite(point[:, 0])
        index, point = index[known], point[known]
        weight = 1.0 / np.minimum(table["found"][index], SIGHTINGS_MAX)[:, None]
        table["point"][index] += weight * (point - table["point"][index])

    def insert(self, point: Array, features: Features, position: Array, now: int) -> None:
        """Add landmarks at ``point (M, 3)``, observed as ``features`` from a ``position (3,)`` in image ``now``."""
        new, to_camera = np.zeros(len(point), LANDMARK), position - point
        new["point"], new["towards"] = point, to_camera / np.linalg.norm(to_camera, axis=1)[:, None]
        new["descriptor"], new["octave"] = features.descriptor, features.octave
        new["found"], new["last"] = 1, now
        table = np.concatenate([self.table, new])
        keep = table["missed"] <= 3 * table["found"] + MISSES_MAX
        oldest = np.argsort(np.where(keep, -table["last"], 1), kind="stable")
        keep[oldest[self.count_max :]] = False
        self.table = table[keep]
