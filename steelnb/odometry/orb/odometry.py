"""Visual odometry by ORB features with depths from the Time-of-Flight sensor: the report's section 2.1.1.

This is the tracking of ORB-SLAM (Mur-Artal, Montiel, Tardós, IEEE Transactions on Robotics 31, 2015) with a local map,
but without bundle adjustment or loop closure.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steelnb.core.arguments import checks_arguments
from steelnb.core.geometry import transform_points
from steelnb.core.types import Array, CameraImages, GreyImage, Imu, IntArray, Scan, unproject
from steelnb.odometry.base import BaseOdometry, Outcome, Stopwatch
from steelnb.odometry.drift_filter import PRIOR_SIGMA, make_prediction
from steelnb.odometry.orb.features import Features, features_with_depth, match
from steelnb.odometry.orb.landmarks import Expected, LandmarkMap
from steelnb.odometry.orb.reprojection import solve_pose
from steelnb.odometry.prediction import RegisteredPose
from steelnb.registration import FREE
from steelnb.settings import OdometrySettings, OrbSettings

SPACING_PX = 4.0
"""Minimum distance of new landmarks, along u or v, from those already expected in the image."""
INLIER_WEIGHT = 0.25
"""Minimum robust weight of an inlier: that of an error equal to the robust scale."""
FEATURES = 800
"""Maximum number of features per image."""
KEYFRAME_M, TURN_RAD_PER_M = 0.1, 0.5
"""A keyframe is taken after this distance; this many radians of rotation count as one metre."""
SEARCH_PX, HAMMING = 8.0, 60
"""Search radius around the predicted pixel, and maximum Hamming distance of the 256-bit descriptors. An error of 5 cm,
the prior's standard deviation, is 8 pixels of the forward camera at 1.1 m."""
NEAR_PX, NEAR_HAMMING = 3.0, 110
"""The same for the second search, which starts from the result of the first."""
RATIO = 0.85
"""Ratio test: maximum distance of the best descriptor relative to the second best (Lowe, IJCV 60, 2004: 0.8)."""
ROBUST_SCALE = 2.0
"""Scale of the Geman-McClure weights, in standard deviations."""
MATCHES_MIN = 8
"""Minimum number of matches: four for a pose, and four to check it."""
LANDMARKS_MAX = 10_000
"""Maximum number of landmarks; beyond it, the least recently observed ones are removed."""
NO_IMAGES = CameraImages(np.zeros(0), (), np.eye(3), np.eye(4))


class Tracked(NamedTuple):
    """The result of one image: ``T_world_drone (4, 4)``, or the predicted pose and the ``reason`` of the failure; the M
    landmarks ``expected`` in view; ``found (M,)``, the feature that matches each, −1 for none; ``inlier (M,)``, whether
    the match agrees with the pose; and the normal matrix ``H (6, 6)`` of the solve, for twists about the ``centre
    (3,)``."""

    T_world_drone: Array
    reason: str
    expected: Expected
    found: IntArray
    inlier: NDArray[np.bool_]
    H: Array = np.zeros((6, 6))
    centre: Array = np.zeros(3)

    @property
    def matches(self) -> int:
        """Number of landmarks that agree with the pose."""
        return int(np.count_nonzero(self.inlier))


class OrbOdometry(BaseOdometry):
    """Corrects a drifting pose by the image features at each scan, matched to a map of landmarks.

    Landmarks farther away than ``preprocess.crop_m`` are ignored. Reading or rendering an image is not measured.

    Parameters
    ----------
    imu : readings in the drone frame; used, up to the current scan, if the settings have ``inertial``.
    images : images of a camera on the drone; each scan uses the last one before or at its stamp. A scan without one
        follows the prior.
    """

    kind, method = OrbSettings, "orb"
    stages = "features", "track", "map"
    settings: OrbSettings

    @checks_arguments
    def __init__(
        self,
        settings: OdometrySettings | None = None,
        T_drone_sensor: Array | None = None,
        imu: Imu | None = None,
        images: CameraImages | None = None,
    ) -> None:
        super().__init__(settings, T_drone_sensor)
        self.images = NO_IMAGES if images is None else images
        self.T_camera_sensor = np.linalg.inv(self.images.T_drone_camera) @ self.T_drone_sensor
        self.map, self.count = LandmarkMap(LANDMARKS_MAX), 0
        self.T_keyframe: Array | None = None
        self.prediction = make_prediction(PRIOR_SIGMA, 0.0, self.settings.inertial, imu)
        self.free = FREE["se3" if self.prediction.tilted else "xyz_yaw"]

    def _update(self, scan: Scan, prior: Array, watch: Stopwatch) -> Outcome:
        number = self.images.at(scan.stamp_s)
        image = None if number is None else self.images.images[number]
        T_predicted = self.prediction.pose(prior, scan.stamp_s)
        if image is None:
            self.prediction.lose()
            return T_predicted, "no image", 0, 0
        features = features_with_depth(image, scan.points, self.T_camera_sensor, self.images.K, FEATURES)
        watch.lap("features")
        tracked = self._solve(features, image, T_predicted, T_predicted, SEARCH_PX, HAMMING)
        if not tracked.reason:
            second = self._solve(features, image, T_predicted, tracked.T_world_drone, NEAR_PX, NEAR_HAMMING)
            tracked = tracked if second.reason else second
        watch.lap("track")
        T_world_drone, reason = tracked.T_world_drone, tracked.reason
        if reason:
            self.prediction.lose()
        else:
            arm = T_world_drone[:3, 3] - tracked.centre
            self.prediction.correct(RegisteredPose(T_world_drone, H=tracked.H, arm=arm))
            inlier, landmark = tracked.inlier, tracked.expected.number
            observed = features.take(tracked.found[inlier])
            points = self._world(observed, T_world_drone)
            self.map.update(landmark[inlier], points, observed, landmark[~inlier], self.count)
        if reason or self._is_keyframe(T_world_drone):
            self._extend(features, image, T_world_drone)
        self.count += 1
        watch.lap("map")
        return T_world_drone, reason, tracked.matches, 0

    def map_points(self) -> Array:
        """Landmarks with at least two observations, ``(N, 3)`` in the world frame."""
        table = self.map.table
        return table["point"][table["found"] > 1]

    def _solve(
        self, features: Features, image: GreyImage, T_predicted: Array, T_init: Array, search_px: float,
        hamming_max: int,
    ) -> Tracked:  # fmt: skip
        """The pose from the landmarks that are expected at ``T_init`` and match features."""
        expected = self._expected(T_init, image)
        found = match(
            *features, expected.pixel, self.map.table["octave"][expected.number], expected.depth,
            self.map.table["descriptor"][expected.number], search_px, hamming_max, RATIO,
        )  # fmt: skip
        inlier = found >= 0
        failed = Tracked(T_predicted, "", expected, found, inlier)
        if len(features.pixel) < MATCHES_MIN:
            return failed._replace(reason="too few features")
        if not len(self.map):
            return failed._replace(reason="first scan")
        if failed.matches < MATCHES_MIN:
            return failed._replace(reason="too few matches")
        matched, landmark = features.take(found[inlier]), self.map.table["point"][expected.number[inlier]]
        in_drone = (landmark - T_predicted[:3, 3]) @ T_predicted[:3, :3]
        solved = solve_pose(
            landmark, matched, self.images.K, self.images.T_drone_camera, T_init, self.free,
            self.prediction.terms(T_predicted, in_drone), in_drone.mean(axis=0), ROBUST_SCALE,
        )  # fmt: skip
        if solved is None:
            return failed._replace(reason="singular")
        inlier[inlier] = solved.weight >= INLIER_WEIGHT
        if failed.matches < MATCHES_MIN:
            return failed._replace(reason="too few matches agree")
        return failed._replace(T_world_drone=solved.T_world_drone, H=solved.H, centre=solved.centre)

    def _expected(self, T_world_drone: Array, image: GreyImage) -> Expected:
        """The landmarks expected in an image at a pose."""
        T_world_camera = T_world_drone @ self.images.T_drone_camera
        return self.map.expected(T_world_camera, self.images.K, image.shape, self.settings.preprocess.crop_m)

    def _world(self, features: Features, T_world_drone: Array) -> Array:
        """Positions ``(N, 3)`` of features in the world frame, NaN without a depth."""
        T_world_camera = T_world_drone @ self.images.T_drone_camera
        points = features.depth[:, None] * unproject(features.pixel, self.images.K)
        return transform_points(T_world_camera, points)

    def _is_keyframe(self, T_world_drone: Array) -> bool:
        T_last = self.T_keyframe
        if T_last is None:
            return True
        distance_m = np.linalg.norm(T_world_drone[:3, 3] - T_last[:3, 3])
        angle_rad = np.linalg.norm(T_world_drone[:3, :3] - T_last[:3, :3]) / 2**0.5
        return bool(distance_m + angle_rad / TURN_RAD_PER_M >= KEYFRAME_M)

    def _extend(self, features: Features, image: GreyImage, T_world_drone: Array) -> None:
        """Add landmarks at features with a depth, where no landmark is expected."""
        self.T_keyframe = T_world_drone
        new = np.flatnonzero(np.isfinite(features.depth))
        known = cKDTree(self._expected(T_world_drone, image).pixel)
        new = new[known.query(features.pixel[new], p=np.inf)[0] >= SPACING_PX]
        if len(new):
            position = (T_world_drone @ self.images.T_drone_camera)[:3, 3]
            added = features.take(new)
            self.map.insert(self._world(added, T_world_drone), added, position, self.count)
