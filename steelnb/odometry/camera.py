"""Odometry by clouds, bars and a camera at once: landmarks in images as one more term of the solve."""

import time
from dataclasses import replace

import numpy as np

from steelnb.images import CameraImages
from steelnb.odometry.base import scan_of
from steelnb.odometry.combined import CombinedOdometry
from steelnb.odometry.features import Features
from steelnb.odometry.tracking import LandmarkTracker, Tracked
from steelnb.points.inputs import checked_pose
from steelnb.registration import Term
from steelnb.registration.result import middle_and_length
from steelnb.settings import OdometrySettings
from steelnb.types import Array, Imu, OdometryStep, Scan

LANDMARK_SHARE = 0.3
"""Share of the landmarks' information that counts: frame after frame sees the same ones, whose errors it takes over.
Chosen on the development seeds 11 to 13, both flights of 60 s, ideal and honest sensor, among 0.03, 0.1, 0.3, 1 and 4:
on zigzags the error falls up to 1 or 4, on loops it rises from 0.3 on."""


class CameraOdometry(CombinedOdometry):
    """`CombinedOdometry` whose solve has the reprojection errors of landmarks, too (`LandmarkTracker`).

    Which features show landmarks is decided by the images and the prediction alone; then all pairs pull the pose
    together. Scans without an image, or with too few matches, are corrected by clouds and bars as ever.

    Parameters
    ----------
    settings : with ``orb``, default ``OdometrySettings.preset("combined-camera")``.
    T_drone_sensor : (4, 4), the mount of the Time-of-Flight sensor, default identity.
    imu : readings in the axes of the drone, as for `CloudOdometry`.
    images : of a camera on the drone; without, this is `CombinedOdometry`.
    """

    def __init__(
        self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None, imu: Imu | None = None,
        images: CameraImages | None = None,
    ) -> None:  # fmt: skip
        super().__init__(settings or OdometrySettings.preset("combined-camera"), T_drone_sensor, imu)
        self.tracker: LandmarkTracker | None = None
        if images is not None:
            self.tracker = LandmarkTracker(images, self.T_drone_sensor, self.settings.preprocess.crop_m)
        self._image: tuple[Features, tuple[int, int]] | None = None  # of the scan at hand: features, rows and columns
        self._tracked: Tracked | None = None

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Register one scan and its image, correct the pose, add both to the maps; see `Odometry.update`.

        The stages of ``seconds`` are those of `CombinedOdometry`, and ``camera`` for features and their map; to read or
        render an image counts as little as to read a scan.
        """
        scan, prior = scan_of(scan), checked_pose(T_world_drone_prior, "T_world_drone_prior")
        image = self.tracker.image_at(scan.stamp_s) if self.tracker else None
        begin = time.perf_counter()
        self._image = self._tracked = None
        if self.tracker and image is not None:
            self._image = self.tracker.find(image, scan.points), image.shape
        spent_s = time.perf_counter() - begin
        step = super().update(scan, prior)
        begin = time.perf_counter()
        if step.reason == "first scan":
            self._tracked = self._track(np.zeros((0, 3)), step.T_world_drone, [])
        if self.tracker and self._tracked and (step.used or step.reason == "first scan"):
            self.tracker.update(self._tracked, step.T_world_drone)
        return replace(step, seconds=step.seconds | {"camera": spent_s + time.perf_counter() - begin})

    def _terms(self, points: Array, T_init: Array, prior: list[Term]) -> list[Term]:
        """The terms of `CombinedOdometry`, and that of the landmarks."""
        terms = super()._terms(points, T_init, prior)
        self._tracked = tracked = self._track(points, T_init, prior)
        if self.tracker is None or tracked is None or tracked.reason:
            return terms
        return [self.tracker.term(tracked, LANDMARK_SHARE), *terms]

    def _track(self, points: Array, T_init: Array, prior: list[Term]) -> Tracked | None:
        """What the scan's image shows of the landmarks; None without an image."""
        if self.tracker is None or self._image is None:
            return None
        middle = middle_and_length(points)[0] if len(points) else np.zeros(3)
        return self.tracker.track(*self._image, T_init, self.free, lambda _: (prior, middle))
