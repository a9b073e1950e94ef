"""Landmarks of a flight, tracked through its images by ORB features whose depths the Time-of-Flight sensor gives.

The tracking of ORB-SLAM (Mur-Artal, Montiel, Tardós, IEEE Transactions on Robotics 31, 2015) with a local map, without
its bundle adjustment and its loop closing.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steelnb.images import CameraImages, GreyImage, unproject
from steelnb.odometry.features import Features, features_with_depth, match, near_any
from steelnb.odometry.landmarks import Expected, LandmarkMap
from steelnb.odometry.reprojection import Sighting, solve_pose
from steelnb.points.ranges import SIGMA_M, SIGMA_SHARE
from steelnb.registration import Term
from steelnb.types import Array, IntArray

APART_PX = 4.0
"""New landmarks keep this distance from those already expected in the image."""
INLIER_WEIGHT = 0.25
"""Least robust weight of a match that counts: that of an error of the robust scale itself."""
FEATURES = 800
"""At most so many are sought in an image."""
KEYFRAME_M, TURN_RAD_PER_M = 0.1, 0.5
"""New landmarks are taken after so much of the path, a turn counted as so many radians a metre."""
SEARCH_PX, HAMMING = 8.0, 60
"""A landmark is sought so near to where the prediction sees it, among descriptors that differ in at most so many of
their 256 bits. An error of 5 cm, the prior's standard deviation, is 8 pixels of the forward camera at 1.1 m."""
NEAR_PX, NEAR_HAMMING = 3.0, 110
"""Once a first solve has told where landmarks are, they are sought nearer, among descriptors that differ more."""
RATIO = 0.85
"""The best descriptor differs in at most this share of the bits of the second best (Lowe, IJCV 60, 2004: 0.8)."""
PIXEL_SIGMA = 1.0
"""Standard deviation of a feature's place on the finest level, pixels, as in ORB-SLAM."""
ROBUST_SCALE = 2.0
"""Of the Geman-McClure weights, in standard deviations."""
MATCHES_MIN = 8
"""A scan with fewer corrects nothing: four would do for a pose, and as many check it."""
LANDMARKS_MAX = 10_000
"""Of more landmarks those seen longest ago are dropped."""
Pull = Callable[[Array], tuple[list[Term], Array]]
"""Places of the landmarks seen, drone frame ``(N, 3)`` → costs of the distance from the prediction, and the point of
the drone ``(3,)`` whose shift they are of."""


class Tracked(NamedTuple):
    """An image's ``features``, and what they show of the map: ``T_world_drone (4, 4)``, or the predicted pose and the
    ``reason`` why; the ``seen`` landmarks, those expected in view; ``found (M,)``, the number of the feature that shows
    each, −1 for none; ``kept (M,)``, whether it agrees with the pose; the ``shape`` of the image; and the normal
    equations ``H (6, 6)`` of the solve, of twists about a ``centre (3,)``."""

    T_world_drone: Array
    reason: str
    features: Features
    seen: Expected
    found: IntArray
    kept: NDArray[np.bool_]
    shape: tuple[int, int]
    H: Array = np.zeros((6, 6))
    centre: Array = np.zeros(3)

    @property
    def matches(self) -> int:
        """Number of landmarks that agree with the pose."""
        return int(np.count_nonzero(self.kept))


class LandmarkTracker:
    """The map of landmarks, and the poses of images in it.

    Parameters
    ----------
    images : of a camera on the drone; of these, the last before or at each scan is used.
    T_drone_sensor : (4, 4), the mount of the Time-of-Flight sensor.
    range_max_m : landmarks farther away are not sought.
    """

    def __init__(self, images: CameraImages, T_drone_sensor: Array, range_max_m: float) -> None:
        self.images, self.range_max_m = images, range_max_m
        self.T_camera_sensor = np.linalg.inv(images.T_drone_camera) @ T_drone_sensor
        self.map = LandmarkMap(LANDMARKS_MAX)
        self.count = 0
        self.T_keyframe: Array | None = None

    def image_at(self, stamp_s: float) -> GreyImage | None:
        """The image ``(H, W)`` of a scan; None where there is none of its time."""
        number = self.images.at(stamp_s)
        return None if number is None else self.images.images[number]

    def find(self, image: GreyImage, points: Array) -> Features:
        """Features of an image where the scan, ``(N, 3)`` or ``(H, W, 3)``, has returns, with their depths."""
        return features_with_depth(image, points, self.T_camera_sensor, self.images.K, FEATURES)

    def track(self, features: Features, shape: tuple[int, int], T_predicted: Array, free: Array, pull: Pull) -> Tracked:
        """The pose of an image of a ``shape``, from the one predicted, in the directions ``free (6, k)``."""
        first = self._solve(features, shape, T_predicted, T_predicted, SEARCH_PX, HAMMING, free, pull)
        if first.reason:
            return first
        second = self._solve(features, shape, T_predicted, first.T_world_drone, NEAR_PX, NEAR_HAMMING, free, pull)
        return first if second.reason else second

    def update(self, tracked: Tracked, T_world_drone: Array) -> None:
        """Move the landmarks of an image, whose pose is known by now, to where it shows them, and add new ones at a
        keyframe; and where the map has too few, so that they continue it at that pose."""
        if not tracked.reason:
            kept, features = tracked.kept, tracked.features.take(tracked.found[tracked.kept])
            number = tracked.seen.number
            self.map.update(number[kept], self._world(features, T_world_drone), features, number[~kept], self.count)
        if bool(tracked.reason) or self._is_keyframe(T_world_drone):
            self._extend(tracked.features, T_world_drone, tracked.shape)
        self.count += 1

    def _solve(
        self, features: Features, shape: tuple[int, int], T_predicted: Array, T_init: Array, search_px: float,
        hamming_max: int, free: Array, pull: Pull,
    ) -> Tracked:  # fmt: skip
        """The pose by the landmarks expected at ``T_init`` that features show."""
        seen = self._expected(T_init, shape)
        found = match(
            *features, seen.pixel, self.map.octave[seen.number], seen.depth, self.map.descriptor[seen.number],
            search_px, hamming_max, RATIO,
        )  # fmt: skip
        kept = found >= 0
        failed = Tracked(T_predicted, "", features, seen, found, kept, shape)
        if len(features.pixel) < MATCHES_MIN:
            return failed._replace(reason="too few features")
        if not len(self.map):
            return failed._replace(reason="first scan")
        if failed.matches < MATCHES_MIN:
            return failed._replace(reason="too few matches")
        sighting = self._sighting(features, seen, found)
        terms, middle = pull((sighting.landmark - T_predicted[:3, 3]) @ T_predicted[:3, :3])
        solved = solve_pose(
            sighting, self.images.K, self.images.T_drone_camera, T_init, free, terms, middle, ROBUST_SCALE
        )  # fmt: skip
        kept[kept] = solved.weight >= INLIER_WEIGHT
        if not solved.determined:
            return failed._replace(reason="singular")
        if failed.matches < MATCHES_MIN:
            return failed._replace(reason="too few matches agree")
        return failed._replace(T_world_drone=solved.T_world_drone, H=solved.H, centre=solved.centre)

    def _expected(self, T_world_drone: Array, shape: tuple[int, int]) -> Expected:
        """The landmarks that an image of a ``shape`` should show at a pose."""
        return self.map.expected(T_world_drone @ self.images.T_drone_camera, self.images.K, shape, self.range_max_m)

    def _sighting(self, features: Features, seen: Expected, found: IntArray) -> Sighting:
        """The landmarks of those seen that features show."""
        shown = features.take(found[found >= 0])
        return Sighting(
            self.map.point[seen.number[found >= 0]], shown.pixel, PIXEL_SIGMA * shown.sigma_scale, shown.depth,
            np.maximum(SIGMA_M, SIGMA_SHARE * shown.depth),
        )  # fmt: skip

    def _world(self, features: Features, T_world_drone: Array) -> Array:
        """Places ``(N, 3)`` of features in the world, NaN without a depth."""
        T_world_camera = T_world_drone @ self.images.T_drone_camera
        points = features.depth[:, None] * unproject(features.pixel, self.images.K)
        return points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]

    def _is_keyframe(self, T_world_drone: Array) -> bool:
        T_last = self.T_keyframe
        if T_last is None:
            return True
        moved = np.linalg.norm(T_world_drone[:3, 3] - T_last[:3, 3])
        turned = np.linalg.norm(T_world_drone[:3, :3] - T_last[:3, :3]) / 2**0.5
        return bool(moved + turned / TURN_RAD_PER_M >= KEYFRAME_M)

    def _extend(self, features: Features, T_world_drone: Array, shape: tuple[int, int]) -> None:
        """New landmarks, where none is expected."""
        self.T_keyframe = T_world_drone
        T_world_camera = T_world_drone @ self.images.T_drone_camera
        known = self._expected(T_world_drone, shape).pixel
        new = np.flatnonzero(np.isfinite(features.depth))
        new = new[~near_any(features.pixel[new], known, APART_PX)]
        if len(new):
            chosen = features.take(new)
            self.map.insert(self._world(chosen, T_world_drone), chosen, T_world_camera[:3, 3], self.count)
