"""Visual odometry by ORB features with depths from the Time-of-Flight sensor: the report's section 2.1.1."""

import time

import numpy as np

from steelnb.images import CameraImages
from steelnb.odometry.base import Odometry, scan_of, settings_of
from steelnb.odometry.prediction import PosePredictor
from steelnb.odometry.tracking import LandmarkTracker, Tracked
from steelnb.points.inputs import checked_pose
from steelnb.registration import Term, free_directions
from steelnb.settings import OdometrySettings, OrbSettings
from steelnb.types import Array, Imu, OdometryStep, Scan

PRIOR_SIGMA = 0.05, 0.02
"""Standard deviations of a correction from its prediction, metres and radians; tuned on the seeds 11 and 12."""


class OrbOdometry(Odometry):
    """Corrects a drifting pose by the image features at each scan, matched to a map of landmarks.

    Parameters
    ----------
    settings : of the family ``orb``, default ``OdometrySettings.preset("orb")``.
    T_drone_sensor : (4, 4), the mount of the Time-of-Flight sensor, default identity.
    imu : readings in the drone frame; used, up to the current scan, if the settings have ``inertial``.
    images : images of a camera on the drone; each scan uses the last one before or at its stamp. A scan without one
        follows the prior.
    """

    def __init__(
        self,
        settings: OdometrySettings | None = None,
        T_drone_sensor: Array | None = None,
        imu: Imu | None = None,
        images: CameraImages | None = None,
    ) -> None:
        self.settings = s = settings_of(settings, OrbSettings, "orb")
        self.T_drone_sensor = checked_pose(np.eye(4) if T_drone_sensor is None else T_drone_sensor, "T_drone_sensor")
        self.tracker: LandmarkTracker | None = None
        if images is not None:
            self.tracker = LandmarkTracker(images, self.T_drone_sensor, s.preprocess.crop_m)
        self.tracked: Tracked | None = None  # result of the last image
        self.predictor = PosePredictor(PRIOR_SIGMA, s.tilt_sigma_rad, s.inertial, imu)
        self.free = free_directions("se3" if self.predictor.tilted else "xyz_yaw")

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Correct the pose at one scan by its image, and add new features to the map; see `Odometry.update`.

        The stages of ``seconds`` are ``features``, ``track`` and ``map``, without reading or rendering the image.
        """
        scan, prior = scan_of(scan), checked_pose(T_world_drone_prior, "T_world_drone_prior")
        image = self.tracker.image_at(scan.stamp_s) if self.tracker else None
        predictor, clock = self.predictor, [time.perf_counter()]
        T_init = predictor.pose(scan.stamp_s, prior)
        if self.tracker is None or image is None:
            predictor.lose()
            return self._step(scan, T_init, "no image", 0, clock)
        features = self.tracker.find(image, scan.points)
        clock.append(time.perf_counter())

        def pull(in_drone: Array) -> tuple[list[Term], Array]:
            return predictor.terms(T_init, in_drone), in_drone.mean(axis=0)

        self.tracked = tracked = self.tracker.track(features, image.shape, T_init, self.free, pull)
        clock.append(time.perf_counter())
        if tracked.reason:
            predictor.lose()
        else:
            information = predictor.information_of(tracked.H, tracked.T_world_drone, tracked.centre)
            predictor.correct(tracked.T_world_drone, prior, information=information)
        self.tracker.update(tracked)
        return self._step(scan, tracked.T_world_drone, tracked.reason, tracked.matches, clock)

    def _step(self, scan: Scan, T: Array, reason: str, matches: int, clock: list[float]) -> OdometryStep:
        now = time.perf_counter()
        clock = clock + [now] * (4 - len(clock))
        seconds = dict(zip(("features", "track", "map"), np.diff(clock).tolist(), strict=True))
        return OdometryStep(scan.stamp_s, T, reason == "", reason, matches, seconds)

    def map_points(self) -> Array:
        """Landmarks with at least two observations, ``(N, 3)`` in the world frame."""
        return self.tracker.map.point[self.tracker.map.found > 1] if self.tracker else np.zeros((0, 3))
