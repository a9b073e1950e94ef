"""Tracking of landmarks by ORB features with depths from the Time-of-Flight sensor.

This is the tracking of ORB-SLAM (Mur-Artal, Montiel, Tardós, IEEE Transactions on Robotics 31, 2015) with a local map,
without bundle adjustment and loop closing.
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

SPACING_PX = 4.0
"""Minimum distance of new landmarks from those already expected in the image."""
INLIER_WEIGHT = 0.25
"""Minimum robust weight of an inlier: that of an error equal to the robust scale."""
FEATURES = 800
"""Maximum number of features per image."""
KEYFRAME_M, TURN_RAD_PER_M = 0.1, 0.5
"""A keyframe is taken after this distance, where this many radians of rotation count as a metre."""
SEARCH_PX, HAMMING = 8.0, 60
"""Search radius around the predicted pixel, and maximum Hamming distance of the 256-bit descriptors. An error of 5 cm,
the prior's standard deviation, is 8 pixels of the forward camera at 1.1 m."""
NEAR_PX, NEAR_HAMMING = 3.0, 110
"""The same for the second search, from the pose of the first solve."""
RATIO = 0.85
"""Ratio test: maximum distance of the best descriptor relative to the second best (Lowe, IJCV 60, 2004: 0.8)."""
PIXEL_SIGMA = 1.0
"""Standard deviation of a feature's pixel on the finest level, as in ORB-SLAM."""
ROBUST_SCALE = 2.0
"""Scale of the Geman-McClure weights, in standard deviations."""
MATCHES_MIN = 8
"""Minimum number of matches: four for a pose, and four to check it."""
LANDMARKS_MAX = 10_000
"""Of more landmarks, the least recently observed ones are removed."""
Pull = Callable[[Array], tuple[list[Term], Array]]
"""Positions of the matched landmarks, drone frame ``(N, 3)`` → cost terms that hold the pose near its prediction, and
the point of the drone ``(3,)`` to which these refer."""


class Tracked(NamedTuple):
    """The result of one image: ``T_world_drone (4, 4)``, or the predicted pose and the ``reason`` of the failure; its
    ``features``; the M landmarks ``expected`` in view; ``found (M,)``, the feature that matches each, −1 for none;
    ``inlier (M,)``, whether the match agrees with the pose; the ``shape`` of the image; and the normal matrix ``H
    (6, 6)`` of the solve, for twists about the ``centre (3,)``."""

    T_world_drone: Array
    reason: str
    features: Features
    expected: Expected
    found: IntArray
    inlier: NDArray[np.bool_]
    shape: tuple[int, int]
    H: Array = np.zeros((6, 6))
    centre: Array = np.zeros(3)

    @property
    def matches(self) -> int:
        """Number of landmarks that agree with the pose."""
        return int(np.count_nonzero(self.inlier))


class LandmarkTracker:
    """Localises images in a map of landmarks, and updates the map.

    Parameters
    ----------
    images : images of a camera on the drone; each scan uses the last one before or at its stamp.
    T_drone_sensor : (4, 4), the mount of the Time-of-Flight sensor.
    range_max_m : landmarks farther away are ignored.
    """

    def __init__(self, images: CameraImages, T_drone_sensor: Array, range_max_m: float) -> None:
        self.images, self.range_max_m = images, range_max_m
        self.T_camera_sensor = np.linalg.inv(images.T_drone_camera) @ T_drone_sensor
        self.map = LandmarkMap(LANDMARKS_MAX)
        self.count = 0
        self.T_keyframe: Array | None = None

    def image_at(self, stamp_s: float) -> GreyImage | None:
        """The image ``(H, W)`` for a scan; None without a recent one."""
        number = self.images.at(stamp_s)
        return None if number is None else self.images.images[number]

    def find(self, image: GreyImage, points: Array) -> Features:
        """Features, with depths, of an image where the scan ``(N, 3)`` or ``(H, W, 3)`` has returns."""
        return features_with_depth(image, points, self.T_camera_sensor, self.images.K, FEATURES)

    def track(self, features: Features, shape: tuple[int, int], T_predicted: Array, free: Array, pull: Pull) -> Tracked:
        """The pose of an image, starting from the predicted pose, in the directions ``free (6, k)``."""
        first = self._solve(features, shape, T_predicted, T_predicted, SEARCH_PX, HAMMING, free, pull)
        if first.reason:
            return first
        second = self._solve(features, shape, T_predicted, first.T_world_drone, NEAR_PX, NEAR_HAMMING, free, pull)
        return first if second.reason else second

    def update(self, tracked: Tracked) -> None:
        """Update the landmarks of an image. Add new ones if it is a keyframe or could not be localised."""
        if not tracked.reason:
            inlier, number = tracked.inlier, tracked.expected.number
            features = tracked.features.take(tracked.found[inlier])
            points = self._world(features, tracked.T_world_drone)
            self.map.update(number[inlier], points, features, number[~inlier], self.count)
        if bool(tracked.reason) or self._is_keyframe(tracked.T_world_drone):
            self._extend(tracked.features, tracked.T_world_drone, tracked.shape)
        self.count += 1

    def _solve(
        self, features: Features, shape: tuple[int, int], T_predicted: Array, T_init: Array, search_px: float,
        hamming_max: int, free: Array, pull: Pull,
    ) -> Tracked:  # fmt: skip
        """The pose from the landmarks that are expected at ``T_init`` and match features."""
        expected = self._expected(T_init, shape)
        found = match(
            *features, expected.pixel, self.map.octave[expected.number], expected.depth,
            self.map.descriptor[expected.number], search_px, hamming_max, RATIO,
        )  # fmt: skip
        inlier = found >= 0
        failed = Tracked(T_predicted, "", features, expected, found, inlier, shape)
        if len(features.pixel) < MATCHES_MIN:
            return failed._replace(reason="too few features")
        if not len(self.map):
            return failed._replace(reason="first scan")
        if failed.matches < MATCHES_MIN:
            return failed._replace(reason="too few matches")
        sighting = self._sighting(features, expected, found)
        terms, middle = pull((sighting.landmark - T_predicted[:3, 3]) @ T_predicted[:3, :3])
        solved = solve_pose(
            sighting, self.images.K, self.images.T_drone_camera, T_init, free, terms, middle, ROBUST_SCALE
        )  # fmt: skip
        inlier[inlier] = solved.weight >= INLIER_WEIGHT
        if not solved.determined:
            return failed._replace(reason="singular")
        if failed.matches < MATCHES_MIN:
            return failed._replace(reason="too few matches agree")
        return failed._replace(T_world_drone=solved.T_world_drone, H=solved.H, centre=solved.centre)

    def _expected(self, T_world_drone: Array, shape: tuple[int, int]) -> Expected:
        """The landmarks expected in an image at a pose."""
        return self.map.expected(T_world_drone @ self.images.T_drone_camera, self.images.K, shape, self.range_max_m)

    def _sighting(self, features: Features, expected: Expected, found: IntArray) -> Sighting:
        """The observations of the landmarks that match a feature."""
        matched = features.take(found[found >= 0])
        landmark = self.map.point[expected.number[found >= 0]]
        sigma_m = np.maximum(SIGMA_M, SIGMA_SHARE * matched.depth)
        return Sighting(landmark, matched.pixel, PIXEL_SIGMA * matched.sigma_scale, matched.depth, sigma_m)

    def _world(self, features: Features, T_world_drone: Array) -> Array:
        """Positions ``(N, 3)`` of features in the world frame, NaN without a depth."""
        T_world_camera = T_world_drone @ self.images.T_drone_camera
        points = features.depth[:, None] * unproject(features.pixel, self.images.K)
        return points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]

    def _is_keyframe(self, T_world_drone: Array) -> bool:
        T_last = self.T_keyframe
        if T_last is None:
            return True
        distance_m = np.linalg.norm(T_world_drone[:3, 3] - T_last[:3, 3])
        angle_rad = np.linalg.norm(T_world_drone[:3, :3] - T_last[:3, :3]) / 2**0.5
        return bool(distance_m + angle_rad / TURN_RAD_PER_M >= KEYFRAME_M)

    def _extend(self, features: Features, T_world_drone: Array, shape: tuple[int, int]) -> None:
        """Add landmarks at features with a depth, where no landmark is expected."""
        self.T_keyframe = T_world_drone
        T_world_camera = T_world_drone @ self.images.T_drone_camera
        known = self._expected(T_world_drone, shape).pixel
        new = np.flatnonzero(np.isfinite(features.depth))
        new = new[~near_any(features.pixel[new], known, SPACING_PX)]
        if len(new):
            added = features.take(new)
            self.map.insert(self._world(added, T_world_drone), added, T_world_camera[:3, 3], self.count)
