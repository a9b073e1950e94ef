"""Visual odometry by ORB features whose depths the Time-of-Flight sensor gives: the report's section 2.1.1.

The tracking of ORB-SLAM (Mur-Artal, Montiel, Tardós, IEEE Transactions on Robotics 31, 2015) with a local map, without
its bundle adjustment and its loop closing.
"""

import time

import numpy as np
from numpy.typing import NDArray

from steelnb.errors import SettingsError
from steelnb.fusion.poses import DRIFT_PERIOD_S
from steelnb.images import CameraImages, unproject
from steelnb.odometry.base import scan_of
from steelnb.odometry.features import (
    SIGMA_FLOOR_M,
    SIGMA_RELATIVE,
    Features,
    features_with_depth,
    match,
    near_any,
)
from steelnb.odometry.landmarks import Expected, LandmarkMap
from steelnb.odometry.prediction import Prediction
from steelnb.odometry.reprojection import Sighting, solve_pose
from steelnb.points.inputs import checked_pose
from steelnb.registration import free_directions, prior_term
from steelnb.settings import OdometrySettings
from steelnb.types import Array, IntArray, OdometryStep, Scan, Segments

APART_PX = 4.0
"""New landmarks keep this distance from those already expected in the image."""
INLIER_WEIGHT = 0.25
"""Least robust weight of a match that counts: that of an error of the robust scale itself."""
TURN_RAD_PER_M = 0.5
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


class OrbOdometry:
    """Corrects a drifting pose by the features of an image at each scan, matched to landmarks seen before.

    Parameters
    ----------
    settings : with a table ``orb``, default ``OdometrySettings.preset("orb")``.
    T_drone_sensor : (4, 4), the mount of the Time-of-Flight sensor, default identity.
    images : of a camera on the drone; of these, the last before or at each scan is used. Without, or where there is
        none of the time of a scan, the prior is followed.

    Raises `MissingExtraError` at the first image where OpenCV is not installed.
    """

    def __init__(
        self,
        settings: OdometrySettings | None = None,
        T_drone_sensor: Array | None = None,
        images: CameraImages | None = None,
    ) -> None:
        self.settings = settings or OdometrySettings.preset("orb")
        if self.settings.orb is None or self.settings.prior_sigma is None:
            raise SettingsError(f"method {self.settings.method!r}: expected an odometry by features, such as 'orb'")
        self.orb, self.images = self.settings.orb, images
        self.T_drone_sensor = checked_pose(np.eye(4) if T_drone_sensor is None else T_drone_sensor, "T_drone_sensor")
        self.map = LandmarkMap(LANDMARKS_MAX)
        self.tilt_sigma_rad = self.settings.tilt_sigma_rad
        self.prediction = Prediction(self.settings.drift_gain, self.tilt_sigma_rad)
        self.free = free_directions("se3" if self.tilt_sigma_rad else "xyz_yaw")
        place, turn = self.settings.prior_sigma
        self.information = np.diag([turn**-2.0] * 3 + [place**-2.0] * 3)
        self.stamp_s, self.count = np.nan, 0
        self.T_keyframe: Array | None = None

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Correct the pose at one scan by its image, and add new features to the map; see `Odometry.update`.

        The stages of ``seconds``: ``image`` reads or renders it, ``features``, ``match``, ``solve`` and ``map``.
        """
        scan, prior = scan_of(scan), checked_pose(T_world_drone_prior, "T_world_drone_prior")
        clock = [time.perf_counter()]
        T_init = self._predicted(scan.stamp_s, prior)
        number = self.images.at(scan.stamp_s) if self.images else None
        image = self.images.images[number] if self.images and number is not None else None
        clock.append(time.perf_counter())
        if self.images is None or image is None:
            self.prediction.lose()
            return self._step(scan, T_init, "no image", 0, clock)
        features = self._features(image, scan)
        clock.append(time.perf_counter())
        seen, found = self._match(features, T_init, image.shape, SEARCH_PX, HAMMING)
        clock.append(time.perf_counter())
        T_world_drone, reason, kept = self._solve(T_init, T_init, seen, features, found)
        if not reason:
            again = self._match(features, T_world_drone, image.shape, NEAR_PX, NEAR_HAMMING)
            second = self._solve(T_init, T_world_drone, again[0], features, again[1])
            if not second[1]:
                (seen, found), (T_world_drone, reason, kept) = again, second
        clock.append(time.perf_counter())
        if reason:
            self.prediction.lose()
        else:
            self.prediction.correct(T_world_drone, prior)
            shown = features.take(found[kept])
            places = self._world(shown, T_world_drone)
            self.map.update(seen.number[kept], places, shown, seen.number[~kept], self.count)
        self._extend(features, T_world_drone, bool(reason), image.shape)
        self.count += 1
        return self._step(scan, T_world_drone, reason, int(np.count_nonzero(kept)), clock)

    def _step(self, scan: Scan, T: Array, reason: str, matches: int, clock: list[float]) -> OdometryStep:
        now = time.perf_counter()
        clock = clock + [now] * (6 - len(clock))
        seconds = dict(zip(("image", "features", "match", "solve", "map"), np.diff(clock).tolist(), strict=True))
        return OdometryStep(scan.stamp_s, T, reason == "", reason, matches, seconds)

    def _predicted(self, stamp_s: float, prior: Array) -> Array:
        """The pose ``(4, 4)`` at which the solve starts; the information about its roll and pitch becomes that of the
        time passed."""
        passed_s = stamp_s - self.stamp_s
        passed_s = passed_s if passed_s > 0 else DRIFT_PERIOD_S  # the first scan, and scans without stamps
        self.stamp_s = stamp_s
        if self.tilt_sigma_rad:
            self.information[[0, 1], [0, 1]] = self.prediction.tilt_step_sigma_rad(passed_s) ** -2.0
        return self.prediction.pose(prior, passed_s)

    def _features(self, image: np.ndarray, scan: Scan) -> Features:
        """Features of an image where the scan has returns, with their depths."""
        assert self.images is not None
        T_camera_sensor = np.linalg.inv(self.images.T_drone_camera) @ self.T_drone_sensor
        return features_with_depth(image, scan.points, T_camera_sensor, self.images.K, self.orb.features)

    def _match(
        self, features: Features, T_world_drone: Array, shape: tuple[int, int], search_px: float, hamming_max: int
    ) -> tuple[Expected, IntArray]:
        """The landmarks expected at a pose, and the number of the feature that shows each of them, −1 for none."""
        assert self.images is not None
        T_world_camera = T_world_drone @ self.images.T_drone_camera
        seen = self.map.expected(T_world_camera, self.images.K, shape, self.settings.preprocess.crop_m)
        return seen, match(
            *features, seen.pixel, self.map.octave[seen.number], seen.depth, self.map.descriptor[seen.number],
            search_px, hamming_max, RATIO,
        )  # fmt: skip

    def _solve(
        self, T_prior: Array, T_init: Array, seen: Expected, features: Features, found: IntArray
    ) -> tuple[Array, str, NDArray[np.bool_]]:
        """The pose by the expected landmarks that features show, from ``T_init``; the reason why it is the predicted
        one, ``T_prior``; and which of the landmarks agree with it."""
        assert self.images is not None
        kept, index, at = found >= 0, seen.number[found >= 0], found[found >= 0]
        if len(features.pixel) < MATCHES_MIN:
            return T_prior, "too few features", kept
        if not len(self.map):
            return T_prior, "first scan", kept
        if len(index) < MATCHES_MIN:
            return T_prior, "too few matches", kept
        depth, landmark = features.depth[at], self.map.point[index]
        sigma_m = np.maximum(SIGMA_FLOOR_M, SIGMA_RELATIVE * depth)
        sigma_px = PIXEL_SIGMA * features.sigma_scale[at]
        in_drone = (landmark - T_prior[:3, 3]) @ T_prior[:3, :3]
        solved = solve_pose(
            Sighting(landmark, features.pixel[at], sigma_px, depth, sigma_m), self.images.K,
            self.images.T_drone_camera, T_init, self.free, prior_term(self.information, T_prior, in_drone),
            in_drone.mean(axis=0), ROBUST_SCALE,
        )  # fmt: skip
        kept[kept] = solved.weight >= INLIER_WEIGHT
        if not solved.determined:
            return T_prior, "singular", kept
        if np.count_nonzero(kept) < MATCHES_MIN:
            return T_prior, "too few matches agree", kept
        return solved.T_world_drone, "", kept

    def _world(self, features: Features, T_world_drone: Array) -> Array:
        """Places ``(N, 3)`` of features in the world, NaN without a depth."""
        assert self.images is not None
        T_world_camera = T_world_drone @ self.images.T_drone_camera
        points = features.depth[:, None] * unproject(features.pixel, self.images.K)
        return points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]

    def _extend(self, features: Features, T_world_drone: Array, lost: bool, shape: tuple[int, int]) -> None:
        """New landmarks at a keyframe, and where the map has too few: then they continue it at the predicted pose."""
        assert self.images is not None
        T_last = self.T_keyframe
        if T_last is not None and not lost:
            moved = np.linalg.norm(T_world_drone[:3, 3] - T_last[:3, 3])
            turned = np.linalg.norm(T_world_drone[:3, :3] - T_last[:3, :3]) / 2**0.5
            if moved + turned / TURN_RAD_PER_M < self.orb.keyframe_m:
                return
        self.T_keyframe = T_world_drone
        T_world_camera = T_world_drone @ self.images.T_drone_camera
        known = self.map.expected(T_world_camera, self.images.K, shape, self.settings.preprocess.crop_m).pixel
        new = np.flatnonzero(np.isfinite(features.depth))
        new = new[~near_any(features.pixel[new], known, APART_PX)]
        if len(new):
            chosen = features.take(new)
            self.map.insert(self._world(chosen, T_world_drone), chosen, T_world_camera[:3, 3], self.count)

    def map_points(self) -> Array:
        """Landmarks seen twice or more, ``(N, 3)`` in the world frame."""
        return self.map.point[self.map.found > 1]

    def map_segments(self) -> Segments:
        """The bars of the map; none, since it is a cloud."""
        return Segments.empty()
