"""Landmarks whose depths are triangulated from two images: visual odometry that uses no range.

New landmarks are triangulated between keyframes as in ORB-SLAM (Mur-Artal, Montiel, Tardós, IEEE Transactions on
Robotics 31, 2015, section VI.C), and each further sighting refines them, a Kalman update with the pose taken as known.
The first keyframes are laid on the predicted poses, so the scale of the map is that of the drifting prior, and no loop
is ever closed.
"""

import numpy as np

from steelnb.images import CameraImages, GreyImage, project, unproject
from steelnb.odometry.features import Features, find_features, match, near_any
from steelnb.odometry.landmarks import Expected, LandmarkMap
from steelnb.odometry.reprojection import Sighting
from steelnb.odometry.tracking import APART_PX, FEATURES, HAMMING, PIXEL_SIGMA, RATIO, LandmarkTracker, Tracked
from steelnb.types import Array, IntArray

BASELINE_M, PARALLAX_MIN_RAD = 0.3, 0.1
"""Keyframes are at least so far apart, and so the rays of two images to a landmark. Chosen on the development seeds 11
and 12, both flights of 30 s, among 0.1 m and 0.03 rad, with which the scale soon runs away, and twice and three times
both."""
ERROR_MAX_PX = 2.0
"""Largest distance of a new landmark, seen from both keyframes, from the features that showed it, on the finest level
of the pyramid."""
DISTANCE_MIN_M = 0.2


class TriangulatedMap(LandmarkMap):
    """Landmarks with the ``information (N, 3, 3)`` about their places in the world, 1/m²."""

    ARRAYS = (*LandmarkMap.ARRAYS, "information")

    def __init__(self, count_max: int) -> None:
        super().__init__(count_max)
        self.information = np.zeros((0, 3, 3))

    def insert_known(self, point: Array, information: Array, features: Features, position: Array, now: int) -> None:
        """`insert` landmarks with the ``information (M, 3, 3)`` about their places."""
        self.information = np.concatenate([self.information, information])
        self.insert(point, features, position, now)


class MonocularTracker(LandmarkTracker):
    """`LandmarkTracker` whose features are sought everywhere in an image, and have no measured depths."""

    def __init__(self, images: CameraImages, T_drone_sensor: Array, range_max_m: float) -> None:
        super().__init__(images, T_drone_sensor, range_max_m)
        self.map: TriangulatedMap = TriangulatedMap(self.map.count_max)
        self._keyframe: tuple[Features, Array] | None = None  # features that show no landmark, and T_world_camera

    def find(self, image: GreyImage, points: Array) -> Features:
        """Features of an image; the scan is not looked at."""
        return find_features(image, FEATURES)

    def update(self, tracked: Tracked, T_world_drone: Array) -> None:
        """Refine the landmarks of an image, whose pose is known by now, and triangulate new ones at a keyframe."""
        if not tracked.reason:
            index, shown = tracked.seen.number[tracked.kept], tracked.features.take(tracked.found[tracked.kept])
            self._refine(index, shown, T_world_drone @ self.images.T_drone_camera)
        super().update(tracked, T_world_drone)

    def _sighting(self, features: Features, seen: Expected, found: IntArray) -> Sighting:
        """As for landmarks of known depth; a landmark's own uncertainty in the image is added to the pixel's."""
        sighting, index = super()._sighting(features, seen, found), seen.number[found >= 0]
        J = self._slopes(self.map.point[index], seen.T_world_camera)
        spread = np.einsum("nij,njk,nik->ni", J, np.linalg.inv(self.map.information[index]), J).mean(axis=1)
        return sighting._replace(sigma_px=np.sqrt(sighting.sigma_px**2 + spread))

    def _refine(self, index: IntArray, shown: Features, T_world_camera: Array) -> None:
        """Kalman update of landmarks by the pixels of the features that show them."""
        J = self._slopes(self.map.point[index], T_world_camera) / (PIXEL_SIGMA * shown.sigma_scale)[:, None, None]
        seen = project((self.map.point[index] - T_world_camera[:3, 3]) @ T_world_camera[:3, :3], self.images.K)
        error = (shown.pixel - seen) / (PIXEL_SIGMA * shown.sigma_scale)[:, None]
        information = self.map.information[index] + np.einsum("nki,nkj->nij", J, J)
        step = np.linalg.solve(information, np.einsum("nki,nk->ni", J, error)[..., None])[..., 0]
        self.map.point[index] += step
        self.map.information[index] = information

    def _slopes(self, points: Array, T_world_camera: Array) -> Array:
        """Derivatives ``(N, 2, 3)`` of the pixels of points ``(N, 3)`` in the world by the points."""
        R, K = T_world_camera[:3, :3], self.images.K
        x, y, z = ((points - T_world_camera[:3, 3]) @ R).T
        by_camera = np.zeros((len(points), 2, 3))
        for axis, (f, across) in enumerate(((K[0, 0], y), (K[1, 1], z))):
            by_camera[:, axis, 0], by_camera[:, axis, axis + 1] = f * across / x**2, -f / x
        return by_camera @ R.T

    def _extend(self, features: Features, T_world_drone: Array, shape: tuple[int, int]) -> None:
        """New landmarks by features of this image and of the last keyframe that show none."""
        T_world_camera = T_world_drone @ self.images.T_drone_camera
        before = self._keyframe
        if before and np.linalg.norm(T_world_camera[:3, 3] - before[1][:3, 3]) < BASELINE_M:
            return
        known = self._expected(T_world_drone, shape).pixel
        free = features.take(np.flatnonzero(~near_any(features.pixel, known, APART_PX)))
        self._keyframe, self.T_keyframe = (free, T_world_camera), T_world_drone
        if before is None:
            return
        last, T_last = before
        found = match(
            *free, last.pixel, last.octave, np.full(len(last.pixel), np.nan), last.descriptor, np.inf, HAMMING, RATIO
        )
        self._triangulate(last.take(np.flatnonzero(found >= 0)), T_last, free.take(found[found >= 0]), T_world_camera)

    def _triangulate(self, a: Features, T_a: Array, b: Features, T_b: Array) -> None:
        """Add the landmarks that N features of one image show, and those of a later one, with the cameras' poses
        ``(4, 4)``: where both rays come nearest to each other."""
        apart = T_a[:3, 3] - T_b[:3, 3]
        rays = [unproject(each.pixel, self.images.K) @ T[:3, :3].T for each, T in ((a, T_a), (b, T_b))]
        along_a, along_b = (ray / np.linalg.norm(ray, axis=1)[:, None] for ray in rays)
        cosine, by_a, by_b = (along_a * along_b).sum(axis=1), along_a @ apart, along_b @ apart
        wide = cosine < np.cos(PARALLAX_MIN_RAD)
        with np.errstate(divide="ignore", invalid="ignore"):
            from_a, from_b = (cosine * by_b - by_a) / (1 - cosine**2), (by_b - cosine * by_a) / (1 - cosine**2)
            point = 0.5 * (T_a[:3, 3] + from_a[:, None] * along_a + T_b[:3, 3] + from_b[:, None] * along_b)
        good = wide & (np.minimum(from_a, from_b) > DISTANCE_MIN_M) & (from_b < self.range_max_m)
        for each, T in ((a, T_a), (b, T_b)):
            error = np.linalg.norm(project((point - T[:3, 3]) @ T[:3, :3], self.images.K) - each.pixel, axis=1)
            good &= error < ERROR_MAX_PX * each.sigma_scale
        chosen = np.flatnonzero(good)
        if not len(chosen):
            return
        information = np.zeros((len(chosen), 3, 3))
        for each, T in ((a, T_a), (b, T_b)):
            J = self._slopes(point[chosen], T) / (PIXEL_SIGMA * each.sigma_scale[chosen])[:, None, None]
            information += np.einsum("nki,nkj->nij", J, J)
        self.map.insert_known(point[chosen], information, b.take(chosen), T_b[:3, 3], self.count)
